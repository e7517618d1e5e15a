// The lanes over the plots: time with the trim, segments, contact, stiffness, who drove, and marks.

import { h } from "../dataset/dom.js";
import { drag, navigates, place, timeUnder } from "./drag.js";
import { clamp } from "./playhead.js";
import { Segments } from "./segments.js";

const TICKS = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600];
const APART = 70; // [px] between ticks at least
const SHORTEST_TRIM = 0.1; // [s]
const KIND = { mode: "stiffness", limited: "limited", refused: "refused", event: "" };

export class Timeline {
  // `edit(changes)` sends an edit of the one take in view, whose `said` holds its trim and segments.
  constructor(takes, axis, playhead, edit) {
    Object.assign(this, { takes, axis, playhead, edit, spans: [], isHeld: false });
    this.isSingle = takes.length === 1;
    this.ticks = h("div", { class: "ticks" });
    this.ruler = this.lane("time [s]", "ruler", this.ticks);
    navigates(this.ruler.rail, axis, playhead);
    this.handles = this.isSingle ? ["in", "out"].map((side) => this.handle(side)) : [];
    this.ruler.rail.append(...this.handles);
    this.marks = takes.flatMap((take) => take.timeline.marks.map((mark) => ({ ...mark, take }))).sort((a, b) => this.at(a) - this.at(b));
    this.line = h("i", { class: "line" });
    this.shades = [h("i", { class: "shade" }), h("i", { class: "shade" })];
    this.over = h("div", { class: "over" }, this.line);
    this.segments = this.isSingle ? new Segments(this, edit) : null;
    this.element = h("div", { class: "lanes" }, [this.ruler, this.segments?.lane, ...this.bands(), this.events()].filter(Boolean).map((lane) => lane.element), h("div", { class: "cut" }, this.shades));
    this.setSaid(null, []);
  }

  // What people say about the take: its trim, or null, and its segments.
  setSaid(trim, segments) {
    if (!this.isHeld) this.trim = trim;
    this.segments?.set(segments);
    this.draw();
  }

  move() {
    const share = this.axis.share(this.playhead.time);
    this.line.style.left = `${100 * share}%`;
    this.line.hidden = share < -1e-6 || share > 1 + 1e-6;
  }

  // The stretch of time in view has changed, or what is said.
  draw() {
    const width = this.ruler.rail.clientWidth || 600;
    this.drawTicks(width);
    for (const { rail, parts } of this.spans) {
      let last = -Infinity;
      for (const { element, start, end, least } of parts) {
        const [left, right] = [this.axis.share(start) * width, this.axis.share(end) * width];
        const isOut = right < 0 || left > width || (right - last < 0.7 && !least);
        element.hidden = isOut;
        if (isOut) continue;
        last = right;
        place(element, left / width, Math.max(right - left, least || 0.7) / width);
      }
      rail.hidden = !parts.length;
    }
    this.drawTrim();
    this.segments?.draw();
    this.move();
  }

  // The next mark before (-1) or after (1) the playhead.
  jump(direction) {
    const { time } = this.playhead;
    const later = this.marks.map((mark) => this.at(mark)).filter((at) => (at - time) * direction > 0.001);
    if (later.length) this.seek(direction > 0 ? Math.min(...later) : Math.max(...later));
  }

  // Trim the take in or out at a time of it; null takes the trim away.
  setTrim(side, at) {
    const { duration } = this.takes[0].timeline;
    const [from, to] = this.trim ?? [0, duration];
    const trim = side === "in" ? [clamp(at, 0, to - SHORTEST_TRIM), to] : [from, clamp(at, from + SHORTEST_TRIM, duration)];
    this.trim = trim.map((time) => Number(time.toFixed(2)));
    this.saveTrim();
  }

  saveTrim() {
    const { duration } = this.takes[0].timeline;
    if (this.trim && this.trim[0] <= 0.005 && this.trim[1] >= duration - 0.005) this.trim = null;
    if (this.trim) this.trim[1] = Math.min(this.trim[1], duration);
    this.draw();
    this.edit(this.trim ? { trim: this.trim } : { clear: ["trim"] });
  }

  seek(at) {
    this.playhead.seek(at);
    this.axis.follow(at);
  }

  at({ start, take }) {
    return start - take.anchor;
  }

  lane(name, kind, ...content) {
    const rail = h("div", { class: "rail" }, ...content);
    return { rail, element: h("div", { class: `lane ${kind}` }, h("span", { title: name }, name), rail) };
  }

  strip(name, kind, parts, color) {
    const lane = this.lane(name, kind, parts.map(({ element }) => element));
    navigates(lane.rail, this.axis, this.playhead);
    if (color) lane.element.firstChild.style.color = color;
    this.spans.push({ rail: lane.element, parts });
    return lane;
  }

  // Contact and stiffness of each arm of each take, and who drove it.
  bands() {
    return this.takes.flatMap((take) => {
      const { arms } = take.timeline;
      const suffix = (arm) => (arms.length > 1 ? ` ${arm.name}` : "");
      const prefix = this.isSingle ? "" : `${take.letter} `;
      const part = (span, kind, title) => ({
        element: h("i", { class: kind, title }), start: span.start - take.anchor, end: span.end - take.anchor,
      });
      const color = this.isSingle ? "" : take.color;
      return [...arms.flatMap((arm) => [
        this.strip(`${prefix}contact${suffix(arm)}`, "band", arm.phases.filter(({ label }) => label === "contact").map(
          (span) => part(span, "contact", `contact, ${(span.end - span.start).toFixed(2)} s`)), color),
        this.strip(`${prefix}stiffness${suffix(arm)}`, "band", arm.modes.map(
          (span) => part(span, span.label.split(" ")[0], `${span.label}, ${(span.end - span.start).toFixed(2)} s`)), color),
      ]), ...this.driven(take, prefix, color)];
    });
  }

  driven(take, prefix, color) {
    const { marks, duration } = take.timeline;
    const taken = marks.filter(({ kind, text }) => kind === "event" && text.startsWith("driver: "));
    if (!taken.length) return [];
    const spans = taken.map(({ start, text }, index) => ({ start, end: taken[index + 1]?.start ?? duration, who: text.slice(8) }));
    if (spans[0].start > 0.01) spans.unshift({ start: 0, end: spans[0].start, who: take.row.agent });
    return [this.strip(`${prefix}driven by`, "band", spans.map(({ start, end, who }) => ({
      element: h("i", { class: `driver ${who.split(" ")[0]}`, title: `${who}, ${(end - start).toFixed(2)} s` }, who),
      start: start - take.anchor, end: end - take.anchor,
    })), color)];
  }

  events() {
    const parts = this.marks.map((mark) => {
      const who = [this.isSingle ? "" : mark.take.letter, mark.arm].filter(Boolean).join(" ");
      const title = `${mark.start.toFixed(2)} s · ${[who, KIND[mark.kind], mark.text].filter(Boolean).join(": ")}`;
      const jump = (event) => {
        event.stopPropagation();
        this.seek(this.at(mark));
      };
      const kind = mark.kind === "mode" ? `mode ${mark.text.split(" to ").at(-1).split(" ")[0]}` : mark.kind;
      const element = h("button", { class: `mark ${kind}`, title, "aria-label": title, onclick: jump, onpointerdown: (event) => event.stopPropagation() });
      return { element, start: this.at(mark), end: mark.end - mark.take.anchor, least: 5 };
    });
    return parts.length ? this.strip("events", "band marks", parts) : null;
  }

  drawTicks(width) {
    const { from, to } = this.axis;
    const step = TICKS.find((each) => (each / (to - from)) * width >= APART) ?? TICKS.at(-1);
    const digits = step < 0.1 ? 2 : step < 1 ? 1 : 0;
    const ticks = [];
    for (let number = Math.ceil(from / step - 1e-9); number * step <= to + 1e-9; number++) {
      ticks.push(h("i", { style: { left: `${100 * this.axis.share(number * step)}%` } }, (number * step).toFixed(digits)));
    }
    this.ticks.replaceChildren(...ticks);
  }

  handle(side) {
    const title = side === "in" ? "Trim in: drag, or press I" : "Trim out: drag, or press O";
    return h("button", {
      class: `trim ${side}`, title, "aria-label": title,
      onpointerdown: (event) => {
        if (event.button !== 0) return;
        const before = this.trim;
        const { duration } = this.takes[0].timeline;
        this.isHeld = true;
        drag(event, {
          move: (each) => {
            const at = clamp(timeUnder(each, this.ruler.rail, this.axis), 0, duration);
            const [from, to] = this.trim ?? [0, duration];
            this.trim = side === "in" ? [Math.min(at, to - SHORTEST_TRIM), to] : [from, Math.max(at, from + SHORTEST_TRIM)];
            this.drawTrim();
          },
          end: (each, hasMoved) => {
            this.isHeld = false;
            if (each && hasMoved) this.setTrim(side, this.trim[side === "in" ? 0 : 1]);
            else {
              this.trim = before;
              this.drawTrim();
            }
          },
        });
      },
      ondblclick: (event) => {
        event.stopPropagation();
        this.trim = null;
        this.saveTrim();
      },
    });
  }

  drawTrim() {
    if (!this.isSingle) return;
    const { duration } = this.takes[0].timeline;
    const [from, to] = (this.trim ?? [0, duration]).map((time) => this.axis.share(time));
    const [left, right] = [clamp(from, 0, 1), clamp(to, 0, 1)];
    place(this.shades[0], 0, left);
    place(this.shades[1], right, 1 - right);
    const { style } = this.element.parentElement ?? this.element; // plots shade what they show, too
    style.setProperty("--cut-in", `${100 * left}%`);
    style.setProperty("--cut-out", `${100 * (1 - right)}%`);
    this.handles.forEach((handle, index) => {
      const share = [from, to][index];
      handle.style.left = `${100 * share}%`;
      handle.hidden = share < -1e-6 || share > 1 + 1e-6;
      handle.classList.toggle("set", this.trim !== null);
    });
  }
}
