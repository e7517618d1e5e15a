// Questions over the page: an edit with everything, a collection, help. Each ends with Escape.

import { attempt, h } from "./dom.js";
import * as format from "./format.js";
import { sheet } from "./keys.js";
import { subject } from "./edits.js";

// Show a dialog; `act` is called by its main button, and the dialog ends when that went well.
export function ask(title, content, { button = null, act = null, kind = "", onClose = () => {} } = {}) {
  const dialog = h("dialog", { class: kind });
  const form = h("form", { method: "dialog", onsubmit: async (event) => {
    event.preventDefault();
    const submit = form.querySelector("button.main");
    if (submit) submit.disabled = true;
    const isDone = act ? await attempt(async () => (await act(new FormData(form))) ?? true) : true;
    if (submit) submit.disabled = false;
    if (isDone) dialog.close();
  } });
  form.append(
    h("header", {}, h("h2", {}, title), h("button", { type: "button", class: "close", "aria-label": "Close", onclick: () => dialog.close() }, "×")),
    h("div", { class: "content" }, content),
  );
  if (button) {
    form.append(h("footer", {},
      h("button", { type: "button", onclick: () => dialog.close() }, "Cancel"),
      h("button", { class: "main" }, button)));
  }
  dialog.append(form);
  dialog.addEventListener("close", () => { dialog.remove(); onClose(); });
  dialog.addEventListener("keydown", (event) => {
    event.stopPropagation();
    if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) form.requestSubmit();
  });
  document.body.append(dialog);
  dialog.showModal();
  return dialog;
}

export function help(ofTake) {
  ask("Keys", [sheet(ofTake), h("p", { class: "dim" }, "Keys are letters again while you type. With takes selected, they are about all of those; with a take open, about that one.")], { kind: "wide" });
}

// Outcome, quality, flags and note of some takes at once. `say(changes, words)` makes the edit.
export function edit(rows, flags, say) {
  const one = rows.length === 1 ? rows[0] : null;
  const choice = (name, values, chosen) => h("div", { class: "choices" }, values.map(([value, words]) => h("label", {},
    h("input", { type: "radio", name, value, checked: value === chosen }), h("span", {}, words))));
  const kept = one ? [] : [["", "as it is"]];
  const has = (flag) => rows.filter((row) => row.flags.includes(flag)).length;
  const content = h("div", { class: "fields" },
    h("label", {}, "Outcome"),
    choice("outcome", [...kept, ...format.OUTCOMES.map((name) => [name, name])], one?.outcome ?? ""),
    h("label", {}, "Quality"),
    choice("quality", [...kept, ["0", "none"], ...[1, 2, 3, 4, 5].map((n) => [`${n}`, `${n}`])], one ? `${one.quality ?? 0}` : ""),
    h("label", {}, "Flags"),
    h("div", { class: "choices" }, flags.map((flag) => h("label", {},
      h("input", {
        type: "checkbox", name: "flag", value: flag, checked: has(flag) === rows.length,
        indeterminate: has(flag) > 0 && has(flag) < rows.length,
      }), h("span", {}, format.words(flag)))),
    h("input", { name: "other", placeholder: "another flag", pattern: "\\S+", title: "One word; use _ for a space", maxlength: "60" })),
    h("label", { for: "note" }, "Note"),
    h("textarea", { id: "note", name: "note", rows: "3", placeholder: one ? "" : "as it is; what you write replaces the notes of all" }, one?.note ?? ""),
  );
  const dialog = ask(subject(rows), content, {
    button: one ? "Save" : `Change ${format.takes(rows.length)}`,
    act: async (given) => {
      const changes = changesOf(given, rows, dialog);
      if (Object.keys(changes).length) await say(changes, "changed");
    },
  });
  dialog.querySelector("textarea").focus();
}

// Only what differs becomes an edit.
function changesOf(given, rows, dialog) {
  const changes = {}, clear = [];
  const all = (test) => rows.every(test);
  const outcome = given.get("outcome");
  if (outcome && !all((row) => row.outcome === outcome)) changes.outcome = outcome;
  const quality = given.get("quality");
  if (quality === "0" && !all((row) => row.quality === null)) clear.push("quality");
  if (Number(quality) && !all((row) => row.quality === Number(quality))) changes.quality = Number(quality);
  const note = given.get("note").trim();
  if (note !== (rows.length === 1 ? rows[0].note : "")) note ? (changes.note = note) : clear.push("note");
  const boxes = [...dialog.querySelectorAll("input[name=flag]")].filter((box) => !box.indeterminate);
  const added = boxes.filter((box) => box.checked && !all((row) => row.flags.includes(box.value))).map((box) => box.value);
  const other = given.get("other").trim();
  if (other) added.push(other);
  const removed = boxes.filter((box) => !box.checked && rows.some((row) => row.flags.includes(box.value))).map((box) => box.value);
  if (added.length) changes.add_flags = added;
  if (removed.length) changes.remove_flags = removed;
  if (clear.length) changes.clear = clear;
  return changes;
}

// Name takes: those that are selected, or all that match. `make({name, note})` does it.
export function collect(words, { outcomes, health }, make) {
  const graded = h("p", { class: "dim" }, "Examining…");
  const content = [
    h("p", {}, words), h("p", { class: "dim" }, outcomes), graded,
    h("div", { class: "fields" },
      h("label", { for: "name" }, "Name"),
      h("input", { id: "name", name: "name", required: true, maxlength: "60", pattern: "[A-Za-z0-9][\\w.\\-]*", title: "Letters, digits, - _ .", autocomplete: "off" }),
      h("label", { for: "note" }, "Note"),
      h("textarea", { id: "note", name: "note", rows: "2" })),
    h("p", { class: "dim" }, "It keeps these takes as they are annotated now; later edits do not change it."),
  ];
  let isOpen = true;
  const dialog = ask("Make a collection", content, {
    button: "Make", act: (given) => make({ name: given.get("name"), note: given.get("note") }), onClose: () => { isOpen = false; },
  });
  dialog.querySelector("input").focus();
  attempt(async () => {
    while (isOpen) {
      const { together, unexamined } = await health();
      const { good, fair, poor } = together.grades;
      graded.replaceChildren(
        h("b", { class: `grade ${together.grade}` }, `${format.GRADE_SIGNS[together.grade]} ${together.grade}`), ` · ${good} good, ${fair} fair, ${poor} poor`,
        unexamined ? h("span", {}, ` · ${unexamined} not examined yet…`) : "",
        h("ul", {}, together.reasons.map((text) => h("li", {}, text))),
      );
      if (!unexamined) return;
    }
  });
}

// Takes that cannot be deleted, and why; `insist` does it nevertheless.
export function refusedToDelete(refused, insist) {
  const inUse = refused.filter(({ error }) => error.status === 409);
  ask("Not deleted", [
    h("ul", {}, refused.slice(0, 8).map(({ error }) => h("li", {}, error.message))),
    refused.length > 8 ? h("p", { class: "dim" }, `… and ${refused.length - 8} more.`) : "",
  ], inUse.length ? { button: `Delete ${format.takes(inUse.length)} anyway`, act: () => insist(inUse.map(({ row }) => row)) } : {});
}
