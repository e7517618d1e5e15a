// What to roll out: which checkpoint or reference, on which scenes.

import { api } from "../dataset/api.js";
import { h, toast } from "../dataset/dom.js";
import { author, field, form, numberOf, select, setOptions } from "./fields.js";
import { Place } from "./place.js";

export class EvaluateForm {
  constructor({ started }) {
    this.started = started;
    [this.runs, this.references] = [[], []];
    this.agent = select("agent", [], () => this.chosen());
    this.which = select("which", [["last", "last"]]);
    this.task = select("eval_task", []);
    this.seed = h("input", { type: "text", name: "seed", inputmode: "numeric", value: "1000" });
    this.episodes = h("input", { type: "text", name: "eval_episodes", inputmode: "numeric", value: "20" });
    this.workers = h("input", { type: "text", name: "workers", inputmode: "numeric", value: "1" });
    this.execution = select("execution", [["replan", "play each chunk until the next"], ["ensemble", "average of all chunks"]]);
    this.replan_every = h("input", { type: "text", name: "replan_every", inputmode: "numeric", placeholder: "10, or 1 for the average" });
    this.device = select("eval_device", [["cpu", "cpu"], ["cuda", "cuda"]]);
    this.spread = h("input", { type: "text", name: "spread", inputmode: "decimal", value: "1" });
    this.cameras = h("input", { type: "checkbox", name: "cameras" });
    this.hide = ["images", "wrench", "objects"].map((name) => h("input", { type: "checkbox", name: `hide_${name}`, value: name }));
    this.hidden = h("details", {}, h("summary", {}, "Execution, and what is hidden from it"),
      field("Execution", this.execution), field("Ask again after [steps]", this.replan_every), field("Device", this.device, "Of the policy."),
      field("Spread", this.spread, "Above 1 widens the task's randomisation."),
      ...this.hide.map((box) => field(`Hide ${box.value}`, box)), field("Record images", this.cameras, "Although the agent needs none."));
    this.place = new Place();
    this.taskField = field("Task", this.task);
    this.whichField = field("Checkpoint", this.which);
    this.button = h("button", { class: "main", type: "submit" }, "Start evaluation");
    this.element = form(this.button, () => this.start(),
      h("h2", {}, "Agent"), field("Run or reference", this.agent), this.whichField, this.taskField,
      h("h2", {}, "Scenes"),
      h("div", { class: "pairs" }, field("First seed", this.seed), field("How many", this.episodes)),
      field("Workers", this.workers, "Processes that roll out side by side."),
      this.hidden, this.place.element,
      h("p", { class: "count" }, "Two evaluations on the same seeds meet the same scenes, and can be compared pair by pair."),
      h("div", { class: "buttons" }, this.button));
  }

  async load() {
    const [tasks, references] = await Promise.all([api.get("/tasks"), api.get("/references")]);
    this.references = references.map((name) => [name, `${name} (reference)`]);
    setOptions(this.task, tasks.map(({ task }) => [task, task]));
  }

  tell({ runs }) {
    this.runs = runs.filter((run) => run.checkpoints.length);
    setOptions(this.agent, [...this.runs.map((run) => [run.name, `${run.name} · ${run.task}`]), ...this.references]);
    this.chosen();
  }

  get run() {
    return this.runs.find((run) => run.name === this.agent.value);
  }

  chosen() {
    this.taskField.hidden = !!this.run;
    this.whichField.hidden = !this.run;
    setOptions(this.which, (this.run?.checkpoints ?? []).map((name) => [name, /^\d/.test(name) ? `step ${Number(name)}` : name]).reverse());
    for (const box of this.hide) box.disabled = !this.run;
  }

  choose(name) {
    this.agent.value = name;
    this.chosen();
    this.agent.focus();
  }

  async start() {
    const body = {
      kind: "evaluate", agent: this.agent.value, author: author(), ...this.place.read(),
      seed: numberOf("First seed", this.seed.value), episodes: numberOf("How many", this.episodes.value), workers: numberOf("Workers", this.workers.value),
      execution: this.execution.value, spread: numberOf("Spread", this.spread.value), cameras: this.cameras.checked,
    };
    if (this.run) {
      Object.assign(body, { which: this.which.value, device: this.device.value, hide: this.hide.filter((box) => box.checked).map((box) => box.value) });
      if (this.replan_every.value.trim()) body.replan_every = numberOf("Ask again after", this.replan_every.value);
    } else {
      body.task = this.task.value;
    }
    this.started(await api.post("/jobs", body));
  }

  fill(job) {
    const { settings } = job;
    this.agent.value = settings.agent;
    this.chosen();
    this.task.value = settings.task;
    for (const name of ["which", "seed", "episodes", "workers", "execution", "replan_every", "device", "spread"]) if (name in settings) this[name].value = settings[name] ?? "";
    for (const box of this.hide) box.checked = settings.hide.includes(box.value);
    this.cameras.checked = settings.cameras;
    this.place.write(job);
    toast("The form has the settings of that evaluation; change them and start.");
  }
}
