// The dataset page: the takes of a data folder, what people say about them, and one of them in view.

import * as address from "./address.js";
import { api } from "./api.js";
import * as dialogs from "./dialogs.js";
import { attempt, h, isTyping, toast } from "./dom.js";
import { Edits, subject } from "./edits.js";
import { Filters } from "./filters.js";
import * as format from "./format.js";
import * as health from "./health.js";
import { meaningOf } from "./keys.js";
import { Rows } from "./rows.js";
import { Table } from "./table.js";
import { Toolbar } from "./toolbar.js";

const LOOK = 1500; // [ms] between looks whether anything has changed
const MOST_SELECTED = 5000; // beyond that the command line is the better tool

const section = document.getElementById("episode");
const start = address.read();
const state = { filters: start.filters, source: start.source, episode: null }; // as the address says it
let shown = null; // the row of the open take
const rows = new Rows(api, () => table.draw());
const table = new Table(document.getElementById("takes"), rows);
const edits = new Edits(api, changed);
let view = null; // of the open take, once one was opened
let revision = null; // what the studio had when we asked last
let isSettling = false; // the take under the cursor was edited: the list waits until the cursor leaves it

// The list

async function load({ toTop = false } = {}) {
  rows.source = state.source;
  rows.query = { ...state.filters, sort: rows.query.sort, descending: rows.query.descending };
  const id = table.row?.episode_id;
  if (toTop) table.toTop();
  const [first, last] = table.span;
  isSettling = false;
  await Promise.all([rows.reload(first, Math.max(last, first + 50)), count()]);
  if (!toTop) table.follow(id);
  showBanner();
}

async function count() {
  const [, amount] = await Promise.all([left.load(state.filters, state.source), api.get("/amount", state.filters)]);
  toolbar.show(state.filters, amount);
}

function ask(changes, isStep = false) {
  Object.assign(state, changes);
  table.select([]);
  remember(isStep);
  return attempt(() => load({ toTop: true }));
}

function remember(isStep = false) {
  address.write({ ...state, sort: rows.query.sort, descending: rows.query.descending }, isStep);
}

function sort(key) {
  const isSame = rows.query.sort === key;
  const startsHigh = !["task", "operator", "outcome", "episode_id"].includes(key);
  rows.query.descending = isSame ? !rows.query.descending : startsHigh;
  rows.query.sort = key;
  ask({});
}

async function showBanner() {
  const { kind, name } = state.source;
  if (kind === "all") {
    const isEmpty = !rows.total;
    toolbar.showBanner(isEmpty ? [emptyWords()] : null);
  } else if (kind === "trash") {
    toolbar.showBanner([h("span", {}, rows.total ? "Deleted takes. Select some and restore them." : "The trash is empty."),
      rows.total ? h("button", { onclick: () => act.restore() }, "Restore (R)") : ""]);
  } else {
    const { collection, changes } = await api.get(`/collections/${encodeURIComponent(name)}`);
    const told = [`${format.takes(collection.members.length)} as they were on ${format.exactDate(collection.created)}, by ${collection.author}.`,
      collection.note, changes.length ? `${format.takes(changes.length)} changed since.` : ""].filter(Boolean).join(" ");
    toolbar.showBanner([h("b", {}, name), h("span", { title: changes.slice(0, 20).map(({ episode_id: id, text }) => `${id}: ${text}`).join("\n") }, told),
      h("button", { onclick: () => deleteCollection(name) }, "Delete collection")]);
  }
}

function emptyWords() {
  return Object.keys(state.filters).length
    ? h("span", {}, "No take matches. ", h("button", { class: "link", onclick: () => ask({ filters: {} }) }, "Take all filters off"))
    : h("span", {}, "No takes yet. Record some on the ", h("a", { href: "/", target: "_top" }, "studio's first page"), ", or: ", h("code", {}, "studio demo wiping --episodes 3"));
}

// What others do

async function look() {
  if (document.hidden) return;
  const { revision: now } = await api.get("/revision");
  if (now === revision) return;
  const isFirst = revision === null;
  revision = now;
  if (isFirst) return;
  if (isSettling) await Promise.all([rows.freshen(...table.span), count()]);
  else await load();
  known.clear();
  table.onRest(inView);
}

// Edits

function changed(told, isElsewhere) {
  if (isElsewhere) {
    for (const row of told) table.selected.delete(row.episode_id);
    attempt(() => load());
    return;
  }
  isSettling = true;
  for (const row of told) rows.patch(row);
  table.patch(told);
  if (view && state.episode) {
    const row = told.find(({ episode_id: id }) => id === state.episode);
    if (row) view.open(shown = row); // it keeps its time
  }
}

// What keys and buttons are about: the open take, else the selected ones, else that under the cursor.
function chosen() {
  if (state.source.kind === "trash") throw new Error("A deleted take is not edited; restore it first.");
  if (state.source.kind === "collection") throw new Error("A collection stays as it is; edit its takes under “All takes”.");
  if (shown) return [shown];
  const found = table.chosen;
  if (!found.length) throw new Error("No take is selected.");
  return found;
}

async function say(changes, words) {
  const about = chosen();
  await edits.say(about.map((row) => row.episode_id), changes, `${subject(about)}: ${words}`);
  told(`${subject(about)}: ${words}`);
}

function told(words) {
  toast(words, { kind: "edit", action: { label: "Undo", act: () => act.undo() } });
}

const act = {
  filter: (filters) => ask({ filters }),
  search: (text) => {
    const { text: _, ...others } = state.filters;
    ask({ filters: text ? { ...others, text } : others, source: { kind: "all" } });
  },
  leaveSearch: () => table.focus(),
  outcome: (value) => attempt(() => say({ outcome: value }, value)),
  rate: (n) => attempt(() => say(n ? { quality: n } : { clear: ["quality"] }, n ? `quality ${n}` : "no quality")),
  flag: (name) => attempt(async () => {
    const isOn = chosen().every((row) => row.flags.includes(name));
    await say(isOn ? { remove_flags: [name] } : { add_flags: [name] }, isOn ? `not ${name}` : name);
  }),
  edit: () => attempt(() => {
    const about = chosen();
    const flags = [...new Set([...format.FLAGS, ...about.flatMap((row) => row.flags)])];
    dialogs.edit(about, flags, (changes, words) => say(changes, words));
  }),
  undo: () => attempt(async () => {
    const words = await edits.undo();
    toast(words ? `Taken back: ${words}` : "Nothing to take back: you have changed nothing since this page was opened.", { kind: "edit" });
  }),
  remove: () => attempt(() => remove(chosen())),
  restore: () => attempt(async () => {
    if (state.source.kind !== "trash") throw new Error("Only what is in the trash can be restored.");
    const about = table.chosen;
    await edits.restore(about);
    table.select([]);
    told(`${subject(about)} restored`);
  }),
  collect: () => attempt(collect),
  health: () => {
    const about = [...table.selected.values()];
    const examine = () => (about.length ? api.post("/dataset-health", { episode_ids: about.map((row) => row.episode_id).slice(0, 1000) }) : api.get("/dataset-health", state.filters));
    health.show(about.length ? subject(about) : format.takes(rows.total), examine, { onGrades: learnGrades, open: openById });
  },
  compare: () => attempt(async () => {
    const about = [...table.selected.values()];
    section.hidden = false;
    document.body.classList.add("viewing");
    (await theView()).compare(about);
  }),
  export: () => {},
  canExport: () => false,
  help: () => attempt(async () => dialogs.help((await theView()).keys)),
  sign: () => dialogs.ask("Your name", h("div", { class: "fields" }, h("label", { for: "author" }, "Name"),
    h("input", { id: "author", name: "author", required: true, maxlength: "60", value: edits.author, autocomplete: "name" })),
  { button: "Use it", act: (given) => { edits.author = given.get("author"); toolbar.author = edits.author; } }),
  clear: () => table.select([]),
  toggle: () => table.toggle(table.cursor),
  selectAll: () => attempt(async () => {
    if (rows.total > MOST_SELECTED) toast(`Selected are the first ${format.takes(MOST_SELECTED)}; narrow the filter, or use studio annotate --of-….`);
    table.select(await rows.first(MOST_SELECTED));
  }),
  move: (steps) => table.move(steps),
  extend: (steps) => table.move(steps, { extends: true }),
  page: (way) => { const [first, last] = table.span; table.move(way * Math.max(1, last - first - 2)); },
  end: (way) => table.moveTo(way < 0 ? 0 : rows.total - 1),
  open: () => table.row && open(table.row),
  close: () => {
    if (state.episode || document.body.classList.contains("viewing")) close();
    else if (table.selected.size) act.clear();
  },
  searchFor: () => toolbar.focusSearch(),
};

async function remove(about, isInsisting = false) {
  const { gone, refused } = await edits.remove(about, isInsisting);
  if (gone.some((row) => row.episode_id === state.episode)) close();
  if (gone.length) told(`${subject(gone)} deleted`);
  if (refused.length) dialogs.refusedToDelete(refused, (others) => remove(others, true));
}

function collect() {
  const about = [...table.selected.values()];
  const asked = Object.keys(state.filters).length ? state.filters : null;
  if (!about.length && !asked) throw new Error("Select some takes, or ask for some by the filters on the left; that becomes the collection.");
  const ids = about.map((row) => row.episode_id);
  const words = about.length ? `${format.takes(about.length)}, as selected` : `${format.takes(rows.total)} that match the filters`;
  const counted = (name) => about.filter((row) => row.outcome === name).length;
  const outcomes = about.length ? format.OUTCOMES.filter(counted).map((name) => `${counted(name)} ${name}`).join(", ") : "";
  const examine = () => (about.length ? api.post("/dataset-health", { episode_ids: ids.slice(0, 1000) }) : api.get("/dataset-health", asked));
  dialogs.collect(words, { outcomes, health: examine }, async ({ name, note }) => {
    const filters = asked && { ...asked, min_quality: asked.min_quality && Number(asked.min_quality) };
    await api.post("/collections", { name, note, author: edits.author, ...(about.length ? { episode_ids: ids } : { filters }) });
    edits.remember(`collection ${name} made`, () => api.del(`/collections/${encodeURIComponent(name)}`));
    told(`Collection ${name} made`);
    await count();
  });
}

function deleteCollection(name) {
  attempt(async () => {
    await api.del(`/collections/${encodeURIComponent(name)}`);
    edits.remember(`collection ${name} deleted`, () => api.post(`/collections/${encodeURIComponent(name)}/restore`));
    told(`Collection ${name} deleted; its takes stay`);
    ask({ source: { kind: "all" } }, true);
  });
}

// One take in view

async function theView() {
  if (!view) {
    const { EpisodeView } = await import("../episode/view.js");
    view = new EpisodeView(section, {
      api, changed: editedInView, selected: () => [...table.selected.values()],
      author: () => edits.author, close: () => close(),
    });
  }
  return view;
}

// An edit that the view itself made: it is this person's newest, which is what the studio takes back.
function editedInView(row) {
  const path = `/episodes/${encodeURIComponent(row.episode_id)}/undo`;
  edits.remember(`${subject([row])}: trim or segments`, async () => changed([await api.post(path, undefined, { author: edits.author })], false));
  changed([row], false);
}

function open(row, { isStep = true } = {}) {
  if (state.source.kind === "trash") return toast("A deleted take is not opened; restore it first (R).");
  section.hidden = false;
  document.body.classList.add("viewing");
  shown = row;
  state.episode = table.openId = row.episode_id;
  remember(isStep);
  return attempt(async () => (await theView()).open(row));
}

async function openById(id) {
  const place = rows.placeOf(id);
  if (place >= 0) {
    table.moveTo(place, { isQuiet: true });
    return open(rows.at(place));
  }
  return attempt(async () => open((await api.get(`/episodes/${encodeURIComponent(id)}`)).row));
}

function close({ isStep = true } = {}) {
  section.hidden = true;
  document.body.classList.remove("viewing");
  state.episode = table.openId = shown = null;
  view?.close();
  remember(isStep);
  table.focus();
}

// Grades of what is in view, where they are known

const known = new Set(); // ids that were asked for
let inView = [];

function learnGrades(found) {
  const rank = (findings) => (findings.some(({ severity }) => severity === "fault") ? "poor" : findings.some(({ severity }) => severity === "warning") ? "fair" : "good");
  for (const { episode_id: id, findings } of found) table.grades[id] = { grade: rank(findings), findings };
  table.draw();
}

table.onRest = async (found) => {
  inView = found;
  const ids = found.map((row) => row.episode_id).filter((id) => !known.has(id));
  if (!ids.length || state.source.kind === "trash") return;
  ids.forEach((id) => known.add(id));
  const grades = await attempt(() => api.get("/grades", { episode_id: ids }));
  if (!grades || !Object.keys(grades).length) return;
  Object.assign(table.grades, grades);
  table.draw();
};

// Wiring

const bar = h("div", { class: "toolbar" });
document.getElementById("takes").prepend(bar);
const toolbar = new Toolbar(bar, act, edits.author);
const left = new Filters(document.getElementById("facets"), api, {
  onChange: (filters) => ask({ filters }),
  onSource: (source) => ask({ source, episode: state.episode }, true),
});

table.onOpen = (row) => row && open(row);
table.onSort = sort;
table.onSelect = () => toolbar.showSelection([...table.selected.values()]);
table.onMove = () => {
  if (state.episode && table.row) open(table.row, { isStep: false });
  if (isSettling) attempt(() => load());
};

document.addEventListener("keydown", (event) => {
  if (document.querySelector("dialog[open]")) return;
  if (isTyping()) {
    if (event.key === "Escape") document.activeElement.blur();
    return;
  }
  if (!section.hidden && view?.key(event)) return event.preventDefault();
  const meaning = meaningOf(event);
  if (!meaning || event.target.closest("button, a") && ["Enter", " "].includes(event.key)) return undefined;
  const [what, ...given] = meaning;
  event.preventDefault();
  return (what === "search" ? act.searchFor : act[what])(...given);
});

addEventListener("popstate", () => {
  const now = address.read();
  Object.assign(state, { filters: now.filters, source: now.source });
  rows.query = { ...now.filters, sort: now.sort, descending: now.descending };
  attempt(() => load({ toTop: false }));
  if (now.episode && now.episode !== state.episode) openById(now.episode);
  if (!now.episode && state.episode) close({ isStep: false });
});
addEventListener("focus", () => attempt(look));

rows.query = { sort: start.sort, descending: start.descending };
document.body.classList.toggle("embedded", start.isEmbedded);
document.getElementById("top").append(
  h("b", {}, "Comp-ACT Studio"),
  h("nav", {}, h("a", { href: "/", target: "_top" }, "Drive"), h("a", { href: "/dataset", class: "here" }, "Dataset")),
);
attempt(async () => {
  await api.post("/refresh"); // takes that were copied into the folder
}).then(() => attempt(async () => {
  await load({ toTop: true });
  if (start.episode) await openById(start.episode);
  table.focus();
  for (;;) {
    await look().catch(() => {}); // a studio that ends tells by itself that it does not answer
    await new Promise((resolve) => { setTimeout(resolve, LOOK); });
  }
}));
