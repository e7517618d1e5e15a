// Plots of one take, or of several over each other, on the common axis.

import uPlot from "/assets/node_modules/uplot/dist/uPlot.esm.js";
import { h } from "../dataset/dom.js";
import { newest } from "./playhead.js";

export const GUTTER = 92; // [px] left of every plot and lane
export const MARGIN = 14; // [px] right of them
const HEIGHTS = [64, 92, 148]; // [px] of a plot
const REMEMBERED = "studio.plots"; // in the browser's storage
const WHITE = "#e6e9ee";
const XYZ = ["#f0605f", "#55c667", "#5b9dff"];
const ARM_COLORS = [WHITE, "#ffb84d"];

const aboutZero = (least) => ({ min: { soft: -least, mode: 1, pad: 0.1 }, max: { soft: least, mode: 1, pad: 0.1 } });
const fromZero = (least) => (_, __, most) => [0, Math.max(least, 1.1 * (most ?? 0))];

// What can be plotted. `axes` are components, told apart for one take; of several only `whole` is compared.
const QUANTITIES = [
  { key: "force", title: "Force", unit: "N", axes: ["force_x", "force_y", "force_z"], whole: "force", range: aboutZero(2), digits: 1 },
  { key: "torque", title: "Torque", unit: "N·m", axes: ["torque_x", "torque_y", "torque_z"], whole: "torque", range: aboutZero(0.2), digits: 2 },
  { key: "stiffness", title: "Stiffness", unit: "N/m", whole: "stiffness", range: fromZero(800), digits: 0 },
  { key: "gripper", title: "Gripper open", unit: "%", whole: "gripper", range: () => [-5, 105], digits: 0 },
  { key: "error", title: "Tracking error", unit: "mm", whole: "error", range: fromZero(5), digits: 1 },
  { key: "turn", title: "Angle off target", unit: "°", whole: "turn", range: fromZero(2), digits: 1 },
];

function remembered() {
  const usual = { hidden: ["turn"], series: [], size: 1 };
  try {
    return { ...usual, ...JSON.parse(localStorage.getItem(REMEMBERED)) };
  } catch {
    return usual;
  }
}

export class Plots {
  // `onPointer(element)` makes what happens on a plot's area move the playhead or the axis.
  constructor(takes, axis, playhead, onPointer) {
    Object.assign(this, { takes, axis, playhead, onPointer, spread: null, drawn: [], onResize: () => {} });
    this.state = remembered();
    this.element = h("div", { class: "plots" });
    this.toggles = h("div", { class: "toggles", role: "group", "aria-label": "Plots" });
    this.arms = [...new Set(takes.flatMap((take) => take.timeline.arms.map((arm) => arm.name)))];
    this.resizing = new ResizeObserver(() => {
      this.resize();
      this.onResize();
    });
    this.resizing.observe(this.element);
    this.build();
  }

  close() {
    this.resizing.disconnect();
    this.drawn.forEach(({ plot }) => plot.destroy());
  }

  // Mean and standard deviation of several takes, drawn behind them; null takes them away.
  setSpread(spread) {
    this.spread = spread;
    this.build();
  }

  // The takes have other curves, e.g. finer ones.
  refresh() {
    for (const each of this.drawn) {
      each.read = each.series.map((one) => one.read());
      each.plot.setData(this.dataOf(each.read), true);
    }
    this.move();
  }

  // Another stretch of time is in view.
  zoom() {
    for (const { plot } of this.drawn) plot.setScale("x", { min: this.axis.from, max: this.axis.to });
  }

  // What the curves are at the playhead.
  move() {
    for (const { read, values, quantity } of this.drawn) {
      values.forEach((element, index) => {
        const [times, curve] = read[index];
        const isWithin = this.playhead.time <= times.at(-1) + 0.1 && this.playhead.time >= times[0] - 0.1;
        const value = isWithin ? curve[newest(times, this.playhead.time)] : null;
        const text = value === null || value === undefined ? "–" : value.toFixed(quantity.digits);
        if (element.firstChild.data !== text) element.firstChild.data = text;
      });
    }
  }

  resize() {
    const width = this.element.clientWidth;
    const height = HEIGHTS[this.state.size];
    for (const { plot } of this.drawn) if (width && (plot.width !== width || plot.height !== height)) plot.setSize({ width, height });
  }

  build() {
    this.drawn.forEach(({ plot }) => plot.destroy());
    this.drawn = [];
    this.buildToggles();
    const shown = this.specs().filter(({ quantity }) => !this.isHidden(quantity.key));
    this.element.replaceChildren(...shown.map((spec) => this.draw(spec)));
    if (!shown.length) this.element.append(h("p", { class: "empty" }, "Choose above what to plot."));
    this.move();
  }

  buildToggles() {
    const chip = (key, text) => h("button", {
      "aria-pressed": String(!this.isHidden(key)), onclick: () => this.toggle("hidden", key),
    }, text);
    const arms = this.arms.length > 1 ? [h("i", {}), ...this.arms.map((arm) => chip(`arm ${arm}`, arm))] : [];
    const size = h("button", { title: "Height of the plots", onclick: () => this.resizePlots() }, "↕");
    this.toggles.replaceChildren(...QUANTITIES.map(({ key, title }) => chip(key, title)), ...arms, size);
  }

  resizePlots() {
    this.state.size = (this.state.size + 1) % HEIGHTS.length;
    this.remember();
    this.resize();
  }

  isHidden(key) {
    return this.state.hidden.includes(key);
  }

  toggle(list, key) {
    const before = this.state[list];
    this.state[list] = before.includes(key) ? before.filter((each) => each !== key) : [...before, key];
    this.remember();
    this.build();
  }

  remember() {
    localStorage.setItem(REMEMBERED, JSON.stringify(this.state));
  }

  // What each plot shows: its series, in the order in which they are drawn.
  specs() {
    const arms = this.arms.filter((arm) => !this.isHidden(`arm ${arm}`));
    const named = (title, arm) => (this.arms.length > 1 ? `${title}, ${arm}` : title);
    return QUANTITIES.flatMap((quantity) => {
      if (this.takes.length === 1 && !quantity.axes) {
        const series = arms.map((arm) => this.curve(0, arm, quantity.whole, arms.length > 1 ? arm : "", ARM_COLORS[this.arms.indexOf(arm) % 2]));
        return series.length ? [{ quantity, title: quantity.title, arm: null, series }] : [];
      }
      return arms.map((arm) => ({
        quantity, arm, title: named(quantity.title, arm),
        series: this.takes.length > 1 ? this.compared(quantity, arm) : [
          ...quantity.axes.map((name, index) => this.curve(0, arm, name, "xyz"[index], XYZ[index])),
          this.curve(0, arm, quantity.whole, "norm", WHITE),
        ],
      }));
    });
  }

  compared(quantity, arm) {
    const key = `${arm}/${quantity.whole}`;
    const series = this.takes.map((take, index) => this.curve(index, arm, quantity.whole, take.letter, take.color));
    if (!this.spread?.mean[key]) return series;
    const { time, mean, sd } = this.spread;
    const [low, high] = [-1, 1].map((sign) => mean[key].map((value, index) => (value === null ? null : value + sign * sd[key][index])));
    const common = { stroke: "#aab2bd", width: 0 };
    return [
      { ...common, label: "high", read: () => [time, high], isEdge: true },
      { ...common, label: "low", read: () => [time, low], isEdge: true },
      { ...common, label: "mean", read: () => [time, mean[key]], width: 1.5, dash: [5, 4] },
      ...series,
    ];
  }

  curve(index, arm, name, label, color) {
    const read = () => {
      const { anchor, curves } = this.takes[index];
      const values = curves?.curves[`${arm}/${name}`];
      if (!values) return [[], []];
      return [anchor ? curves.time.map((time) => time - anchor) : curves.time, values];
    };
    return { label, stroke: color, width: XYZ.includes(color) && this.takes.length === 1 ? 1 : 1.4, read, of: `${name} ${label}` };
  }

  dataOf(read) {
    if (read.every(([time]) => time === read[0][0])) return [read[0][0], ...read.map(([, values]) => values)];
    return uPlot.join(read.map(([time, values]) => [time, values]));
  }

  draw({ quantity, arm, title, series }) {
    const lines = series.map((each) => ({
      label: each.label, stroke: each.stroke, width: each.width, dash: each.dash, spanGaps: series.length > 1 && this.takes.length > 1,
      points: { show: false }, show: !this.state.series.includes(each.of),
    }));
    const bands = series[0]?.isEdge ? [{ series: [1, 2], fill: "rgba(170, 178, 189, 0.22)" }] : [];
    const read = series.map((each) => each.read());
    const host = h("div", { class: "plot", "data-plot": title });
    const plot = new uPlot({
      width: this.element.clientWidth || 640,
      height: HEIGHTS[this.state.size],
      padding: [6, MARGIN, 4, 0],
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: false, range: () => [this.axis.from, this.axis.to] }, y: { range: quantity.range } },
      axes: [
        { size: 0, values: () => [], ticks: { show: false }, grid: { stroke: "#2b3037", width: 1 }, space: 80 },
        { size: GUTTER, space: 24, stroke: "#8f97a3", font: "11px system-ui", gap: 4, ticks: { size: 3, stroke: "#3a414b" }, grid: { stroke: "#2b3037", width: 1 } },
      ],
      series: [{}, ...lines],
      bands,
      hooks: { drawClear: [(u) => this.shade(u, arm)] },
    }, this.dataOf(read), host);
    this.onPointer(plot.over);
    const values = series.map(() => h("b", {}, "–"));
    const key = h("div", { class: "key" }, h("span", {}, `${title} [${quantity.unit}]`), series.map((each, index) => (each.isEdge || (!each.label && series.length === 1)
      ? each.isEdge ? null : values[index]
      : h("button", {
        style: { color: each.stroke }, "aria-pressed": String(!this.state.series.includes(each.of)),
        title: "Show or hide", onclick: () => this.toggle("series", each.of),
      }, each.label, " ", values[index]))));
    host.prepend(key);
    this.drawn.push({ plot, series, read, values, quantity });
    return host;
  }

  // Contact, behind the curves of the arm that feels it.
  shade(plot, arm) {
    if (this.takes.length > 1) return;
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.fillStyle = "rgba(217, 138, 31, 0.11)";
    for (const { name, phases } of this.takes[0].timeline.arms) {
      if (arm !== null && name !== arm) continue;
      for (const { start, end, label } of phases) {
        if (label !== "contact" || end < this.axis.from || start > this.axis.to) continue;
        const [left, right] = [start, end].map((time) => bbox.left + Math.min(Math.max(this.axis.share(time), 0), 1) * bbox.width);
        ctx.fillRect(left, bbox.top, Math.max(right - left, 1), bbox.height);
      }
    }
    ctx.restore();
  }
}
