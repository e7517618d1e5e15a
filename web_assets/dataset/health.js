// How sound takes are: a grade with its reasons for all of them together, and for each.

import { ask } from "./dialogs.js";
import { attempt, h } from "./dom.js";
import * as format from "./format.js";

const MOST = 200; // takes with findings that are listed

// `examine()` asks the studio until nothing is left to examine; `open(id)` shows a take.
export function show(words, examine, { onGrades, open }) {
  let isOpen = true;
  const content = h("div", { class: "health" }, h("p", { class: "dim" }, "Examining…"));
  const dialog = ask(`Health of ${words}`, content, { kind: "wide", onClose: () => { isOpen = false; } });
  attempt(async () => {
    while (isOpen) {
      const { together, unexamined } = await examine();
      onGrades(together.takes);
      draw(content, together, unexamined, (id) => { dialog.close(); open(id); });
      if (!unexamined) return;
    }
  });
}

function draw(content, together, unexamined, open) {
  const takes = together.takes.filter(({ findings }) => findings.length);
  const badness = ({ findings }) => format.GRADES.indexOf(format.gradeOf(findings));
  takes.sort((a, b) => badness(b) - badness(a));
  const n = together.takes.length;
  content.replaceChildren(
    unexamined ? h("p", { class: "progress" }, h("progress", { max: n + unexamined, value: n }), ` ${format.count(n)} of ${format.takes(n + unexamined)} examined`) : "",
    h("p", { class: "verdict" }, h("b", { class: `grade ${together.grade}` }, `${format.GRADE_SIGNS[together.grade]} ${together.grade}`),
      ` ${together.reasons.join(" ") || "Nothing speaks against it."}`),
    h("div", { class: "shares" },
      shares("Grades", Object.fromEntries(format.GRADES.map((grade) => [grade, together.grades[grade]]).filter(([, k]) => k))),
      ...Object.entries(together.balance).map(([name, counts]) => shares({ agent: "Driven by" }[name] ?? name, counts))),
    notes(together.findings.filter(({ severity }) => severity === "note")),
    takes.length ? h("table", {}, takes.slice(0, MOST).map((found) => line(found, open))) : h("p", { class: "dim" }, "Every take is sound."),
    takes.length > MOST ? h("p", { class: "dim" }, `… and ${takes.length - MOST} more.`) : "",
  );
}

function notes(findings) {
  return findings.length ? h("ul", { class: "dim" }, findings.map(({ text }) => h("li", {}, text))) : "";
}

function shares(title, counts) {
  const sum = Object.values(counts).reduce((a, b) => a + b, 0);
  return h("section", {}, h("h3", {}, title), Object.entries(counts).slice(0, 8).map(([value, n]) => h("div", { class: "share" },
    h("i", { class: value, style: { width: `${(100 * n) / sum}%` } }), h("span", {}, value), h("small", {}, `${format.count(n)} · ${format.percent(n / sum)}`))));
}

function line({ episode_id: id, findings }, open) {
  const grade = format.gradeOf(findings);
  return h("tr", {},
    h("td", {}, h("span", { class: `grade ${grade}`, title: grade }, format.GRADE_SIGNS[grade])),
    h("td", {}, h("button", { type: "button", class: "link", onclick: () => open(id) }, id)),
    h("td", {}, findings.map(({ text, severity }) => h("div", { class: severity }, text))));
}
