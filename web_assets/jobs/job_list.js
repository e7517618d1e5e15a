// Everything that was asked for, with how far it is; below it, the runs or evaluations that there are.

import { api } from "../dataset/api.js";
import { attempt, h, toast } from "../dataset/dom.js";
import { date, exactDate } from "../dataset/format.js";
import { duration, keep, titleOf, valueOf } from "./fields.js";
import { placeOf } from "./place.js";

const ACTIVE = ["queued", "running", "lost"];
const KINDS = { demo: ["demo"], train: ["train", "export"], evaluate: ["evaluate"] }; // that each view lists, besides what runs
const SIGNS = { queued: "◷", running: "▶", done: "✓", failed: "✗", cancelled: "–", interrupted: "!", lost: "?" };

export class JobList {
  constructor(section, act) {
    this.act = act;
    this.rows = new Map(); // of each job: {told, element, progress}
    this.jobs = h("div", { class: "list" });
    this.results = h("div", { class: "list" });
    this.trash = h("button", { class: "link", onclick: () => attempt(() => this.showTrash()) }, "Trash");
    section.append(h("div", { class: "title" }, h("h2", {}, "Jobs"), this.trash), this.jobs, this.results);
  }

  show({ view, jobs, runs, evaluations, chosen }) {
    const isOf = ({ job, standing }) => ACTIVE.includes(standing.state) || job.job_id === chosen.job || KINDS[view].includes(job.kind);
    jobs = jobs.filter(isOf);
    this.nothing ??= h("p", { class: "dim" }, "Nothing was asked for yet.");
    keep(this.jobs, jobs.length ? jobs.map((now) => this.row(now, chosen)) : [this.nothing]);
    const told = JSON.stringify([view, runs.map(({ name, step, steps, best, problem }) => [name, step, steps, best, problem]), evaluations.length, chosen]);
    if (told === this.told) return;
    this.told = told;
    const results = { demo: () => [], train: () => this.runsOf(runs, chosen), evaluate: () => this.evaluationsOf(evaluations, chosen) };
    const focused = document.activeElement?.dataset.key;
    this.results.replaceChildren(...results[view]());
    if (focused) document.querySelector(`[data-key="${CSS.escape(focused)}"]`)?.focus();
  }

  // Built anew where more than its progress has changed.
  row(now, chosen) {
    const isHere = chosen.job === now.job.job_id;
    const told = JSON.stringify([now.standing, isHere]);
    let row = this.rows.get(now.job.job_id);
    if (row?.told !== told) {
      const progress = h("div", { class: "how-far" });
      row = { told, progress, element: this.built(now, progress, isHere) };
      this.rows.set(now.job.job_id, row);
    }
    row.progress.replaceChildren(...[progressOf(now)].filter(Boolean));
    return row.element;
  }

  built(now, progress, isHere) {
    const { job, standing } = now;
    return h("article", { class: `job ${standing.state}${isHere ? " here" : ""}`, "data-job": job.job_id },
      h("button", { class: "name", "aria-current": isHere ? "true" : null, onclick: () => this.act.open(job.job_id) },
        h("i", { "aria-hidden": "true" }, SIGNS[standing.state]), h("b", {}, job.title), sweptOf(job)),
      h("span", { class: "state", title: standing.why }, standing.state),
      h("span", { class: "when", title: exactDate(job.created) }, `${date(job.created)} · ${job.author} · ${placeOf(job)}`),
      progress,
      standing.why && h("p", { class: "why" }, standing.why),
      h("div", { class: "acts" }, this.actsOf(now)));
  }

  actsOf(now) {
    const { job, standing } = now;
    const isActive = ACTIVE.includes(standing.state);
    const post = (verb, text) => () => attempt(async () => { await api.post(`/jobs/${job.job_id}/${verb}`); if (text) toast(text); this.act.changed(); });
    return [
      isActive && h("button", { onclick: post("cancel", job.kind === "train" && standing.state === "running" ? "It saves a checkpoint, then ends." : null) }, "Cancel"),
      !isActive && standing.state !== "done" && h("button", { onclick: post("resume") }, job.kind === "train" ? "Resume" : "Again"),
      job.kind !== "export" && h("button", { onclick: () => this.act.again(now) }, "Duplicate…"),
      job.kind === "train" && job.sweep && h("button", { title: "The curves of all runs of this sweep", onclick: () => this.act.openSweep(job.sweep) }, "Compare"),
      !isActive && h("button", { class: "danger", onclick: () => attempt(() => this.remove(job)) }, "Delete"),
    ];
  }

  async remove(job) {
    await api.del(`/jobs/${job.job_id}`);
    const undo = { label: "Undo", act: () => attempt(async () => { await api.post(`/jobs/${job.job_id}/restore`); this.act.changed(); }) };
    toast(`${job.title} is in the trash${job.kind === "train" ? ", with its run" : ""}.`, { action: undo });
    this.act.changed();
  }

  async showTrash() {
    const found = await api.get("/jobs-trash");
    if (!found.length) return toast("The trash is empty.");
    const dialog = h("dialog", {}, h("header", {}, h("h2", {}, "Deleted jobs"), h("button", { class: "close", "aria-label": "Close", onclick: () => dialog.close() }, "×")),
      h("div", { class: "content" }, found.map((job) => h("p", { class: "trashed" }, h("span", {}, job.title, h("small", { class: "dim" }, ` ${date(job.created)}`)),
        h("button", { onclick: () => attempt(async () => { await api.post(`/jobs/${job.job_id}/restore`); dialog.close(); this.act.changed(); }) }, "Restore")))));
    dialog.addEventListener("close", () => dialog.remove());
    document.body.append(dialog);
    return dialog.showModal();
  }

  runsOf(runs, chosen) {
    if (!runs.length) return [];
    return [h("div", { class: "title" }, h("h2", {}, "Runs"), h("small", { class: "dim" }, "tick several to compare their curves")),
      h("table", {}, h("thead", {}, h("tr", {}, ["", "Run", "Step", "Loss on others"].map((text) => h("th", {}, text)))),
        h("tbody", {}, runs.map((run) => h("tr", { class: chosen.runs.includes(run.name) ? "here" : "" },
          h("td", {}, h("input", { type: "checkbox", "data-key": `tick ${run.name}`, "aria-label": `Compare ${run.name}`, checked: chosen.runs.includes(run.name), onchange: () => this.act.openRun(run.name, true) })),
          h("td", {}, h("button", { class: "link", "data-key": `run ${run.name}`, title: run.problem, onclick: () => this.act.openRun(run.name, false) }, run.name), run.problem && h("span", { class: "why" }, " ▲"),
            h("small", { class: "dim" }, `${run.task}, ${run.takes.length} takes`)),
          h("td", { class: "number" }, `${run.step} / ${run.steps}`),
          h("td", { class: "number" }, run.best === null ? "–" : run.best.toFixed(4))))))];
  }

  evaluationsOf(evaluations, chosen) {
    if (!evaluations.length) return [];
    return [h("div", { class: "title" }, h("h2", {}, "Evaluations")),
      h("table", {}, h("thead", {}, h("tr", {}, ["Agent", "Success", "95 %", "Force"].map((text) => h("th", {}, text)))),
        h("tbody", {}, evaluations.map((told) => h("tr", { class: chosen.evaluation === told.evaluation ? "here" : "" },
          h("td", {}, h("button", { class: "link", "data-key": told.evaluation, onclick: () => this.act.openEvaluation(told.evaluation) }, told.label),
            h("small", { class: "dim" }, [told.task, told.step && `step ${told.step}`, date(told.started)].filter(Boolean).join(", "))),
          h("td", { class: "number" }, `${told.successes} / ${told.episodes}`),
          h("td", { class: "number" }, interval(told.wilson_95)),
          h("td", { class: "number" }, `${told.force_mean_N.toFixed(1)} N`)))))];
  }
}

export const interval = ([low, high]) => `${Math.round(100 * low)}–${Math.round(100 * high)} %`;

const sweptOf = ({ swept }) => Object.entries(swept).flatMap(([name, value]) => [" ", h("span", { class: "tag" }, `${titleOf(name)} ${valueOf(value)}`)]);

const WHAT = { train: "steps", evaluate: "rollouts", demo: "takes", export: "%" };

export function progressOf({ job, standing, progress, seconds_left: left }) {
  if (!progress || standing.state === "queued") return null;
  const share = progress.total ? Math.min(1, progress.done / progress.total) : 0;
  const done = job.kind === "export" ? `${Math.round(100 * share)} %` : `${Math.round(progress.done)} of ${Math.round(progress.total)} ${WHAT[job.kind]}`;
  const rest = standing.state !== "running" ? "" : left ? `, ${duration(left)} left` : progress.what ? `, ${progress.what}` : share === 1 ? ", ends" : ", begins";
  return h("div", { class: "progress", title: progress.what },
    h("div", { class: "track", role: "progressbar", "aria-valuenow": Math.round(100 * share), "aria-valuemin": 0, "aria-valuemax": 100, "aria-label": job.title }, h("i", { style: { width: `${100 * share}%` } })),
    h("small", {}, done + rest));
}
