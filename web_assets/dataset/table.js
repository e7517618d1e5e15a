// The table: as many rows as fit on the screen, of any number that there are.

import { api } from "./api.js";
import { h } from "./dom.js";
import * as format from "./format.js";

const HEIGHT = 54; // [px] of a row, as in dataset.css
const SPARE = 6; // rows beyond either edge
const REST = 120; // [ms] of scrolling less before pictures are fetched
const AT_ONCE = 4; // pictures

// [class, heading, what it is sorted by]
const COLUMNS = [
  ["check", "", null],
  ["picture", "", null],
  ["task", "Task", "task"],
  ["operator", "Operator", "operator"],
  ["length", "Length", "duration"],
  ["outcome", "Outcome", "outcome"],
  ["quality", "Quality", "quality"],
  ["flags", "Flags", null],
  ["peak", "Peak N", "peak_force"],
  ["mean", "Mean N", "mean_force"],
  ["stiffness", "Stiffness", null],
  ["health", "", null],
  ["date", "Recorded", "started"],
];
const HINTS = {
  peak_force: "Largest contact force [N]",
  mean_force: "Mean force in contact [N]",
  duration: "Length of the recording",
};

export class Table {
  cursor = 0; // the place that keys act on
  selected = new Map(); // id -> row
  grades = {}; // by id, of takes that were examined
  onMove = () => {}; // the cursor went elsewhere
  onOpen = () => {};
  onSelect = () => {};
  onSort = () => {};
  onRest = () => {}; // these rows are in view
  #rows; #head; #body; #space; #shown = new Map(); // place -> element
  #pictures = new Set(); // ids whose picture was fetched: it is in the browser's cache
  #waiting = []; #loading = 0; // pictures
  #timer = 0;
  #frame = 0;
  #anchor = 0; // where a range of selected rows began
  #openId = null;
  #id; // of the take under the cursor; undefined until it is here

  constructor(container, rows) {
    this.#rows = rows;
    this.#head = h("div", { class: "row head", role: "row" });
    this.#space = h("div", { class: "space" });
    this.#body = h("div", { class: "body", role: "grid", tabindex: "0", "aria-label": "Takes" }, this.#head, this.#space);
    container.append(this.#body);
    this.#body.addEventListener("scroll", () => this.#soon(), { passive: true });
    new ResizeObserver(() => this.#soon()).observe(this.#body);
  }

  get row() { return this.#rows.at(this.cursor); }

  // Those that an edit is about: the selected takes, else the one under the cursor.
  get chosen() {
    if (this.selected.size) return [...this.selected.values()];
    return this.row ? [this.row] : [];
  }

  // The places in view, [first, last).
  get span() {
    const first = Math.floor(this.#body.scrollTop / HEIGHT);
    return [first, Math.min(this.#rows.total, first + Math.ceil(this.#height / HEIGHT) + 1)];
  }

  // [px] for rows, below the heading
  get #height() { return this.#body.clientHeight - this.#head.offsetHeight; }

  set openId(id) { this.#openId = id; this.draw(); }

  focus() { this.#body.focus({ preventScroll: true }); }

  move(steps, { extends: isRange = false } = {}) {
    this.moveTo(this.cursor + steps, { extends: isRange });
  }

  moveTo(place, { extends: isRange = false, isQuiet = false } = {}) {
    const from = this.cursor;
    this.cursor = Math.max(0, Math.min(place, this.#rows.total - 1));
    if (isRange) {
      if (!this.selected.size) this.#anchor = from;
      this.selectRange(this.#anchor, this.cursor);
    }
    this.#id = this.row?.episode_id;
    this.#bringIntoView();
    this.draw();
    if (!isQuiet && (this.cursor !== from || isRange)) this.onMove();
  }

  // Whenever rows have changed: the cursor stays on its take, and that where it was on the screen. Between
  // the two no key may come, or it would be about another take.
  follow() {
    const place = this.#id === undefined ? -1 : this.#rows.placeOf(this.#id);
    if (place >= 0 && place !== this.cursor) {
      const steps = place - this.cursor;
      this.cursor = place;
      this.#space.style.height = `${HEIGHT * this.#rows.total}px`;
      this.#body.scrollTop += HEIGHT * steps;
    }
    this.cursor = Math.max(0, Math.min(this.cursor, this.#rows.total - 1));
    this.#id = this.row?.episode_id ?? this.#id;
    this.draw();
  }

  toTop() {
    this.cursor = this.#anchor = 0;
    this.#id = undefined;
    this.#body.scrollTop = 0;
  }

  // The cursor, wherever one has scrolled.
  reveal() { this.#bringIntoView(); }

  toggle(place) {
    const row = this.#rows.at(place);
    if (!row) return;
    if (!this.selected.delete(row.episode_id)) this.selected.set(row.episode_id, row);
    this.#anchor = place;
    this.#selectionChanged();
  }

  selectRange(from, to) {
    this.selected.clear();
    for (let place = Math.min(from, to); place <= Math.max(from, to); place += 1) {
      const row = this.#rows.at(place);
      if (row) this.selected.set(row.episode_id, row);
    }
    this.#selectionChanged();
  }

  select(rows) {
    this.selected = new Map(rows.map((row) => [row.episode_id, row]));
    this.#selectionChanged();
  }

  // Rows that were changed, where they are selected.
  patch(rows) {
    for (const row of rows) if (this.selected.has(row.episode_id)) this.selected.set(row.episode_id, row);
  }

  draw() {
    const { sort, descending } = this.#rows.query;
    this.#head.replaceChildren(...COLUMNS.map(([name, heading, key]) => {
      if (!key) return h("span", { class: name }, heading);
      const way = key !== sort ? "" : descending ? " ↓" : " ↑";
      return h("button", {
        class: `${name}${way && " sorted"}`, title: HINTS[key] ?? null, tabindex: "-1", onclick: () => this.onSort(key),
      }, heading + way);
    }));
    this.#space.style.height = `${HEIGHT * this.#rows.total}px`;
    this.#drawRows(true);
  }

  #soon() {
    this.#frame ||= requestAnimationFrame(() => { this.#frame = 0; this.#drawRows(false); });
  }

  #drawRows(isAll) {
    const [first, last] = this.span;
    const shown = new Map();
    for (let place = Math.max(0, first - SPARE); place < Math.min(this.#rows.total, last + SPARE); place += 1) {
      const old = this.#shown.get(place);
      const row = this.#rows.at(place);
      const isKept = old && !isAll && (old.dataset.id === row?.episode_id || !row);
      shown.set(place, isKept ? old : this.#element(place, row, old));
    }
    for (const [place, element] of this.#shown) if (shown.get(place) !== element) element.remove();
    for (const element of shown.values()) if (!element.isConnected) this.#space.append(element);
    this.#shown = shown;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#rest(), REST);
  }

  #element(place, row, old) {
    const isPictured = row && (this.#pictures.has(row.episode_id));
    const element = h("div", {
      role: "row",
      class: ["row", place === this.cursor && "cursor", row && this.selected.has(row.episode_id) && "selected",
        row && row.episode_id === this.#openId && "open", !row && "waiting"].filter(Boolean).join(" "),
      style: { transform: `translateY(${HEIGHT * place}px)` },
      "data-id": row?.episode_id ?? null,
      "aria-rowindex": `${place + 1}`,
      "aria-selected": row && this.selected.has(row.episode_id) ? "true" : "false",
      onclick: (event) => this.#click(event, place),
      ondblclick: () => this.onOpen(row),
    });
    if (!row) return element;
    const image = old?.dataset.id === row.episode_id ? old.querySelector("img") : null;
    element.append(...COLUMNS.map(([name]) => h("span", { class: name }, this.#cell(name, row, isPictured, image))));
    return element;
  }

  #cell(name, row, isPictured, image) {
    switch (name) {
      case "check":
        return h("input", { type: "checkbox", tabindex: "-1", "aria-label": "Select", checked: this.selected.has(row.episode_id) });
      case "picture":
        return row.cameras.length && this.#rows.source.kind !== "trash" ? image ?? this.#picture(row, isPictured) : null;
      case "task":
        return [h("b", { title: row.episode_id }, format.name(row)),
          h("small", { class: row.note ? "note" : "instruction", title: row.note || row.instruction }, row.note || row.instruction),
          h("small", { class: "brief" }, `${format.seconds(row.duration)} · ${row.peak_force.toFixed(1)} N · ${format.shortDate(row.started)}`)];
      case "operator": return [h("span", { title: row.operator }, row.operator), h("small", {}, row.agent)];
      case "length": return format.seconds(row.duration);
      case "outcome": return format.outcome(row.outcome);
      case "quality": return format.quality(row.quality);
      case "flags": return row.flags.map((flag) => h("i", { title: format.words(flag) }, format.words(flag)));
      case "peak": return row.peak_force.toFixed(1);
      case "mean": return row.mean_force ? row.mean_force.toFixed(1) : "–";
      case "stiffness": return format.stiffness(row.stiffness_share);
      case "health": return format.grade(this.grades[row.episode_id]);
      case "date": return h("span", { title: format.exactDate(row.started) }, format.date(row.started));
      default: throw new Error(`No column ${name}.`);
    }
  }

  #picture(row, isNow) {
    const address = api.url(`/episodes/${encodeURIComponent(row.episode_id)}/thumbnail`);
    return h("img", { alt: "", src: isNow ? address : null, "data-src": address, onerror: (event) => event.target.classList.add("missing") });
  }

  // Pictures and grades of what is in view, as soon as nothing moves.
  #rest() {
    const [first, last] = this.span;
    const [inView, waiting] = [[], []];
    for (const [place, element] of this.#shown) {
      const row = this.#rows.at(place);
      if (!row || place < first || place >= last) continue;
      inView.push(row);
      const image = element.querySelector("img");
      if (image && !image.src) waiting.push(image);
      this.#pictures.add(row.episode_id);
    }
    this.#waiting = waiting;
    this.#load();
    this.onRest(inView);
  }

  // A few pictures at a time: a browser has six connections, and an edit must not wait behind pictures.
  #load() {
    while (this.#loading < AT_ONCE && this.#waiting.length) {
      const image = this.#waiting.shift();
      if (image.src || !image.isConnected) continue;
      this.#loading += 1;
      const done = () => { this.#loading -= 1; this.#load(); };
      image.addEventListener("load", done, { once: true });
      image.addEventListener("error", done, { once: true });
      image.src = image.dataset.src;
    }
  }

  #click(event, place) {
    const row = this.#rows.at(place);
    if (!row) return;
    if (event.target.closest("input[type=checkbox], .check") || event.ctrlKey || event.metaKey) {
      this.moveTo(place);
      this.toggle(place);
    } else if (event.shiftKey) {
      if (!this.selected.size) this.#anchor = this.cursor;
      this.moveTo(place);
      this.selectRange(this.#anchor, place);
    } else {
      this.#anchor = place;
      this.moveTo(place);
      if (event.target.closest(".picture")) this.onOpen(row);
    }
    this.focus();
  }

  #selectionChanged() {
    this.draw();
    this.onSelect();
  }

  #bringIntoView() {
    const [top, height] = [HEIGHT * this.cursor, this.#height];
    if (top < this.#body.scrollTop) this.#body.scrollTop = top;
    else if (top + HEIGHT > this.#body.scrollTop + height) this.#body.scrollTop = top + HEIGHT - height;
  }
}
