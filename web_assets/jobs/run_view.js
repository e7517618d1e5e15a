// A closer look at one job, or at the curves of one run or several.

import { api } from "../dataset/api.js";
import { attempt, h } from "../dataset/dom.js";
import { exactDate } from "../dataset/format.js";
import { Chart, COLORS } from "./curves.js";
import { link, titleOf } from "./fields.js";
import { progressOf } from "./job_list.js";
import { placeOf } from "./place.js";

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

  show({ names, job, runs, jobs }) {
    const known = names.filter((name) => runs.some((run) => run.name === name) || job?.job.subject === name);
    const key = JSON.stringify([known, job?.job.job_id]);
    if (key !== this.key) this.build(key, known, job);
    if (!known.length && !job) return;
    this.facts.replaceChildren(...this.told(known, job, runs));
    const active = (name) => runs.find((run) => run.name === name)?.is_learning || jobs.some((now) => now.job.subject === name && now.standing.state === "running");
    attempt(() => this.refresh(known, active, job));
  }

  build(key, names, job) {
    this.close();
    this.key = key;
    if (!names.length && !job) {
      this.section.replaceChildren(h("p", { class: "empty" }, "Open a job or a run to look at it closer: its curves, what it learned from, what it says."));
      return;
    }
    this.facts = h("div", {});
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

  told(names, job, runs) {
    if (names.length > 1) return [h("h2", {}, `${names.length} runs`), compared(names, runs)];
    const run = runs.find(({ name }) => name === names[0]);
    return [
      h("div", { class: "title" }, h("h2", {}, job?.job.title ?? run?.name ?? ""), run?.checkpoints.length ? h("button", { class: "main", onclick: () => this.act.evaluate(run.name) }, "Evaluate…") : null,
        run?.checkpoints.length ? h("a", { href: "/", target: "_top", title: "Choose the run as the driver on the studio's first page." }, "Drive with it") : null),
      job ? h("p", { class: "line" }, h("span", { class: `badge ${job.standing.state}` }, job.standing.state), progressOf(job)) : null,
      run?.problem ? h("p", { class: "why" }, run.problem) : null,
      run ? chain(run) : job ? asked(job) : null,
      damaged(this.metrics.get(names[0])),
    ].filter(Boolean);
  }
}

const damaged = (metrics) => (metrics?.damaged ? h("p", { class: "why" }, `${metrics.damaged} damaged ${metrics.damaged === 1 ? "line" : "lines"} in metrics.jsonl are left out.`) : null);

// What a job other than training does, and where to find what came of it.
function asked({ job, progress }) {
  const query = { task: job.subject, agent: "scripted" };
  return h("div", {}, h("p", { class: "dim" }, h("code", {}, `studio ${job.command.join(" ")}`), ` on ${placeOf(job)}`),
    job.kind === "demo" && progress?.done > 0 ? h("p", {}, h("a", { href: link("/dataset", query) }, "Look at the takes")) : null);
}

// Where a run comes from: takes -> code -> machine -> seed.
function chain(run) {
  const { origin, config } = run;
  const takes = origin.collection
    ? h("a", { href: link("/dataset", { collection: origin.collection }) }, `collection ${origin.collection}`)
    : h("a", { href: link("/dataset", { task: run.task, outcome: "success" }) }, `${run.task}, successful`);
  const code = [origin.versions?.studio && `studio ${origin.versions.studio}`, origin.versions?.commit].filter(Boolean).join(" · ");
  return h("dl", { class: "chain" },
    h("dt", {}, "Learned from"), h("dd", {}, `${run.takes.length} takes of `, takes, h("details", {}, h("summary", {}, "which"), h("ul", {}, run.takes.map((take) => h("li", {},
      h("a", { href: link("/dataset", { episode: take.episode_id }) }, take.episode_id), h("small", { class: "dim" }, take.edit_version ? ` edit ${take.edit_version}` : "")))))),
    h("dt", {}, "Settings"), h("dd", {}, `${config.policy}, ${config.preset}, ${config.images ? "images" : "no images"}, ${config.wrench ? "F/T" : "no F/T"}, seed ${config.seed}`,
      h("details", {}, h("summary", {}, "all"), h("ul", {}, Object.entries(config).map(([name, value]) => h("li", {}, `${titleOf(name)} `, h("b", {}, String(value))))))),
    code && [h("dt", {}, "Code"), h("dd", {}, code)],
    origin.machine && [h("dt", {}, "Begun on"), h("dd", {}, `${origin.machine.name}, ${origin.machine.cores} cores${origin.created ? `, ${exactDate(origin.created)}` : ""}${origin.author ? `, by ${origin.author}` : ""}`)],
    h("dt", {}, "Checkpoints"), h("dd", {}, run.checkpoints.length ? `step ${run.step} of ${run.steps}` : "none yet"));
}

// What tells the runs apart, and how well each learned.
function compared(names, runs) {
  const found = names.map((name) => runs.find((run) => run.name === name)).filter(Boolean);
  const differs = [...new Set(found.flatMap((run) => Object.keys(run.config)))].filter((field) => new Set(found.map((run) => JSON.stringify(run.config[field]))).size > 1);
  return h("div", { class: "scroll" }, h("table", {},
    h("thead", {}, h("tr", {}, h("th", {}, "Run"), differs.map((field) => h("th", {}, titleOf(field))), h("th", {}, "Step"), h("th", {}, "Best on others"))),
    h("tbody", {}, found.map((run, n) => h("tr", {},
      h("td", {}, h("i", { class: "swatch", style: { background: COLORS[n % COLORS.length] } }), run.name),
      differs.map((field) => h("td", { class: "number" }, String(run.config[field]))),
      h("td", { class: "number" }, `${run.step} / ${run.steps}`),
      h("td", { class: "number" }, run.best === null ? "–" : run.best.toFixed(4)))))));
}
