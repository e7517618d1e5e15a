// Elements in a line, and what the page says in passing.

// h("td", {class: "task", onclick}, "wiping", h("b", {}, …)): text is text, never markup.
export function h(tag, props = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "style") Object.assign(element.style, value);
    else if (name in element && typeof value !== "string") element[name] = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

// Whether what has the focus takes letters.
export function isTyping() {
  const { activeElement } = document;
  return !!activeElement?.closest("input:not([type=checkbox], [type=range], [type=radio]), textarea, select, [contenteditable]");
}

const SHOWN = 6000; // [ms] of a toast

// Say something in passing, with a way to take it back: {label, act}.
export function toast(text, { kind = "note", action = null } = {}) {
  const box = h("div", { class: `toast ${kind}` }, h("span", {}, text));
  const leave = () => box.remove();
  if (action) box.append(h("button", { onclick: () => { leave(); action.act(); } }, action.label));
  box.append(h("button", { class: "close", "aria-label": "Dismiss", onclick: leave }, "×"));
  const all = document.getElementById("toasts");
  if (kind === "edit") all.querySelector(".edit")?.remove(); // the newest edit is what one would undo
  all.append(box);
  while (all.children.length > 3) all.firstChild.remove();
  setTimeout(leave, kind === "bad" ? 2 * SHOWN : SHOWN);
}

// Run what may be refused, and tell people why.
export async function attempt(act) {
  try {
    return await act();
  } catch (error) {
    if (error.name !== "AbortError") toast(error.message, { kind: "bad" });
    if (error.status === undefined && error.name !== "AbortError") console.error(error);
    return undefined;
  }
}
