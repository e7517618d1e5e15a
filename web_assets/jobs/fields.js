// Parts of the forms: a labelled field, a choice, and a form made of a JSON schema.

import { attempt, h } from "../dataset/dom.js";

let numbers = 0;

// A label before what it names; `help` is told below it, `flag` is its name on the command line.
export function field(label, control, help = "", flag = "") {
  control.id ||= `field-${(numbers += 1)}`;
  const text = help && h("small", { id: `${control.id}-help` }, help);
  if (text) control.setAttribute("aria-describedby", text.id);
  const name = h("span", { class: "name" }, h("label", { for: control.id }, label), flag && h("code", { title: "On the command line" }, flag));
  return h("div", { class: control.type === "checkbox" ? "field check" : "field" }, name, control, text);
}

// `submit` rests while `start` is under way; why it was refused is told.
export function form(submit, start, ...children) {
  const resting = async () => {
    submit.disabled = true;
    try {
      await start();
    } finally {
      submit.disabled = false;
    }
  };
  return h("form", { onsubmit: (event) => { event.preventDefault(); attempt(resting); } }, ...children);
}

// options: [[value, text], …]
export function select(name, options, onchange) {
  const control = h("select", { name, onchange });
  setOptions(control, options);
  return control;
}

export function setOptions(control, options) {
  const told = JSON.stringify(options);
  if (control.dataset.told === told) return; // what has the focus stays as it is
  const before = control.value;
  control.dataset.told = told;
  control.replaceChildren(...options.map(([value, text]) => h("option", { value }, text)));
  if (options.some(([value]) => value === before)) control.value = before;
}

const titles = new Map(); // of the settings of training, by their names

export const titleOf = (name) => titles.get(name) ?? name.replaceAll("_", " ");

export const valueOf = (value) => ({ true: "yes", false: "no", null: "–" })[value] ?? String(value);

// Of one property of a JSON schema: {element, read(): value, write(value)}.
export function fieldOf(name, property) {
  const types = property.anyOf?.map((part) => part.type) ?? [property.type];
  const isOptional = types.includes("null");
  const { title, unit, flag, description } = property;
  titles.set(name, title);
  const labelled = (control) => field(title + (unit && ` [${unit}]`), control, description, flag);
  if (property.enum) {
    const control = select(name, property.enum.map((value) => [value, value]));
    return { element: labelled(control), read: () => control.value, write: (value) => { control.value = value; } };
  }
  if (types.includes("boolean")) {
    const control = h("input", { type: "checkbox", name });
    return { element: labelled(control), read: () => control.checked, write: (value) => { control.checked = value; } };
  }
  const isNumber = types.includes("number") || types.includes("integer");
  const control = h("input", { type: "text", name, inputmode: isNumber ? "decimal" : "text", placeholder: isOptional ? "not given" : "", spellcheck: false });
  const read = () => {
    const text = control.value.trim();
    if (text === "" && isOptional) return null;
    return isNumber ? numberOf(title, text) : text;
  };
  return { element: labelled(control), read, write: (value) => { control.value = value ?? ""; } };
}

export function numberOf(label, text) {
  const value = Number(text);
  if (text.trim() === "" || !Number.isFinite(value)) throw new Error(`${label} must be a number, not “${text}”.`);
  return value;
}

// Put these in, where they are not there already: what is pressed or has the focus stays.
export function keep(parent, children) {
  const found = children.filter(Boolean);
  if (found.length !== parent.childNodes.length || found.some((child, n) => child !== parent.childNodes[n])) parent.replaceChildren(...found);
}

// The name under which a person asks, as on the dataset page; `known` is the one that the studio gave.
export const author = () => localStorage.getItem("studio.author") || author.known || "guest";

// The address of another page of ours; beside the 3-D view it stays beside it.
export function link(path, query = {}) {
  const given = new URLSearchParams(location.search), told = new URLSearchParams(query);
  if (given.has("embed")) for (const name of ["embed", "view"]) if (given.has(name)) told.set(name, given.get(name));
  const text = told.toString();
  return path + (text && `?${text}`);
}

// [s] as people say it
export function duration(s) {
  if (s < 90) return `${Math.max(1, Math.round(s))} s`;
  if (s < 90 * 60) return `${Math.round(s / 60)} min`;
  return s < 48 * 3600 ? `${(s / 3600).toFixed(1)} h` : `${(s / 86400).toFixed(1)} days`;
}
