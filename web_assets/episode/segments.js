// Labelled stretches of a take: drawn by dragging along their lane, moved, resized, renamed and deleted.

import { h } from "../dataset/dom.js";
import { drag, place, timeUnder } from "./drag.js";
import { clamp } from "./playhead.js";

const SHORTEST = 0.05; // [s]
const SNAP = 6; // [px] to the playhead
const LABELS = ["approach", "contact", "wipe", "insert", "retract"];

export class Segments {
  constructor(timeline, edit) {
    Object.assign(this, { timeline, edit, all: [], chosen: null, last: LABELS[0], editing: null, isHeld: false });
    this.lane = timeline.lane("segments", "segments");
    this.rail = this.lane.rail;
    this.rail.title = "Drag to mark a segment; double-click one to rename it, Delete removes it.";
    this.rail.addEventListener("pointerdown", (event) => event.button === 0 && this.draft(event));
  }

  get duration() {
    return this.timeline.takes[0].timeline.duration;
  }

  set(segments) {
    if (this.editing || this.isHeld) return; // what is being typed or moved stays; its own edit comes next
    this.all = segments.map((segment) => ({ ...segment }));
    if (!this.all.some(({ segment_id: id }) => id === this.chosen)) this.chosen = null;
    this.build();
  }

  build() {
    this.rail.replaceChildren(...this.all.map((segment) => this.box(segment)), this.options());
    this.draw();
  }

  draw() {
    const { axis } = this.timeline;
    for (const box of this.rail.querySelectorAll(".segment")) {
      const { start, end } = box.segment;
      const [left, right] = [axis.share(start), axis.share(end)];
      box.hidden = right < 0 || left > 1;
      place(box, clamp(left, 0, 1), clamp(right, 0, 1) - clamp(left, 0, 1));
      box.classList.toggle("chosen", box.segment.segment_id === this.chosen);
    }
  }

  // Whether there was one to delete.
  deleteChosen() {
    const segment = this.all.find(({ segment_id: id }) => id === this.chosen);
    if (!segment) return false;
    this.all = this.all.filter((each) => each !== segment);
    this.chosen = null;
    this.build();
    this.edit({ remove_segments: [segment.segment_id] });
    return true;
  }

  // Whether one was chosen.
  choose(id) {
    const before = this.chosen;
    this.chosen = id;
    this.draw();
    return before !== null;
  }

  options() {
    const labels = new Set([...this.all.map(({ label }) => label), ...LABELS]);
    return h("datalist", { id: "segment-labels" }, [...labels].map((value) => h("option", { value })));
  }

  // The time under a pointer, at the playhead where that is near.
  at(event) {
    const { axis, playhead } = this.timeline;
    const time = timeUnder(event, this.rail, axis);
    const near = (SNAP * (axis.to - axis.from)) / this.rail.clientWidth;
    const wanted = Math.abs(time - playhead.time) < near ? playhead.time : time;
    return clamp(Number(wanted.toFixed(3)), 0, this.duration);
  }

  draft(event) {
    this.choose(null);
    const from = this.at(event);
    const segment = { start: from, end: from, label: "", segment_id: newId() };
    const box = this.box(segment);
    this.rail.append(box);
    this.isHeld = true;
    drag(event, {
      move: (each) => {
        [segment.start, segment.end] = [from, this.at(each)].sort((one, other) => one - other);
        this.draw();
      },
      end: (each, hasMoved) => {
        this.isHeld = false;
        if (!each || !hasMoved || segment.end - segment.start < SHORTEST) {
          box.remove();
          if (each && !hasMoved) this.timeline.seek(from);
          return;
        }
        this.all.push(segment);
        this.name(box, true);
      },
    });
  }

  box(segment) {
    const box = h(
      "div", {
        class: "segment", "data-id": segment.segment_id,
        onpointerdown: (event) => event.button === 0 && this.moveBox(event, segment, "both"),
        ondblclick: (event) => {
          event.stopPropagation();
          this.name(box, false);
        },
      },
      h("i", { class: "edge", onpointerdown: (event) => this.moveBox(event, segment, "start") }),
      h("b", {}, segment.label),
      h("i", { class: "edge", onpointerdown: (event) => this.moveBox(event, segment, "end") }),
    );
    box.title = `${segment.label} · ${segment.start.toFixed(2)}–${segment.end.toFixed(2)} s`;
    box.segment = segment;
    return box;
  }

  moveBox(event, segment, what) {
    if (event.target.closest("input")) return event.stopPropagation();
    const before = { ...segment };
    const from = timeUnder(event, this.rail, this.timeline.axis);
    const length = before.end - before.start;
    this.choose(segment.segment_id);
    this.isHeld = true;
    drag(event, {
      move: (each) => {
        if (what === "both") {
          const by = timeUnder(each, this.rail, this.timeline.axis) - from;
          segment.start = Number(clamp(before.start + by, 0, this.duration - length).toFixed(3));
          segment.end = Number(Math.min(segment.start + length, this.duration).toFixed(6));
        } else if (what === "start") segment.start = Math.min(this.at(each), segment.end - SHORTEST);
        else segment.end = Math.max(this.at(each), segment.start + SHORTEST);
        this.draw();
      },
      end: (each, hasMoved) => {
        this.isHeld = false;
        if (each && hasMoved) this.put(segment);
        else Object.assign(segment, before);
        this.draw();
      },
    });
  }

  // Type the label of a segment; a new one that gets none is forgotten on Escape.
  name(box, isNew) {
    const { segment } = box;
    const input = h("input", { value: isNew ? this.last : segment.label, list: "segment-labels", "aria-label": "Label of the segment", maxLength: 60 });
    this.editing = segment;
    this.choose(segment.segment_id);
    const finish = (isKept) => {
      if (this.editing !== segment) return;
      this.editing = null;
      const label = input.value.trim();
      if (isKept && label) {
        [segment.label, this.last] = [label, label];
        this.put(segment);
      } else if (isNew) this.all = this.all.filter((each) => each !== segment);
      this.build();
    };
    input.addEventListener("keydown", (event) => {
      event.stopPropagation();
      if (event.key === "Enter") finish(true);
      if (event.key === "Escape") finish(false);
    });
    input.addEventListener("blur", () => finish(true));
    box.querySelector("b").replaceChildren(input);
    input.focus();
    input.select();
  }

  put({ start, end, label, segment_id }) {
    this.edit({ put_segments: [{ start, end, label, segment_id }] });
  }
}

function newId() {
  return Array.from(crypto.getRandomValues(new Uint8Array(6)), (byte) => byte.toString(16).padStart(2, "0")).join("");
}
