// What keys do, and the sheet that says so.

import { h } from "./dom.js";

// [keys as they are shown, what they do], in groups. `actions` of main.js has what each does.
export const SHEET = [
  ["Move", [
    ["↑ ↓", "previous, next take"], ["Page ↑ ↓  Home End", "further"], ["Enter", "open the take"], ["Esc", "close it; select nothing"],
    ["/", "search"], ["?", "this sheet"],
  ]],
  ["Say how it was", [
    ["S  F  P", "success, failure, unmarked"], ["1 … 5", "quality, 1 poor to 5 excellent"], ["0", "no quality"],
    ["J", "jittery, on and off"], ["E", "note, flags and more…"], ["U  Ctrl+Z", "undo"],
  ]],
  ["Curate", [
    ["X", "select the take"], ["Shift+↑ ↓", "select a range"], ["Ctrl+A", "select all that match"],
    ["C", "make a collection…"], ["Del", "to the trash"], ["R", "restore, in the trash"],
  ]],
];

const PLAIN = {
  s: ["outcome", "success"], f: ["outcome", "failure"], p: ["outcome", "unmarked"],
  j: ["flag", "jittery"], e: ["edit"], u: ["undo"], x: ["toggle"], c: ["collect"], r: ["restore"], 0: ["rate", null],
  "/": ["search"], "?": ["help"], Enter: ["open"], Escape: ["close"], Delete: ["remove"], Backspace: ["remove"],
  ArrowUp: ["move", -1], ArrowDown: ["move", 1], PageUp: ["page", -1], PageDown: ["page", 1], Home: ["end", -1], End: ["end", 1],
};
for (const n of [1, 2, 3, 4, 5]) PLAIN[n] = ["rate", n];

// [what to do, with what] of a key press; null for all others.
export function meaningOf(event) {
  const isCommand = event.ctrlKey || event.metaKey;
  if (event.altKey) return null;
  if (isCommand) {
    const key = event.key.toLowerCase();
    return key === "z" && !event.shiftKey ? ["undo"] : key === "a" ? ["selectAll"] : null;
  }
  if (event.shiftKey && event.key.startsWith("Arrow")) {
    return { ArrowUp: ["extend", -1], ArrowDown: ["extend", 1] }[event.key] ?? null;
  }
  return PLAIN[event.key.length === 1 ? event.key.toLowerCase() : event.key] ?? null;
}

// With what keys do in an open take, as its view says.
export function sheet(ofTake) {
  return h("div", { class: "sheet" }, [...SHEET, ["In an open take", ofTake]].map(([title, lines]) => h("section", {},
    h("h3", {}, title),
    h("dl", {}, lines.flatMap(([keys, words]) => [
      h("dt", {}, keys.split("  ").flatMap((part) => part.split(" ").map((key) => (key === "…" ? " … " : h("kbd", {}, key))))),
      h("dd", {}, words),
    ])))));
}
