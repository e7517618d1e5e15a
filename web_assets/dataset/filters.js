// The left side: where to look (all takes, collections, the trash), and what to ask for, with counts.

import { h } from "./dom.js";
import * as format from "./format.js";

const GROUPS = [["task", "Task"], ["outcome", "Outcome"], ["quality", "Quality"], ["flags", "Flags"], ["operator", "Operator"], ["agent", "Driven by"]];
const FEW = 6; // values of a group that are shown at first

export class Filters {
  #api; #container; #onChange; #onSource; #open = new Set();
  #facets = {}; #collections = []; #trash = 0; #filters = {}; #source = { kind: "all" }; #total = 0;

  constructor(container, api, { onChange, onSource }) {
    [this.#container, this.#api, this.#onChange, this.#onSource] = [container, api, onChange, onSource];
  }

  get collections() { return this.#collections; }

  // Count anew. Each group is counted as if it asked for nothing itself, so that one sees what else there is.
  async load(filters, source) {
    const without = (name) => Object.fromEntries(Object.entries(filters).filter(([key]) => key !== name));
    const own = { task: "task", outcome: "outcome", quality: "min_quality", operator: "operator", agent: "agent" };
    const active = Object.entries(own).filter(([, name]) => filters[name]);
    const [facets, all, collections, trash, ...others] = await Promise.all([
      this.#api.get("/facets", filters), this.#api.get("/amount"), this.#api.get("/collections"), this.#api.get("/trash"),
      ...active.map(([, name]) => this.#api.get("/facets", without(name))),
    ]);
    active.forEach(([group], index) => { facets[group] = others[index][group]; });
    [this.#facets, this.#collections, this.#trash, this.#total] = [facets, collections, trash.length, all.takes];
    [this.#filters, this.#source] = [filters, source];
    this.#draw();
  }

  #draw() {
    const { kind, name } = this.#source;
    const place = (words, n, source, isHere) => h("button", {
      class: isHere ? "here" : "", onclick: () => this.#onSource(source), title: words,
    }, h("span", {}, words), h("small", {}, format.count(n)));
    const scroll = this.#container.scrollTop;
    this.#container.replaceChildren(
      h("nav", {},
        place("All takes", this.#total, { kind: "all" }, kind === "all"),
        place("Trash", this.#trash, { kind: "trash" }, kind === "trash")),
      this.#collections.length ? h("h2", {}, "Collections") : "",
      h("nav", { class: "collections" }, this.#collections.map((found) => place(
        found.name, found.members.length, { kind: "collection", name: found.name }, kind === "collection" && name === found.name,
      ))),
      ...(kind === "all" ? GROUPS.map(([key, words]) => this.#group(key, words)) : []),
    );
    this.#container.scrollTop = scroll;
  }

  #group(key, words) {
    const entries = this.#entries(key);
    if (!entries.length) return "";
    const most = Math.max(...entries.map(([, n]) => n));
    const isOpen = this.#open.has(key);
    const shown = isOpen ? entries : entries.slice(0, FEW);
    return h("section", { class: "group" },
      h("h2", {}, words),
      shown.map(([value, n]) => this.#choice(key, value, n, most)),
      entries.length > FEW && h("button", {
        class: "more", onclick: () => { isOpen ? this.#open.delete(key) : this.#open.add(key); this.#draw(); },
      }, isOpen ? "fewer" : `${entries.length - FEW} more`));
  }

  // [value, count]; a quality counts all that are at least as good, as its filter does.
  #entries(key) {
    const counted = this.#facets[key] ?? {};
    if (key === "outcome") return format.OUTCOMES.map((name) => [name, counted[name] ?? 0]).filter(([, n]) => n);
    if (key !== "quality") return Object.entries(counted);
    let sum = 0;
    const entries = [5, 4, 3, 2, 1].map((q) => [`${q}`, sum += counted[q] ?? 0]);
    return sum ? entries.filter(([, n]) => n) : [];
  }

  #choice(key, value, n, most) {
    const isChosen = key === "flags" ? this.#filters.flags?.includes(value) : this.#filters[nameOf(key)] === value;
    const words = key === "quality" ? (value === "5" ? "5" : `${value} or better`) : format.words(value);
    return h("button", {
      class: `choice${isChosen ? " chosen" : ""}`, "aria-pressed": isChosen ? "true" : "false", title: words,
      onclick: () => this.#onChange(this.#toggled(key, value, isChosen)),
    }, h("i", { style: { width: `${(100 * n) / most}%` } }), h("span", {}, words), h("small", {}, format.count(n)));
  }

  #toggled(key, value, isChosen) {
    const filters = { ...this.#filters };
    if (key === "flags") {
      const others = (filters.flags ?? []).filter((flag) => flag !== value);
      filters.flags = isChosen ? others : [...others, value];
      if (!filters.flags.length) delete filters.flags;
    } else if (isChosen) delete filters[nameOf(key)];
    else filters[nameOf(key)] = value;
    return filters;
  }
}

const nameOf = (key) => (key === "quality" ? "min_quality" : key);

// The filters as words that one can take off: [words, filters without].
export function chips(filters) {
  return Object.entries(filters).flatMap(([name, value]) => {
    const rest = Object.fromEntries(Object.entries(filters).filter(([key]) => key !== name));
    if (name !== "flags") {
      const words = { min_quality: `quality ≥ ${value}`, text: `“${value}”`, seed: `seed ${value}` }[name] ?? format.words(value);
      return [[words, rest]];
    }
    return value.map((flag) => {
      const others = value.filter((other) => other !== flag);
      return [format.words(flag), others.length ? { ...filters, flags: others } : rest];
    });
  });
}
