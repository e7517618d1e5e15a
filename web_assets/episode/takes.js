// The takes in view: what each is, and where its time stands on their common axis.

export const COLORS = ["#5b9dff", "#ffb84d", "#4cc38a", "#e06ec0", "#b69bff", "#6fd3e0", "#e0d35b", "#f07f6a"];

// `anchor` is the time of the take at which the axis is zero.
export function takeOf(row, index) {
  return { row, color: COLORS[index % COLORS.length], letter: String.fromCharCode(65 + index), anchor: 0, timeline: null, curves: null };
}

export const path = (take) => `/episodes/${encodeURIComponent(take.row.episode_id)}`;

// Of one take at the start of the axis, or of several at their starts or first contacts.
export function align(takes, at) {
  for (const take of takes) take.anchor = at === "contact" ? take.timeline?.first_contact ?? 0 : 0;
}

export function reach(takes) {
  return [
    Math.min(...takes.map((take) => -take.anchor)),
    Math.max(...takes.map((take) => (take.timeline?.duration ?? take.row.duration) - take.anchor)),
  ];
}

export function nameOf(row) {
  return row.seed === null ? row.task : `${row.task} ${row.seed}`;
}

// "12:03:07" of today, else with the date.
export function when(row) {
  const date = new Date(row.started * 1000);
  const isToday = date.toDateString() === new Date().toDateString();
  return date.toLocaleString(undefined, isToday ? { timeStyle: "medium" } : { dateStyle: "medium", timeStyle: "short" });
}
