// One take in view, or several over each other: cameras, timeline and plots at one time.

import { attempt, h, isTyping, toast } from "../dataset/dom.js";
import { Cameras } from "./cameras.js";
import { Axis, Playhead, SPEEDS } from "./playhead.js";
import { Plots } from "./plots.js";
import { align, nameOf, path, reach, takeOf, when } from "./takes.js";
import { ThreeD } from "./three_d.js";
import { navigates } from "./drag.js";
import { Timeline } from "./timeline.js";

const POINTS = 900; // stretches of a curve over the width of a screen
const SETTLED = 150; // [ms] after the last zoom finer curves are fetched
const MOST = 8; // takes over each other
const STYLES = ["/assets/node_modules/uplot/dist/uPlot.min.css", "/assets/episode/episode.css"];
const KEYS = [
  ["Space", "play, pause"], ["← →", "one image; with Shift ten"], ["Home End", "first, last"], ["[ ]", "mark before, after"],
  ["− +", "slower, faster"], ["Z", "show all"], ["I O", "trim in, out here"], ["Del", "remove the chosen segment"],
];

function addStyles() {
  for (const href of STYLES) {
    if (!document.querySelector(`link[href="${href}"]`)) document.head.append(h("link", { rel: "stylesheet", href }));
  }
}

export class EpisodeView {
  // `changed(row)` is called after each edit, `selected()` gives the rows that are selected in the table.
  constructor(section, { api, changed = () => {}, selected = () => [], author = () => undefined, close = null }) {
    Object.assign(this, { section, api, changed, selected, author, onClose: close, takes: [], opening: 0 });
    this.threeD = new ThreeD(api);
    addStyles();
  }

  get keys() {
    return KEYS;
  }

  // Show one take. One that is shown already keeps its time; what is said about it may have changed.
  open(row) {
    if (this.takes.length === 1 && this.takes[0].row.episode_id === row.episode_id && this.timeline) {
      this.takes[0].row = row;
      this.showHead();
      return this.readSaid();
    }
    return this.show([row]);
  }

  // Lay several takes over each other.
  compare(rows) {
    if (rows.length > MOST) toast(`Of ${rows.length} takes the first ${MOST} are laid over each other; the band is of all.`);
    return this.show(rows.slice(0, MOST), rows);
  }

  close() {
    this.leave();
    this.threeD.leave();
    this.section.replaceChildren();
  }

  // Whether it did something for a key.
  key(event) {
    if (!this.playhead || isTyping() || event.ctrlKey || event.metaKey || event.altKey) return false;
    const { playhead, axis, timeline } = this;
    const single = this.takes.length === 1 && timeline;
    const acts = {
      " ": () => playhead.toggle(),
      ArrowLeft: () => playhead.step(event.shiftKey ? -10 : -1),
      ArrowRight: () => playhead.step(event.shiftKey ? 10 : 1),
      Home: () => this.go(axis.min),
      End: () => this.go(axis.max),
      "[": () => timeline?.jump(-1),
      "]": () => timeline?.jump(1),
      "-": () => playhead.shift(-1),
      "+": () => playhead.shift(1),
      "=": () => playhead.shift(1),
      z: () => axis.showAll(),
      i: () => single && timeline.setTrim("in", playhead.time),
      o: () => single && timeline.setTrim("out", playhead.time),
    };
    if (event.key === "Delete" || event.key === "Backspace") return !!(single && timeline.segments.deleteChosen());
    if (event.key === "Escape") return !!(single && timeline.segments.choose(null));
    const act = acts[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    act?.();
    return act !== undefined;
  }

  go(time) {
    this.playhead.seek(time);
    this.axis.follow(time);
  }

  leave() {
    this.opening += 1;
    clearTimeout(this.finer);
    this.playhead?.stop();
    this.cameras?.close();
    this.plots?.close();
    Object.assign(this, { takes: [], playhead: null, cameras: null, plots: null, timeline: null });
  }

  async show(rows, all = rows) {
    this.leave();
    performance.mark("episode-open");
    const opening = this.opening;
    this.takes = rows.map(takeOf);
    this.all = all;
    this.alignment = "start";
    this.axis = new Axis(...reach(this.takes));
    this.playhead = new Playhead(this.axis);
    this.cameras = new Cameras(this.api, this.takes, this.section.clientWidth);
    this.build();
    const read = await attempt(() => Promise.all(this.takes.map((take) => this.read(take))));
    if (opening !== this.opening) return;
    if (!read) return this.body.replaceChildren(h("p", { class: "empty" }, "This take cannot be shown; the message says why."));
    this.lay();
    performance.mark("episode-drawn");
    this.section.dataset.drawn = this.takes.map((take) => take.row.episode_id).join(" ");
    if (this.takes.length === 1) await this.readSaid();
  }

  async read(take) {
    const [timeline, curves] = await Promise.all([
      this.api.get(`${path(take)}/timeline`), this.api.get(`${path(take)}/curves`, { points: POINTS }),
    ]);
    Object.assign(take, { timeline, curves, whole: curves });
    const place = this.takes.indexOf(take); // -1 where another take was opened, or none, meanwhile
    if (place >= 0) this.cameras.setTimes(place, timeline.images);
  }

  // What people say about the one take: trim and segments.
  async readSaid() {
    const [take] = this.takes;
    const details = await attempt(() => this.api.get(path(take)));
    if (!details || this.takes[0] !== take) return;
    take.row = details.row;
    this.timeline?.setSaid(details.row.trim, details.segments);
    this.showHead();
  }

  async edit(changes) {
    const [take] = this.takes;
    const author = this.author();
    const row = await attempt(() => this.api.post(`${path(take)}/annotations`, { ...(author && { author }), ...changes }));
    if (row) this.changed(row);
    if (this.takes[0] === take && take.row !== row) await this.readSaid();
  }

  // Timeline and plots anew, on an axis of their own.
  lay() {
    this.plots?.close();
    align(this.takes, this.alignment);
    const before = this.playhead;
    this.axis = new Axis(...reach(this.takes));
    this.playhead = Object.assign(new Playhead(this.axis), { speed: before.speed });
    before.stop();
    this.timeline = new Timeline(this.takes, this.axis, this.playhead, (changes) => this.edit(changes));
    this.plots = new Plots(this.takes, this.axis, this.playhead, (area) => navigates(area, this.axis, this.playhead));
    this.bar.querySelector(".toggles").replaceWith(this.plots.toggles);
    this.body.replaceChildren(h("div", { class: "stack" }, this.timeline.element, this.plots.element, this.timeline.over));
    this.axis.listeners.push(() => this.zoomed());
    this.playhead.listeners.push(() => this.moved());
    this.plots.onResize = () => this.timeline.draw();
    this.plots.resize();
    this.timeline.draw();
    if (this.takes.length > 1) this.playhead.move(0);
    else this.playhead.move(before.time);
  }

  moved() {
    const { playhead, timeline, plots, cameras, takes } = this;
    cameras.show(takes.map((take) => playhead.time + take.anchor), playhead.isPlaying);
    timeline.move();
    plots.move();
    this.clock.textContent = playhead.time.toFixed(2);
    this.play.textContent = playhead.isPlaying ? "❚❚" : "▶";
    this.play.setAttribute("aria-label", playhead.isPlaying ? "Pause" : "Play");
    this.speed.value = playhead.speed;
    this.threeD.show(takes, playhead.time + takes[0].anchor, playhead.isPlaying ? playhead.speed : 0);
  }

  zoomed() {
    const { from, to, isWhole } = this.axis;
    for (const take of this.takes) {
      const { start = -Infinity, end = Infinity } = take.curves;
      const isCovered = start <= Math.max(from + take.anchor, 0) && end >= Math.min(to + take.anchor, take.timeline.duration);
      if (isWhole || !isCovered) take.curves = take.whole;
    }
    this.plots.zoom();
    this.plots.refresh();
    this.timeline.draw();
    this.whole.hidden = isWhole;
    clearTimeout(this.finer);
    if (!isWhole) this.finer = setTimeout(() => this.readFiner(), SETTLED);
  }

  // Curves of the stretch in view, and somewhat more, as fine as there are.
  async readFiner() {
    const { from, to } = this.axis;
    const { takes } = this;
    const more = 0.5 * (to - from);
    const read = await attempt(() => Promise.all(takes.map(async (take) => {
      const start = Math.max(from - more + take.anchor, 0);
      const end = Math.min(to + more + take.anchor, take.timeline.duration);
      if (take.whole.is_exact || start >= end) return null;
      return { start, end, ...(await this.api.get(`${path(take)}/curves`, { points: 2 * POINTS, start, end })) };
    })));
    if (!read || takes !== this.takes || from !== this.axis.from || to !== this.axis.to) return;
    takes.forEach((take, index) => { take.curves = read[index] ?? take.curves; });
    this.plots.refresh();
  }

  async band(isShown) {
    const ids = this.all.map((row) => row.episode_id);
    const spread = isShown ? await attempt(() => this.api.get("/spread", { episode_id: ids, align: this.alignment })) : null;
    if (spread?.left_out.length) toast(`${spread.left_out.length} of the takes never touch anything, so they are not in the band.`);
    this.plots?.setSpread(spread ?? null);
  }

  // The parts that stay while a take is in view

  build() {
    this.head = h("div", { class: "take-head" });
    this.bar = h("div", { class: "controls" }, this.transport(), h("div", { class: "toggles" }));
    this.body = h("div", { class: "take-body" }, h("p", { class: "empty" }, "Reading…"));
    this.section.replaceChildren(h("div", { class: "view" }, this.head, this.cameras.element, this.bar, this.body));
    this.showHead();
  }

  transport() {
    const button = (label, text, act) => h("button", { "aria-label": label, title: label, onclick: (event) => {
      act();
      event.currentTarget.blur(); // or the space bar would press it again
    } }, text);
    this.play = button("Play", "▶", () => this.playhead.toggle());
    this.play.classList.add("play");
    this.clock = h("b", { class: "clock" }, "0.00");
    this.speed = h("select", { "aria-label": "Speed", onchange: () => {
      this.playhead.setSpeed(Number(this.speed.value));
      this.speed.blur();
    } }, SPEEDS.map((speed) => h("option", { value: String(speed) }, `${speed}×`)));
    this.speed.value = "1";
    this.whole = button("Show all of it (Z)", "Show all", () => this.axis.showAll());
    this.whole.hidden = true;
    return h("div", { class: "transport" },
      button("One image back (←)", "‹", () => this.playhead.step(-1)), this.play,
      button("One image on (→)", "›", () => this.playhead.step(1)), this.speed,
      h("span", { class: "time" }, this.clock, " s"), this.whole);
  }

  showHead() {
    const isSingle = this.takes.length === 1;
    this.head.replaceChildren(isSingle ? this.about(this.takes[0].row) : this.legend(), h("div", { class: "actions" },
      isSingle ? this.links(this.takes[0].row) : this.choices(),
      this.onClose && h("button", { class: "leave", "aria-label": "Close the take", title: "Close (Esc)", onclick: this.onClose }, "×")));
  }

  about(row) {
    const facts = [`${row.duration.toFixed(1)} s`, row.operator !== row.agent ? `${row.operator} (${row.agent})` : row.operator, when(row),
      row.trim && `trimmed to ${row.trim.map((time) => time.toFixed(2)).join("–")} s`];
    return h("div", { class: "about" }, h("b", {}, nameOf(row)), h("span", { class: `outcome ${row.outcome}` }, row.outcome),
      facts.filter(Boolean).map((fact) => h("span", {}, fact)));
  }

  legend() {
    return h("div", { class: "about" }, this.takes.map(({ row, letter, color }) => h(
      "button", { class: "of", title: `${row.episode_id}: open it alone`, onclick: () => this.open(row) },
      h("span", { class: "letter", style: { background: color } }, letter), `${nameOf(row)} · ${row.operator} · ${row.outcome}`)));
  }

  links(row) {
    const films = row.cameras.map((camera) => h("a", {
      href: this.api.url(`${path(this.takes[0])}/video/${encodeURIComponent(camera)}.mp4`), download: `${row.episode_id}.${camera}.mp4`,
    }, `${camera.replaceAll("_", " ")}, film`));
    const menu = h("details", { class: "menu" }, h("summary", {}, "Download"), h("div", {},
      h("a", { href: this.api.url(`${path(this.takes[0])}/recording`) }, "recording, MCAP"), films));
    return [
      h("button", { onclick: () => this.compareWithSelected(), title: "Lay the takes selected in the table over this one" }, "Compare"),
      menu,
      !this.threeD.isThere && h("a", { class: "button", href: `/?episode=${encodeURIComponent(row.episode_id)}`, target: "studio", title: "In the studio's 3-D view" }, "3-D"),
    ];
  }

  choices() {
    const at = h("select", { "aria-label": "Align at", onchange: () => this.realign(at.value) },
      h("option", { value: "start" }, "aligned at start"), h("option", { value: "contact" }, "aligned at first contact"));
    this.banded = h("input", { type: "checkbox", onchange: () => this.band(this.banded.checked) });
    return [at, h("label", {}, this.banded, ` mean ± sd of ${this.all.length}`)];
  }

  async realign(alignment) {
    this.alignment = alignment;
    const without = alignment === "contact" ? this.takes.filter((take) => take.timeline.first_contact === null) : [];
    if (without.length) toast(`${without.map((take) => take.letter).join(", ")} never touches anything; aligned at its start.`);
    this.lay();
    if (this.banded.checked) await this.band(true);
  }

  compareWithSelected() {
    const [{ row }] = this.takes;
    const others = this.selected().filter((each) => each.episode_id !== row.episode_id);
    if (others.length) return this.compare([row, ...others]);
    return toast("Select one or more other takes in the table first.");
  }
}
