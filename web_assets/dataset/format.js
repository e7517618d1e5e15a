// Numbers, times and shares as people read them.

import { h } from "./dom.js";

export const OUTCOMES = ["success", "failure", "unmarked"];
export const FLAGS = ["jittery", "hesitation", "excessive_force", "collision", "wrong_object"];
export const GRADES = ["good", "fair", "poor"];
export const GRADE_SIGNS = { good: "●", fair: "▲", poor: "✖" }; // never by their colour alone
const SIGNS = { success: "✓", failure: "✗", unmarked: "○" };
const DAY = 24 * 3600e3; // [ms]

export const words = (name) => name.replaceAll("_", " ");
export const count = (n) => n.toLocaleString("en");
export const takes = (n) => `${count(n)} ${n === 1 ? "take" : "takes"}`;
export const percent = (share) => `${Math.round(100 * share)} %`;

export function seconds(s) {
  return s < 100 ? `${s.toFixed(1)} s` : `${Math.floor(s / 60)}:${String(Math.round(s) % 60).padStart(2, "0")} min`;
}

export function hours(s) {
  return s < 120 ? `${s.toFixed(0)} s` : s < 3600 ? `${(s / 60).toFixed(0)} min` : `${(s / 3600).toFixed(1)} h`;
}

// Of a unix time [s]: the time of day where it was within a day, else the date.
export function date(s) {
  const then = new Date(1e3 * s);
  const time = then.toLocaleTimeString("en-GB", { hour: "2-digit", minute: "2-digit" });
  const day = then.toLocaleDateString("en-GB", { day: "numeric", month: "short" });
  if (Date.now() - then < DAY) return `${day} ${time}`;
  return then.getFullYear() === new Date().getFullYear() ? `${day} ${time}` : `${day} ${then.getFullYear()}`;
}

// The time of day where it was within a day, else the day.
export function shortDate(s) {
  const then = new Date(1e3 * s);
  const isRecent = Date.now() - then < DAY;
  return isRecent ? then.toLocaleTimeString("en-GB", { hour: "2-digit", minute: "2-digit" }) : then.toLocaleDateString("en-GB", { day: "numeric", month: "short" });
}

export const exactDate = (s) => new Date(1e3 * s).toLocaleString("en-GB");

export const name = (row) => (row.seed === null ? row.task : `${row.task} · ${row.seed}`);

export function outcome(value) {
  return h("span", { class: `outcome ${value}` }, h("b", { "aria-hidden": "true" }, SIGNS[value]), ` ${value}`);
}

// Five dots, as many of them full.
export function quality(value) {
  const text = value === null ? "not rated" : `quality ${value} of 5`;
  return h("span", { class: `quality${value ? "" : " none"}`, title: text, "aria-label": text },
    [1, 2, 3, 4, 5].map((n) => h("i", { class: value >= n ? "full" : "" })));
}

// The share of time under each stiffness mode as a bar; nothing where it was not summed up.
export function stiffness(shares) {
  const modes = ["low", "medium", "high", "joint control"].filter((mode) => shares[mode]);
  if (!modes.length) return h("span", { class: "dim", title: "Not summed up in this take" }, "–");
  const text = modes.map((mode) => `${mode} ${percent(shares[mode])}`).join(", ");
  return h("span", { class: "bar", title: text, role: "img", "aria-label": text },
    modes.map((mode) => h("i", { class: mode.replace(" control", ""), style: { flexGrow: shares[mode] } })));
}

// The worst finding decides; notes change nothing.
export function gradeOf(findings) {
  const has = (severity) => findings.some((found) => found.severity === severity);
  return has("fault") ? "poor" : has("warning") ? "fair" : "good";
}

// {grade, findings} as a coloured dot that says why; empty where nobody examined it yet.
export function grade(told) {
  if (!told) return h("span", { class: "grade", title: "Not examined yet" });
  const why = told.findings.map(({ text }) => text).join("\n") || "Nothing is wrong.";
  return h("span", { class: `grade ${told.grade}`, title: `${told.grade}\n${why}`, "aria-label": told.grade }, GRADE_SIGNS[told.grade]);
}
