// Curves over the steps of training, one line for each run or group; uPlot draws them.

import uPlot from "../node_modules/uplot/dist/uPlot.esm.js";
import { h } from "../dataset/dom.js";

// Okabe and Ito's colours, told apart by everybody; as in the figures of the report.
export const COLORS = ["#56b4e9", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#f0e442", "#8fa8ff", "#d8dce3"];
const GRID = { stroke: "#2f353d", width: 1 };
const AXIS = { stroke: "#8f97a3", grid: GRID, ticks: GRID, font: "11px system-ui", size: 54 };

export class Chart {
  constructor(title, { unit = "", isLog = false } = {}) {
    this.isLog = isLog;
    this.unit = unit;
    this.box = h("div", { class: "plot" });
    this.element = h("figure", { class: "chart", hidden: true }, h("figcaption", {}, title, unit && h("small", { class: "dim" }, ` ${unit}`)), this.box);
    this.watch = new ResizeObserver(() => this.plot?.setSize(this.size()));
    this.watch.observe(this.box);
  }

  size() {
    return { width: Math.max(120, this.box.clientWidth), height: 190 };
  }

  // series: [{label, color, step: [], value: [], isDashed, hasPoints}, …]
  show(series) {
    const drawn = series.filter(({ step }) => step.length);
    this.element.hidden = !drawn.length;
    if (!drawn.length) return;
    const key = JSON.stringify([this.isLog, drawn.map(({ label, color }) => [label, color])]);
    const data = uPlot.join(drawn.map(({ step, value }) => [step, this.isLog ? value.map((v) => (v > 0 ? v : null)) : value]));
    if (key === this.key) return void this.plot.setData(data);
    this.key = key;
    this.plot?.destroy();
    this.plot = new uPlot({
      ...this.size(),
      scales: { x: { time: false }, y: { distr: this.isLog ? 3 : 1, range: (_, low, high) => (this.isLog ? decades(low, high) : spread(low, high)) } },
      axes: [{ ...AXIS, size: 28 }, { ...AXIS, values: (_, ticks) => ticks.map((v) => (v === null || (this.isLog && !isRound(v)) ? "" : short(v))) }],
      series: [{ label: "step" }, ...drawn.map(({ label, color, isDashed, hasPoints }) => ({
        label, stroke: color, width: isDashed ? 1 : 1.6, dash: isDashed ? [4, 3] : undefined, spanGaps: true,
        points: { show: !!hasPoints, size: 5, fill: color }, value: (_, v) => (v === null || v === undefined ? "–" : short(v)),
      }))],
      cursor: { sync: { key: "steps" }, drag: { x: true, y: false } },
      legend: { live: true, markers: { dash: (_, n) => (drawn[n - 1]?.isDashed ? "dashed" : "solid") } },
    }, data, this.box);
  }

  close() {
    this.watch.disconnect();
    this.plot?.destroy();
  }
}

function spread(low, high) {
  if (low === null || high === null) return [0, 1];
  const margin = 0.05 * (high - low || Math.abs(high) || 1);
  return [low >= 0 ? Math.max(0, low - margin) : low - margin, high + margin];
}

// Of a logarithmic scale: as much above and below, and at least half a decade.
function decades(low, high) {
  if (!(low > 0)) return [0.1, 1];
  const margin = Math.max(1.15, Math.sqrt(3 / (high / low)));
  return [low / margin, high * margin];
}

// Not the end of a logarithmic scale, which may be any number.
const isRound = (v) => Math.abs(Number(v.toPrecision(1)) / v - 1) < 1e-9;

function short(v) {
  const size = Math.abs(v);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) return v.toExponential(1);
  return String(Number(v.toPrecision(3)));
}
