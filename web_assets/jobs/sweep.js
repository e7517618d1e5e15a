// A run for each combination of the values of some settings.

import { h } from "../dataset/dom.js";
import { field, numberOf, select } from "./fields.js";

const EXAMPLES = { boolean: "yes, no", integer: "0, 1, 2", number: "1e-4, 5e-4", string: "" };
const WORDS = { yes: true, true: true, no: false, false: false };

export class Sweep {
  constructor() {
    this.rows = [];
    this.count = h("p", { class: "count" });
    this.element = h("div", { class: "sweep", oninput: () => this.tell() });
  }

  // `properties` of a JSON schema: what can be swept.
  load(properties) {
    this.properties = properties;
    this.element.replaceChildren(this.count);
    this.add();
  }

  // There is always one more line than settings are swept.
  add() {
    const options = Object.entries(this.properties).map(([name, { title, flag }]) => [name, `${title} ${flag}`]);
    const by = select("sweep", [["", "no sweep"], ...options], () => this.chosen(row));
    const values = h("input", { type: "text", name: "sweep_values", "aria-label": "Values to sweep over", spellcheck: false, hidden: true });
    const row = { by, values, element: h("div", {}, field(this.rows.length ? "And over" : "Sweep over", by), values) };
    this.rows.push(row);
    this.count.before(row.element);
  }

  chosen(row) {
    const name = row.by.value;
    row.values.hidden = !name;
    if (name) row.values.placeholder = `values, e.g. ${this.properties[name].enum?.join(", ") ?? EXAMPLES[typeOf(this.properties[name])]}`;
    if (this.rows.at(-1).by.value) this.add();
    this.tell();
  }

  tell() {
    const counts = this.rows.filter(({ by }) => by.value).map(({ values }) => split(values.value).length);
    const n = counts.reduce((product, count) => product * count, 1);
    this.count.textContent = counts.length && n ? `${n} ${n === 1 ? "run" : "runs"}, one after the other.` : "";
  }

  // {lr: [1e-4, 5e-4], …}; null where nothing is swept.
  read() {
    const asked = this.rows.filter(({ by }) => by.value).map(({ by, values }) => [by.value, split(values.value).map((text) => this.value(by.value, text))]);
    for (const [name, values] of asked) if (!values.length) throw new Error(`Tell the values of ${this.properties[name].title} to sweep over, with commas between them.`);
    return asked.length ? Object.fromEntries(asked) : null;
  }

  value(name, text) {
    const type = typeOf(this.properties[name]);
    if (type === "string") return text;
    if (type !== "boolean") return numberOf(this.properties[name].title, text);
    if (!(text in WORDS)) throw new Error(`${this.properties[name].title} is yes or no, not “${text}”.`);
    return WORDS[text];
  }
}

const split = (text) => text.split(",").map((part) => part.trim()).filter(Boolean);

const typeOf = ({ type, anyOf }) => type ?? anyOf?.find((part) => part.type !== "null").type ?? "string";
