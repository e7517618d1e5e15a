// What to learn: which takes, which settings. The settings are those of the command line, whatever they are.

import { api } from "../dataset/api.js";
import { attempt, h, toast } from "../dataset/dom.js";
import { author, duration, field, fieldOf, form, numberOf, select, setOptions } from "./fields.js";
import { Place } from "./place.js";
import { Sweep } from "./sweep.js";

const FIRST = ["preset", "policy", "images", "wrench", "steps"]; // the rest is folded away by its headings
const EXAMINED = 1000; // takes at most, whose health is told
const PAUSE = 250; // [ms] after the last change before takes are counted again

export class TrainForm {
  // `demonstrate(task)` leads to where takes of a task are made.
  constructor({ started, demonstrate }) {
    Object.assign(this, { started, demonstrate });
    this.fields = {};
    this.task = select("task", [], () => this.chosen());
    this.source = select("source", [["filter", "Successful takes that match"], ["collection", "A collection"]], () => this.chosen());
    this.collection = select("collection", [], () => this.chosen());
    this.operator = select("operator", [["", "anybody"]], () => this.chosen());
    this.agent = select("agent", [["", "any"]], () => this.chosen());
    this.quality = select("min_quality", [["", "any"], ...[1, 2, 3, 4, 5].map((n) => [n, `${n} or better`])], () => this.chosen());
    this.first = h("input", { type: "text", name: "episodes", inputmode: "numeric", placeholder: "all" });
    this.name = h("input", { type: "text", name: "name", placeholder: "task, policy and time", spellcheck: false });
    this.place = new Place({ processes: true });
    this.sweep = new Sweep();
    this.count = h("p", { class: "count", role: "status" });
    this.time = h("p", { class: "count", role: "status" });
    this.byFilter = h("div", { class: "pairs" }, field("Operator", this.operator), field("Agent", this.agent), field("Quality", this.quality), field("First so many", this.first));
    this.byCollection = h("div", { hidden: true }, field("Collection", this.collection));
    this.settings = h("div", {});
    this.button = h("button", { class: "main", type: "submit" }, "Start training");
    this.element = form(this.button, () => this.start(),
      h("h2", {}, "Takes"), field("Task", this.task), field("From", this.source), this.byCollection, this.byFilter, this.count,
      h("h2", {}, "Policy"), this.settings,
      h("h2", {}, "Run"), field("Name", this.name), this.sweep.element, this.place.element,
      this.time,
      h("div", { class: "buttons" }, h("button", { type: "button", onclick: () => attempt(() => this.estimate()) }, "Estimate time"), this.button));
  }

  async load() {
    const [form, tasks, collections] = await Promise.all([api.get("/train-settings"), api.get("/tasks"), api.get("/collections")]);
    this.presets = form.presets;
    const { properties } = form.schema;
    const groups = new Map();
    for (const [name, property] of Object.entries(properties)) {
      if (form.machine.includes(name) && name !== "device") continue;
      this.fields[name] = fieldOf(name, property);
      const group = FIRST.includes(name) ? "" : property.group || "Further";
      groups.set(group, [...(groups.get(group) ?? []), name]);
    }
    const element = (name) => this.fields[name].element;
    this.settings.replaceChildren(
      ...FIRST.map(element),
      ...[...groups].filter(([group]) => group).map(([group, names]) => h("details", {}, h("summary", {}, group), names.map(element))));
    this.fields.preset.element.querySelector("select").addEventListener("change", () => this.usePreset());
    this.settings.addEventListener("input", () => { this.time.textContent = ""; });
    this.usePreset("small");
    this.sweep.load(Object.fromEntries(Object.entries(properties).filter(([name]) => name !== "preset" && !form.machine.includes(name))));
    setOptions(this.task, tasks.map(({ task }) => [task, task]));
    this.offer(collections);
    const { task } = await api.get("/facets");
    const most = Object.entries(task).sort((a, b) => b[1] - a[1])[0];
    if (most) this.task.value = most[0];
    if (this.wanted) this.chooseCollection(this.wanted);
    await this.chosen();
  }

  offer(collections) {
    setOptions(this.collection, collections.map(({ name, members }) => [name, `${name} (${members.length})`]));
  }

  // There may be other takes and collections by now.
  async refresh() {
    if (!this.presets) return; // not loaded yet
    this.offer(await api.get("/collections"));
    await this.chosen();
  }

  choose(task) {
    this.task.value = task;
    this.source.value = "filter";
    this.chosen();
  }

  chooseCollection(name) {
    this.wanted = name;
    this.source.value = "collection";
    this.collection.value = name;
  }

  usePreset(name = this.fields.preset.read()) {
    for (const [field, value] of Object.entries(this.presets[name])) this.fields[field]?.write(value);
  }

  tell() {}

  // Count the takes that are meant, and look at their health.
  async chosen() {
    const isCollection = this.source.value === "collection";
    this.byCollection.hidden = !isCollection;
    this.byFilter.hidden = isCollection;
    clearTimeout(this.waiting);
    this.waiting = setTimeout(() => attempt(() => this.counts(isCollection)), PAUSE);
  }

  async counts(isCollection) {
    if (isCollection && !this.collection.value) return this.says("No collection yet: select takes on the page Dataset and name them.");
    const filters = this.filters();
    const body = { task: this.task.value, ...(isCollection ? { collection: this.collection.value } : Object.keys(filters).length ? { filters } : {}) };
    if (!isCollection) {
      const facets = await api.get("/facets", { task: this.task.value });
      const names = (values) => Object.keys(values).filter((name) => name && name !== "evaluation").map((name) => [name, name]);
      setOptions(this.operator, [["", "anybody"], ...names(facets.operator)]);
      setOptions(this.agent, [["", "any"], ...names(facets.agent)]);
    }
    let rows;
    try {
      rows = await api.post("/train-takes", body);
    } catch (error) {
      if (error.status !== 422) throw error;
      const task = this.task.value;
      return this.says(error.message, isCollection ? null : h("button", { type: "button", class: "link", onclick: () => this.demonstrate(task) }, "Demonstrate…"));
    }
    this.tellTakes(rows, null);
    const episode_ids = rows.slice(0, EXAMINED).map(({ episode_id }) => episode_id);
    return this.tellTakes(rows, await api.post("/dataset-health", { episode_ids }));
  }

  // There is nothing to learn from.
  says(why, more = null) {
    this.count.replaceChildren(why, ...(more ? [" ", more] : []));
    this.count.title = "";
    this.button.disabled = true;
  }

  tellTakes(rows, health) {
    const n = rows.length, successes = rows.filter(({ outcome }) => outcome === "success").length;
    const grades = Object.values(health?.grades ?? {});
    const told = ["good", "fair", "poor"].map((grade) => [grade, grades.filter((other) => other === grade).length]).filter(([, k]) => k);
    this.count.replaceChildren(
      h("b", {}, String(n)), ` ${n === 1 ? "take" : "takes"}, ${minutes(rows)}`, successes === n ? "" : `, ${successes} successful`,
      told.length ? ", health:" : "", ...told.map(([grade, k]) => h("span", { class: `grade ${grade}` }, ` ${k} ${grade}`)));
    this.count.title = health?.together.findings?.map(({ text }) => text).join("\n") ?? "";
    this.button.disabled = false;
  }

  filters() {
    const given = { operator: this.operator.value, agent: this.agent.value, min_quality: this.quality.value && Number(this.quality.value) };
    return Object.fromEntries(Object.entries(given).filter(([, value]) => value));
  }

  config() {
    const preset = this.presets[this.fields.preset.read()];
    const values = Object.entries(this.fields).map(([name, { read }]) => [name, read()]);
    return Object.fromEntries(values.filter(([name, value]) => name !== "preset" && value !== preset[name]));
  }

  body() {
    const body = {
      kind: "train", task: this.task.value, preset: this.fields.preset.read(), config: this.config(), author: author(),
      ...this.place.read(),
    };
    if (this.name.value.trim()) body.name = this.name.value.trim();
    if (this.source.value === "collection") return { ...body, collection: this.collection.value };
    if (this.first.value.trim()) body.episodes = numberOf("First so many", this.first.value);
    const filters = this.filters();
    return Object.keys(filters).length ? { ...body, filters } : body;
  }

  async start() {
    const job = this.body(), fields = this.sweep.read();
    if (fields) {
      const found = await api.post("/sweeps", { job, fields });
      toast(`${found.length} ${found.length === 1 ? "run is" : "runs are"} queued.`);
      this.started(found[0]);
    } else {
      this.started(await api.post("/jobs", job));
    }
    this.name.value = "";
  }

  async estimate() {
    const { task, preset, config, processes, threads } = this.body();
    this.time.textContent = "Measuring some steps…";
    try {
      const told = await api.post("/train-estimate", { task, preset, config, processes, threads });
      const each = told.step_seconds < 1 ? `${Math.round(1e3 * told.step_seconds)} ms` : `${told.step_seconds.toFixed(1)} s`;
      this.time.replaceChildren("About ", h("b", {}, duration(told.seconds)), `: ${each} a step with ${told.threads} thread${told.threads === 1 ? "" : "s"}, as busy as this machine is now`);
    } catch (error) {
      this.time.textContent = "";
      throw error;
    }
  }

  // As a job was asked for.
  fill(job) {
    const { settings } = job;
    this.task.value = settings.task;
    this.source.value = settings.collection ? "collection" : "filter";
    if (settings.collection) this.collection.value = settings.collection;
    this.operator.value = settings.operator ?? "";
    this.agent.value = settings.agent ?? "";
    this.quality.value = settings.min_quality ?? "";
    this.first.value = settings.episodes ?? "";
    for (const [name, value] of Object.entries(settings.config ?? {})) this.fields[name]?.write(value);
    this.place.write(job);
    this.chosen();
    toast("The form has the settings of that run; change them and start.");
  }
}

const minutes = (rows) => duration(rows.reduce((sum, { duration, trim }) => sum + (trim ? trim[1] - trim[0] : duration), 0));
