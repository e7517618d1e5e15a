// The dataset page: the takes of a data folder, what people say about them, and one of them in view.

import * as address from "./address.js";
import { api, Refused } from "./api.js";
import * as dialogs from "./dialogs.js";
import { attempt, h, isTyping, toast } from "./dom.js";
import { Edits, subject } from "./edits.js";
import * as exports from "./export.js";
import { Filters } from "./filters.js";
import * as format from "./format.js";
import * as health from "./health.js";
import { meaningOf } from "./keys.js";
import { Rows } from "./rows.js";
import { Table } from "./table.js";
import { Toolbar } from "./toolbar.js";

const LOOK = 1500; // [ms] between looks whether anything has changed
const HURRY = 120; // [ms] in which who leafs through takes goes on to the next
const MOST_SELECTED = 5000; // beyond that the command line is the better tool

const section = document.getElementById("episode");
const start = address.read();
const state = { filters: start.filters, source: start.source, episode: null }; // as the address says it
let shown = null; // the row of the open take
const rows = new Rows(api, () => table.follow());
const table = new Table(document.getElementById("takes"), rows);
const edits = new Edits(api, changed);
let view = null; // of the open take, once one was opened
let loading = null; // promise of it
let revision = null; // what the studio had when we asked last
let opening = 0; // timer
let isLooking = false;
let isSettling = false; // the take under the cursor was edited: the list waits until the cursor leaves it

// The list

// `unless` is asked when the answer is here, and may drop it.
async function load({ toTop = false, unless = () => false } = {}) {
  rows.source = state.source;
  rows.query = { ...state.filters, sort: rows.query.sort, descending: rows.query.descending };
  if (toTop) table.toTop();
  const [first, last] = table.span;
  const reloaded = rows.reload(first, Math.max(last, first + 50), table.cursor, unless);
  await Promise.all([reloaded, state.source.kind === "all" ? count() : reloaded.then(count)]);
  showBanner();
}

async function count() {
  const isAll = state.source.kind === "all";
  const [, amount] = await Promise.all([left.load(state.filters, state.source), isAll && api.get("/amount", state.filters)]);
  toolbar.show(isAll ? state.filters : {}, amount || rows.amount);
}

// What a command without a more exact aim is about: the selected takes, else all in the list.
// Either `ids`, or for all that match the `filters` alone.
function scope() {
  const about = table.selected.size ? [...table.selected.values()] : state.source.kind === "all" ? null : rows.whole;
  const isFiltered = state.source.kind === "all" && Object.keys(state.filters).length;
  const words = table.selected.size ? `${format.takes(about.length)}, as selected` : `${format.takes(rows.total)}${isFiltered ? " that match" : ""}`;
  return { words, rows: about, ids: about?.map((row) => row.episode_id), filters: about ? null : state.filters };
}

function examine({ ids, filters }) {
  return ids ? api.post("/dataset-health", { episode_ids: ids }) : api.get("/dataset-health", filters);
}

function ask(changes, isStep = false) {
  Object.assign(state, changes);
  isSettling = false;
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

// The list as it is by now: the cursor has left the take that was edited.
function settle() {
  isSettling = false;
  return attempt(() => load());
}

// What others do

async function look() {
  if (document.hidden || isLooking) return;
  isLooking = true;
  try {
    await lookOnce();
  } finally {
    isLooking = false;
  }
}

async function lookOnce() {
  const { revision: now } = await api.get("/revision");
  if (now === revision) return;
  const wasSettling = isSettling;
  if (isSettling) await Promise.all([rows.freshen(...table.span), count()]);
  else await load({ unless: () => isSettling });
  if (!isSettling || wasSettling) revision = now; // else, and where it failed, the next look tries again
  known.clear();
  table.onRest(inView);
}

// Edits

function changed(told, isElsewhere) {
  if (isElsewhere) {
    for (const row of told) table.selected.delete(row.episode_id);
    settle();
    return;
  }
  isSettling = true;
  rows.patch(told);
  if (told.some(({ episode_id: id }) => rows.placeOf(id) < 0)) settle(); // it may match again
  table.patch(told);
  if (view && state.episode) {
    const row = told.find(({ episode_id: id }) => id === state.episode);
    if (row) open(row, { isStep: false }); // it keeps its time
  }
}

// What keys and buttons are about: the open take, else the selected ones, else that under the cursor.
function chosen() {
  if (shown) return [shown];
  if (state.source.kind === "trash") throw new Refused(409, "A deleted take is not edited; restore it first (R).");
  if (state.source.kind === "collection") throw new Refused(409, "A collection stays as it is; open a take of it, or edit under “All takes”.");
  table.reveal();
  const found = table.chosen;
  if (!found.length) throw new Refused(409, "No take is selected.");
  return found;
}

async function say(changes, words) {
  const about = chosen();
  isSettling = true;
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
    if (state.source.kind !== "trash") throw new Refused(409, "Only what is in the trash can be restored.");
    const about = table.chosen;
    await edits.restore(about);
    table.select([]);
    told(`${subject(about)} restored`);
  }),
  collect: () => attempt(collect),
  health: () => {
    const about = shown ? { words: subject([shown]), ids: [shown.episode_id] } : scope();
    health.show(about.words, () => examine(about), { onGrades: learnGrades, open: openById });
  },
  compare: () => attempt(async () => {
    const about = [...table.selected.values()];
    section.hidden = false;
    document.body.classList.add("viewing");
    (await theView()).compare(about);
  }),
  export: () => attempt(async () => {
    if (state.source.kind === "trash") throw new Refused(409, "Deleted takes are not exported; restore them first.");
    const about = scope();
    const { kind, name } = state.source;
    const isAll = about.filters && !Object.keys(about.filters).length;
    if (isAll && rows.total > MOST_SELECTED) throw new Refused(409, `These are ${format.takes(rows.total)}; ask for some of them by the filters on the left.`);
    const which = kind === "collection" && !table.selected.size ? { collection: name }
      : about.filters && !isAll ? { filters: asNumbers(about.filters) }
      : { episode_ids: about.ids ?? (await rows.first(MOST_SELECTED)).map((row) => row.episode_id) };
    const known = new Set((about.rows ?? [table.row]).map((row) => row?.task));
    exports.start({ words: about.words, task: known.size === 1 ? [...known][0] : undefined, ...which }, edits.author);
  }),
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
  if (state.source.kind === "trash") throw new Refused(409, "Deleted takes cannot be collected; restore them first.");
  const about = scope();
  if (about.filters && !Object.keys(about.filters).length) {
    throw new Refused(409, "Select some takes, or ask for some by the filters on the left; that becomes the collection.");
  }
  const counted = (name) => about.rows.filter((row) => row.outcome === name).length;
  const outcomes = about.rows ? format.OUTCOMES.filter(counted).map((name) => `${counted(name)} ${name}`).join(", ") : "All that match the filters.";
  dialogs.collect(about.words, { outcomes, health: () => examine(about) }, async ({ name, note }) => {
    const given = about.filters ? { filters: asNumbers(about.filters) } : { episode_ids: about.ids };
    await api.post("/collections", { name, note, author: edits.author, ...given });
    edits.remember(`collection ${name} made`, () => api.del(`/collections/${encodeURIComponent(name)}`));
    told(`Collection ${name} made`);
    await count();
  });
}

// The address and the query know texts only.
function asNumbers({ min_quality: quality, seed, ...filters }) {
  return { ...filters, ...(quality && { min_quality: Number(quality) }), ...(seed && { seed: Number(seed) }) };
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

// One view for all takes, made when the first is opened.
function theView() {
  loading ??= import("../episode/view.js").then(({ EpisodeView }) => {
    view = new EpisodeView(section, {
      api, changed: editedInView, selected: () => [...table.selected.values()],
      author: () => edits.author, close: () => close(),
    });
    return view;
  });
  return loading;
}

// An edit that the view itself made: it is this person's newest, which is what the studio takes back.
function editedInView(row) {
  const path = `/episodes/${encodeURIComponent(row.episode_id)}/undo`;
  edits.remember(`${subject([row])}: trim or segments`, async () => changed([await api.post(path, undefined, { author: edits.author })], false));
  changed([row], false);
}

// `isStep`: the browser's way back leads to what was shown before. `delay` [ms] until it is read.
function open(row, { isStep = true, delay = 0 } = {}) {
  if (state.source.kind === "trash") return toast("A deleted take is not opened; restore it first (R).");
  section.hidden = false;
  document.body.classList.add("viewing");
  shown = row;
  state.episode = table.openId = row.episode_id;
  remember(isStep);
  clearTimeout(opening);
  opening = setTimeout(() => attempt(async () => (await theView()).open(row)), delay);
  return undefined;
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
  clearTimeout(opening);
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
  for (const { episode_id: id, findings } of found) table.grades[id] = { grade: format.gradeOf(findings), findings };
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
  if (state.episode && table.row) open(table.row, { isStep: false, delay: HURRY });
  if (isSettling) settle();
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
  h("nav", {}, h("a", { href: "/", target: "_top" }, "Drive"), h("a", { href: "/dataset", class: "here" }, "Dataset"),
    h("a", { href: "/train?view=demo" }, "Demonstrate"),
    h("a", { href: "/train?view=train" }, "Train"), h("a", { href: "/train?view=evaluate" }, "Evaluate")),
);
attempt(async () => {
  await load({ toTop: true });
  if (start.episode) await openById(start.episode);
  table.focus();
  edits.known = (await api.get("/me")).name;
  toolbar.author = edits.author;
  exports.followAll().catch(() => {});
  api.post("/refresh").catch(() => {}); // takes that were copied into the folder; `look` hears of them
  for (;;) {
    await look().catch(() => {}); // without an answer the next look may have one
    await new Promise((resolve) => { setTimeout(resolve, LOOK); });
  }
});
