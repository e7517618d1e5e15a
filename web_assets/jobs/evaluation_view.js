// An evaluation: rollouts as they end, what they come to, figures, and another one on the same scenes.

import { api } from "../dataset/api.js";
import { h } from "../dataset/dom.js";
import { date } from "../dataset/format.js";
import { link, select } from "./fields.js";
import { interval, progressOf } from "./job_list.js";

export class EvaluationView {
  constructor(section, act) {
    Object.assign(this, { section, act, key: null, known: new Map(), progress: h("div", { class: "how-far" }) });
  }

  close() {
    if (this.key === null) return;
    this.key = null;
    this.section.replaceChildren();
  }

  show({ id, against, job, evaluations }) {
    this.progress.replaceChildren(...[job && progressOf(job)].filter(Boolean));
    const live = !id && job ? [job.standing.state, job.progress?.done] : null;
    const key = JSON.stringify([id, against, job?.job.job_id, live, evaluations.length]);
    if (key === this.key) return;
    this.key = key;
    this.fill(key, async () => (id ? await this.whole(id, against, evaluations) : this.running(job)));
  }

  async fill(key, make) {
    const shown = await make().catch((error) => [h("p", { class: "empty" }, error.message)]); // e.g. somebody removed it
    if (key === this.key) this.section.replaceChildren(...shown.filter(Boolean));
  }

  // While it runs, what the job tells.
  running({ job, standing, progress }) {
    const rollouts = progress?.rollouts ?? [];
    const judged = rollouts.filter(({ error }) => error === null);
    return [
      h("div", { class: "title" }, h("h2", {}, job.title)),
      h("div", { class: "line" }, h("span", { class: `badge ${standing.state}` }, standing.state), this.progress),
      standing.why ? h("p", { class: "why" }, standing.why) : null,
      judged.length ? cards({
        Success: [`${judged.filter(({ success }) => success).length} / ${judged.length}`, interval(wilson(judged.filter(({ success }) => success).length, judged.length))],
        "Contact force": [`${mean(judged, "force_mean_N").toFixed(1)} N`, `at most ${Math.max(...judged.map((r) => r.force_max_N)).toFixed(1)} N`],
      }) : h("p", { class: "dim" }, "The first rollout is not over yet."),
      rollouts.length ? table(rollouts) : null,
    ];
  }

  async whole(id, against, evaluations) {
    const path = `/evaluations/${encodeURIComponent(id)}`;
    if (!this.known.has(id)) this.known.set(id, await api.get(path));
    const { summary, evaluation } = this.known.get(id);
    const others = evaluations.filter((other) => other.task === evaluation.task && other.spread === evaluation.spread && other.evaluation !== id);
    const paired = against ? await api.get(`${path}/against/${encodeURIComponent(against)}`) : null;
    const choice = select("against", [["", "nothing"], ...others.map((other) => [other.evaluation, `${other.label} · ${other.successes}/${other.episodes} · ${date(other.started)}`])], () => this.act.against(choice.value || null));
    choice.value = against ?? "";
    const figure = (name) => h("img", { class: "figure", src: api.url(`${path}/figures/${name}`, { against }), alt: `${name} of ${summary.run}`, loading: "lazy" });
    return [
      h("div", { class: "title" }, h("h2", {}, `${summary.run} on ${evaluation.task}`)),
      h("p", { class: "dim" }, provenance(summary, evaluation)),
      cards({
        Success: [`${summary.successes} / ${summary.episodes}`, interval(summary.wilson_95)],
        "Contact force": [`${summary.force_mean_N.toFixed(1)} ± ${summary.force_sd_N.toFixed(1)} N`, `at most ${summary.force_max_N.toFixed(1)} N`],
        Peak: [`${summary.force_peak_mean_N.toFixed(1)} N`, "mean over rollouts"],
        Impulse: [`${summary.impulse_mean_Ns.toFixed(1)} N·s`, "a rollout"],
        Time: [`${summary.seconds_per_episode.toFixed(1)} s`, "a rollout"],
      }),
      h("label", { class: "against" }, "Compare with ", choice),
      paired ? pairs(paired) : null,
      paired ? null : table(evaluation.rollouts),
      h("h3", {}, "Force"), figure("force"), h("h3", {}, "Stiffness against force"), figure("stiffness"),
    ];
  }
}

function provenance(summary, evaluation) {
  const seeds = summary.seeds;
  return h("span", {},
    summary.step ? [h("a", { href: link("/train", { run: summary.run }) }, `run ${summary.run}`), ` at step ${summary.step}, ${summary.execution}`] : `reference ${summary.run}`,
    `, seeds ${Math.min(...seeds)} to ${Math.max(...seeds)}, studio ${evaluation.versions.studio ?? "?"}, ${date(evaluation.started)}`,
    summary.hidden?.length ? `, hidden: ${summary.hidden.join(", ")}` : "");
}

const cards = (told) => h("div", { class: "cards" }, Object.entries(told).map(([name, [value, more]]) => h("div", { class: "card" }, h("small", {}, name), h("b", {}, value), h("small", { class: "dim" }, more))));

const episode = (rollout) => (rollout.episode_id ? h("a", { href: link("/dataset", { episode: rollout.episode_id }) }, "open") : "");

const outcome = (rollout) => (rollout.error ? h("span", { class: "outcome unmarked", title: rollout.error }, "! error") : h("span", { class: `outcome ${rollout.success ? "success" : "failure"}` }, h("b", {}, rollout.success ? "✓" : "✗"), rollout.success ? " success" : " failure"));

function table(rollouts) {
  const heads = ["Seed", "Outcome", "Progress", "Phase", "Time", "Force", "Peak", "Impulse", "Limits", ""];
  return h("div", { class: "scroll" }, h("table", { class: "rollouts" }, h("thead", {}, h("tr", {}, heads.map((text) => h("th", {}, text)))),
    h("tbody", {}, rollouts.map((r) => h("tr", {}, h("td", { class: "number" }, String(r.seed)), h("td", {}, outcome(r)),
      h("td", { class: "number" }, `${Math.round(100 * r.progress)} %`), h("td", {}, r.phase), h("td", { class: "number" }, `${r.seconds.toFixed(1)} s`),
      h("td", { class: "number" }, `${r.force_mean_N.toFixed(1)} N`), h("td", { class: "number" }, `${r.force_max_N.toFixed(1)} N`), h("td", { class: "number" }, `${r.impulse_Ns.toFixed(1)} N·s`),
      h("td", { class: "dim" }, r.limits.join(", ")), h("td", {}, episode(r)))))));
}

function pairs({ comparison, text, scenes }) {
  const share = (value) => `${value > 0 ? "+" : ""}${Math.round(100 * value)} %`;
  const [low, high] = comparison.difference_95;
  return h("div", { class: "paired" },
    cards({
      "Paired difference": [share(comparison.difference), `95 %: ${share(low)} to ${share(high)}`],
      "Only one succeeded": [`${comparison.only_one} : ${comparison.only_other}`, `McNemar p = ${comparison.mcnemar_p.toPrecision(2)}`],
      "Contact force": [`${comparison.force_difference_N > 0 ? "+" : ""}${comparison.force_difference_N.toFixed(1)} N`, "one less the other"],
    }),
    h("p", { class: "dim" }, text),
    h("div", { class: "scroll" }, h("table", { class: "rollouts" },
      h("thead", {}, h("tr", {}, ["Seed", comparison.one, "Force", "", comparison.other, "Force", ""].map((name) => h("th", {}, name)))),
      h("tbody", {}, scenes.map(({ seed, one, other }) => h("tr", { class: one.success === other.success ? "" : "differs" }, h("td", { class: "number" }, String(seed)),
        [one, other].map((r) => [h("td", {}, outcome(r)), h("td", { class: "number" }, `${r.force_mean_N.toFixed(1)} N`), h("td", {}, episode(r))]).flat()))))));
}

const mean = (rollouts, name) => rollouts.reduce((sum, r) => sum + r[name], 0) / rollouts.length;

// Wilson's 95 % interval, as `studio.evaluation.wilson`, for what is not saved yet.
function wilson(successes, n) {
  const z2 = 1.959963984540054 ** 2, center = (successes + z2 / 2) / (n + z2);
  const half = Math.sqrt(z2 * ((successes * (n - successes)) / n + z2 / 4)) / (n + z2);
  return [Math.max(0, center - half), Math.min(1, center + half)];
}
