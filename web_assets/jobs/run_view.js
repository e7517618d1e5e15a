// A closer look at one job, or at the curves of one run or several.

import { api } from "../dataset/api.js";
import { attempt, h, toast } from "../dataset/dom.js";
import { date, exactDate } from "../dataset/format.js";
import { Chart, COLORS } from "./curves.js";
import { link, titleOf, valueOf } from "./fields.js";
import { progressOf } from "./job_list.js";
import { HERE, placeOf } from "./place.js";

const GROUPS = ["position", "rotation", "gripper", "stiffness", "joints", "kl"];
const ERRORS = { position_mm: "mm", rotation_deg: "°", joints_deg: "°", stiffness_N_per_m: "N/m" };
const LABELS = { position_mm: "position", rotation_deg: "rotation", joints_deg: "joints", stiffness_N_per_m: "stiffness" };

export class RunView {
  constructor(section, act) {
    Object.assign(this, { section, act, key: null, metrics: new Map(), charts: {} });
  }

  close() {
    if (this.key === null) return;
    Object.values(this.charts).forEach((chart) => chart.close());
    Object.assign(this, { key: null, charts: {} });
    this.section.replaceChildren();
  }

  // `job` is the one that is open; of a run without it, what made the run.
  show({ names, job, runs, jobs, evaluations }) {
    if (names.length === 1) job ??= jobs.find((now) => now.job.kind === "train" && now.job.subject === names[0]);
    const known = names.filter((name) => runs.some((run) => run.name === name) || job?.job.subject === name);
    const key = JSON.stringify([names, known, job?.job.job_id]);
    if (key !== this.key) this.build(key, known, job, names);
    if (!known.length && !job) return;
    this.tell(known, job, runs, evaluations);
    const active = (name) => runs.find((run) => run.name === name)?.is_learning || jobs.some((now) => now.job.subject === name && now.standing.state === "running");
    const there = known.filter((name) => runs.some((run) => run.name === name)); // somebody may have removed a folder
    attempt(() => this.refresh(there, active, job));
  }

  build(key, names, job, wanted) {
    this.close();
    this.key = key;
    if (!names.length && !job) {
      const gone = wanted.length ? `There is no run ${wanted.join(", ")}; perhaps it is in the trash.` : "";
      this.section.replaceChildren(h("p", { class: "empty" }, gone || "Open a job or a run to look at it closer: its curves, what it learned from, what it says."));
      return;
    }
    Object.assign(this, { facts: h("div", {}), progress: h("div", { class: "how-far" }), told: null });
    this.log = h("pre", { class: "log", tabIndex: 0, "aria-label": "What it said" });
    const single = names.length === 1;
    this.charts = names.length ? {
      loss: new Chart("Loss", { isLog: true }),
      groups: new Chart(single ? "Loss of each group" : "Loss on other takes", { isLog: true }),
      errors: new Chart("Error on other takes"),
      lr: new Chart("Learning rate"),
      gradient: new Chart("Gradient norm", { isLog: true }),
    } : {};
    this.charts_ = h("div", { class: "charts" }, Object.values(this.charts).map(({ element }) => element));
    this.said = h("details", { open: true }, h("summary", {}, "What it said"), this.log);
    this.section.replaceChildren(this.facts, this.charts_, ...(job ? [this.said] : []));
    this.text = null;
  }

  async refresh(names, active, job) {
    if (this.isAsking) return;
    this.isAsking = true;
    try {
      for (const name of names) {
        const before = this.metrics.get(name);
        if (before && !active(name) && before.isWhole) continue;
        const found = await api.get(`/runs/${encodeURIComponent(name)}/metrics`);
        this.metrics.set(name, { ...found, isWhole: !active(name) });
      }
      if (names.length) this.draw(names);
      const isOver = job && !["queued", "running", "lost"].includes(job.standing.state);
      if (job && !(isOver && this.text === job.standing.ended)) {
        const { text } = await api.get(`/jobs/${job.job.job_id}/log`);
        this.tellLog(text);
        this.text = isOver ? job.standing.ended : null;
      }
    } finally {
      this.isAsking = false;
    }
  }

  tellLog(text) {
    const told = text.trimEnd() || "It said nothing yet.";
    if (this.log.textContent === told) return;
    const isAtEnd = this.log.scrollTop + this.log.clientHeight > this.log.scrollHeight - 30;
    this.log.textContent = told;
    if (isAtEnd) this.log.scrollTop = this.log.scrollHeight;
  }

  draw(names) {
    const of = (name, metric) => this.metrics.get(name)?.curves[metric] ?? { step: [], value: [] };
    const each = (make) => names.flatMap((name, n) => make(name, COLORS[n % COLORS.length], names.length > 1 ? `${name} ` : ""));
    this.charts.loss.show(each((name, color, label) => [
      { label: `${label}training`, color, ...of(name, "loss"), isDashed: names.length > 1 },
      { label: `${label}on others`, color: names.length > 1 ? color : COLORS[1], ...of(name, "validation"), hasPoints: true },
    ]));
    if (names.length === 1) {
      const [name] = names;
      this.charts.groups.show(GROUPS.flatMap((group, n) => [
        { label: group, color: COLORS[n], ...of(name, group) },
        { label: `${group} on others`, color: COLORS[n], ...of(name, `validation_${group}`), isDashed: true, hasPoints: true },
      ]));
      this.charts.errors.show(Object.entries(ERRORS).map(([metric, unit], n) => ({ label: `${LABELS[metric]} ${unit}`, color: COLORS[n], ...of(name, metric), hasPoints: true })));
    } else {
      this.charts.groups.show(each((name, color) => [{ label: name, color, ...of(name, "validation"), hasPoints: true }]));
      this.charts.errors.show(each((name, color) => [{ label: `${name} mm`, color, ...of(name, "position_mm"), hasPoints: true }]));
    }
    this.charts.lr.show(each((name, color) => [{ label: names.length > 1 ? name : "rate", color, ...of(name, "lr") }]));
    this.charts.gradient.show(each((name, color) => [{ label: names.length > 1 ? name : "norm", color, ...of(name, "gradient") }]));
  }

  // Built anew where more than the progress has changed; what was unfolded stays so.
  tell(names, job, runs, evaluations) {
    const found = runs.filter(({ name }) => names.includes(name));
    const tried = evaluations.filter(({ run }) => run === names[0]);
    const told = JSON.stringify([found, job?.standing, evaluations.length, this.metrics.get(names[0])?.damaged]);
    this.progress.replaceChildren(...[job && progressOf(job)].filter(Boolean));
    if (told === this.told) return;
    this.told = told;
    const unfolded = [...this.facts.querySelectorAll("details[open] > summary")].map((summary) => summary.textContent);
    this.facts.replaceChildren(...(names.length > 1 ? [h("h2", {}, `${names.length} runs`), compared(names, found, evaluations)] : this.single(names[0], job, found[0], tried)));
    for (const summary of this.facts.querySelectorAll("summary")) summary.parentElement.open = unfolded.includes(summary.textContent);
  }

  // What a job other than training does, and where to find what came of it.
  asked({ job, progress }) {
    return h("div", {}, h("p", { class: "dim" }, h("code", {}, `studio ${job.command.join(" ")}`), ` on ${placeOf(job)}`),
      job.kind === "demo" && progress?.done > 0 && h("p", {}, h("a", { href: link("/dataset", { task: job.subject, agent: "scripted" }) }, "Look at the takes"), " or ",
        h("button", { class: "link", onclick: () => this.act.train(job.subject) }, "train on them")));
  }

  // A run that no job has made, which goes with it otherwise.
  async remove(name) {
    const path = `/runs/${encodeURIComponent(name)}`;
    await api.del(path);
    toast(`The run ${name} is in the trash.`, { action: { label: "Undo", act: () => attempt(async () => { await api.post(`${path}/restore`); this.act.changed(); }) } });
    this.act.changed();
  }

  single(name, job, run, tried) {
    const isReady = run?.checkpoints.length > 0;
    return [
      h("div", { class: "title" }, h("h2", {}, job?.job.title ?? name),
        isReady && h("button", { class: "main", onclick: () => this.act.evaluate(name) }, "Evaluate…"),
        isReady && h("a", { href: "/", target: "_top", title: "Choose the run as the driver on the studio's first page." }, "Drive with it"),
        run && !job && h("button", { class: "danger", onclick: () => attempt(() => this.remove(name)) }, "Delete")),
      job && h("div", { class: "line" }, h("span", { class: `badge ${job.standing.state}` }, job.standing.state), this.progress),
      job?.standing.why && h("p", { class: "why" }, job.standing.why),
      run?.problem && h("p", { class: "why" }, run.problem),
      job?.job.kind === "train" && !run && h("p", { class: "why" }, `The folder of the run ${name} is gone.`),
      run ? chain(run, job, tried) : job && this.asked(job),
      damaged(this.metrics.get(name)),
    ].filter(Boolean);
  }
}

const damaged = (metrics) => (metrics?.damaged ? h("p", { class: "why" }, `${metrics.damaged} damaged ${metrics.damaged === 1 ? "line" : "lines"} in metrics.jsonl are left out.`) : null);

// Where a run comes from and what came of it: takes -> settings -> code -> machine -> evaluations.
function chain(run, job, tried) {
  const { origin, config } = run;
  const takes = origin.collection
    ? h("a", { href: link("/dataset", { collection: origin.collection }) }, `collection ${origin.collection}`)
    : h("a", { href: link("/dataset", { task: run.task, outcome: "success" }) }, `${run.task}, successful`);
  const code = [origin.versions?.studio && `studio ${origin.versions.studio}`, origin.versions?.commit].filter(Boolean).join(" · ");
  return h("dl", { class: "chain" },
    h("dt", {}, "Learned from"), h("dd", {}, `${run.takes.length} takes of `, takes, h("details", {}, h("summary", {}, "which"), h("ul", {}, run.takes.map((take) => h("li", {},
      h("a", { href: link("/dataset", { episode: take.episode_id }) }, take.episode_id), h("small", { class: "dim" }, take.edit_version ? ` edit ${take.edit_version}` : "")))))),
    h("dt", {}, "Settings"), h("dd", {}, !config.policy ? "unknown" : `${config.policy}, ${config.preset}, ${config.images ? "images" : "no images"}, ${config.wrench ? "F/T" : "no F/T"}, seed ${config.seed}`,
      h("details", {}, h("summary", {}, "all"), h("ul", {}, Object.entries(config).map(([name, value]) => h("li", {}, `${titleOf(name)} `, h("b", {}, valueOf(value))))))),
    code && [h("dt", {}, "Code"), h("dd", {}, code)],
    origin.machine && [h("dt", {}, "Begun on"), h("dd", {}, `${origin.machine.name}, ${origin.machine.cores} cores${origin.created ? `, ${exactDate(origin.created)}` : ""}${origin.author ? `, by ${origin.author}` : ""}`)],
    job && job.job.runner !== HERE && [h("dt", {}, "Learned on"), h("dd", {}, placeOf(job.job))],
    h("dt", {}, "Checkpoints"), h("dd", {}, run.checkpoints.length ? `step ${run.step} of ${run.steps}` : "none yet"),
    tried.length > 0 && [h("dt", {}, "Evaluated"), h("dd", {}, tried.map((told, n) => [n ? ", " : "", evaluated(told), told.step === run.step ? "" : ` at step ${told.step}`]).flat())]);
}

// What tells the runs apart, and how well each learned.
function compared(names, runs, evaluations) {
  const found = names.map((name) => runs.find((run) => run.name === name)).filter(Boolean);
  const differs = [...new Set(found.flatMap((run) => Object.keys(run.config)))].filter((field) => new Set(found.map((run) => JSON.stringify(run.config[field]))).size > 1);
  const newest = (run) => evaluations.find((told) => told.run === run.name);
  const wasTried = found.some(newest);
  return h("div", { class: "scroll" }, h("table", {},
    h("thead", {}, h("tr", {}, ["Run", ...differs.map(titleOf), "Step", "Best on others", ...(wasTried ? ["Success"] : [])].map((text) => h("th", {}, text)))),
    h("tbody", {}, found.map((run, n) => h("tr", {},
      h("td", {}, h("i", { class: "swatch", style: { background: COLORS[n % COLORS.length] } }), run.name),
      differs.map((field) => h("td", { class: "number" }, valueOf(run.config[field]))),
      h("td", { class: "number" }, `${run.step} / ${run.steps}`),
      h("td", { class: "number" }, run.best === null ? "–" : run.best.toFixed(4)),
      wasTried && h("td", { class: "number" }, evaluated(newest(run))))))));
}

const evaluated = (told) => (told ? h("a", { href: link("/train", { tab: "evaluate", evaluation: told.evaluation }), title: date(told.started) }, `${told.successes} of ${told.episodes}`) : "–");
