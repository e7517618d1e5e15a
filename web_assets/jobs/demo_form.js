// Scripted demonstrations: of which task, and of which scenes.

import { api } from "../dataset/api.js";
import { h, toast } from "../dataset/dom.js";
import { author, field, form, numberOf, select, setOptions } from "./fields.js";
import { Place } from "./place.js";

export class DemoForm {
  constructor({ started }) {
    this.started = started;
    this.task = select("task", [], () => this.chosen());
    this.seed = h("input", { type: "text", name: "seed", inputmode: "numeric", value: "0" });
    this.episodes = h("input", { type: "text", name: "episodes", inputmode: "numeric", value: "30" });
    this.workers = h("input", { type: "text", name: "workers", inputmode: "numeric", value: "1" });
    this.cameras = h("input", { type: "checkbox", name: "cameras", checked: true });
    this.spread = h("input", { type: "text", name: "spread", inputmode: "decimal", value: "1" });
    this.place = new Place();
    this.instruction = h("p", { class: "count" });
    this.button = h("button", { class: "main", type: "submit" }, "Start recording");
    this.element = form(this.button, () => this.start(),
      h("h2", {}, "Task"), field("Task", this.task), this.instruction,
      h("h2", {}, "Scenes"),
      h("div", { class: "pairs" }, field("First seed", this.seed), field("How many", this.episodes)),
      field("Spread", this.spread, "Above 1 widens the task's randomisation."),
      field("Images", this.cameras, "Of all cameras; they take most of the time."),
      field("Workers", this.workers, "Processes that record side by side."),
      this.place.element,
      h("p", { class: "count" }, "The task's script demonstrates, without a screen. Its takes lie beside those of people; their agent is “scripted”."),
      h("div", { class: "buttons" }, this.button));
  }

  async load() {
    this.tasks = await api.get("/tasks");
    setOptions(this.task, this.tasks.map(({ task }) => [task, task]));
    this.chosen();
  }

  tell() {}

  chosen() {
    this.instruction.textContent = this.tasks.find(({ task }) => task === this.task.value)?.instruction ?? "";
  }

  choose(task) {
    this.task.value = task;
    this.chosen();
    this.episodes.focus();
  }

  async start() {
    const body = {
      kind: "demo", task: this.task.value, author: author(), ...this.place.read(),
      seed: numberOf("First seed", this.seed.value), episodes: numberOf("How many", this.episodes.value),
      workers: numberOf("Workers", this.workers.value), spread: numberOf("Spread", this.spread.value), cameras: this.cameras.checked,
    };
    this.started(await api.post("/jobs", body));
  }

  fill(job) {
    for (const name of ["task", "seed", "episodes", "workers", "spread"]) this[name].value = job.settings[name];
    this.cameras.checked = job.settings.cameras;
    this.place.write(job);
    this.chosen();
    toast("The form has the settings of that job; change them and start.");
  }
}
