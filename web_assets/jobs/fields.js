// Parts of the forms: a labelled field, a choice, and a form made of a JSON schema.

import { h } from "../dataset/dom.js";

let numbers = 0;

// A label before what it names; `help` is told below it.
export function field(label, control, help = "") {
  control.id ||= `field-${(numbers += 1)}`;
  const text = help && h("small", { id: `${control.id}-help` }, help);
  if (text) control.setAttribute("aria-describedby", text.id);
  return h("div", { class: control.type === "checkbox" ? "field check" : "field" }, h("label", { for: control.id }, label), control, text);
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

const words = (name) => name.replaceAll("_", " ").replace(/^./, (letter) => letter.toUpperCase());

// Of one property of a JSON schema: {label, element, read(): value, write(value)}.
export function fieldOf(name, property) {
  const types = property.anyOf?.map((part) => part.type) ?? [property.type];
  const isOptional = types.includes("null");
  if (property.enum) {
    const control = select(name, property.enum.map((value) => [value, value]));
    return { element: field(words(name), control, property.description), read: () => control.value, write: (value) => { control.value = value; } };
  }
  if (types.includes("boolean")) {
    const control = h("input", { type: "checkbox", name });
    return { element: field(words(name), control, property.description), read: () => control.checked, write: (value) => { control.checked = value; } };
  }
  const isNumber = types.includes("number") || types.includes("integer");
  const control = h("input", { type: "text", name, inputmode: isNumber ? "decimal" : "text", placeholder: isOptional ? "as above" : "", spellcheck: false });
  const read = () => {
    const text = control.value.trim();
    if (text === "" && isOptional) return null;
    return isNumber ? numberOf(words(name), text) : text;
  };
  return { element: field(words(name), control, property.description), read, write: (value) => { control.value = value ?? ""; } };
}

export function numberOf(label, text) {
  const value = Number(text);
  if (text.trim() === "" || !Number.isFinite(value)) throw new Error(`${label} must be a number, not “${text}”.`);
  return value;
}

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
