// Charts over the frames, with one cursor for all.
import uPlot from "./vendor/uPlot.esm.js";
import { termButton } from "./terms.js";
import { DASH, lag, number, percent, shareOfPeak, surrogateError, tracedShare } from "./words.js";

const STAGES = ["render", "trace", "predict", "audit", "train", "checkpoint", "slide", "refine"];
const COLOURS = ["--blue", "--orange", "--green", "--purple", "--vermillion", "--sky", "--yellow", "--muted"];

const pick = (value) => (Number.isFinite(value) ? value : null);

/** The numbers of a record that the charts show. */
export function rowOf(record) {
  const { picture_error: picture, trusted_error: trusted, seconds, live } = record;
  const error = pick(surrogateError(record));
  // The interval is that of the trusted region.
  const [low, high] = error === trusted?.optical_rms ? (trusted.optical_rms_interval ?? []) : [];
  const row = {
    frame: record.frame,
    elapsed: pick(seconds?.elapsed),
    psnr: pick(picture?.psnr?.value),
    psnrLow: pick(picture?.psnr?.low),
    psnrHigh: pick(picture?.psnr?.high),
    surrogate: error,
    surrogateLow: pick(low),
    surrogateHigh: pick(high),
    // Without a surrogate there is nothing to allow, whatever is trusted.
    tolerance: record.surrogate ? pick(record.tolerance) : null,
    traced: tracedShare(record),
    loss: pick(record.training?.loss),
    time: live ? pick(record.time) : null,
    lag: pick(lag(record)),
    delay: pick(live?.delay),
  };
  for (const stage of STAGES) row[stage] = pick(seconds?.[stage]);
  return row;
}

const decibels = (value) => (value === null ? DASH : `${number(value)} dB (${percent(shareOfPeak(value))})`);
const seconds = (value) => (value === null ? DASH : `${number(value)} s`);
const line = (key, label, colour, words, more) => ({ key, label, colour, words, ...more });
const interval = (low, high, colour, words) => [line(low, "95 % from", colour, words, { width: 0 }), line(high, "to", colour, words, { width: 0 })];

/** A chart: series in order, bands between series (numbers from 1), and the field without which it is hidden (`needs`). */
const CHARTS = [
  {
    title: "Error of the picture (PSNR, higher is better)", term: "psnr", needs: "psnr", unit: "dB",
    series: [line("psnr", "PSNR", "--blue", decibels), ...interval("psnrLow", "psnrHigh", "--blue", decibels)],
    bands: [[3, 2]],
  },
  {
    title: "Error of the surrogate, and tolerance", term: "surrogate_error", needs: "tolerance", floor: 0, share: true,
    series: [
      line("surrogate", "error, rms", "--orange", percent), ...interval("surrogateLow", "surrogateHigh", "--orange", percent),
      line("tolerance", "tolerance", "--vermillion", percent, { dash: [6, 4] }),
    ],
    bands: [[3, 2]],
  },
  { title: "Share traced", term: "traced", needs: "traced", floor: 0, ceiling: 1, share: true, series: [line("traced", "traced", "--green", percent)] },
  {
    title: "Frame time by stage", floor: 0, unit: "s", stacked: true,
    series: STAGES.map((stage, index) => line(stage, stage, COLOURS[index], seconds, { width: 0 })),
    bands: STAGES.slice(1).map((_, index) => [index + 2, index + 1]),
  },
  {
    title: "Simulation time and lag", term: "lag", needs: "lag", floor: 0, unit: "s",
    series: [
      line("lag", "lag", "--vermillion", seconds), line("delay", "of which delivery", "--sky", seconds),
      line("time", "simulation time t0 (right)", "--blue", (value) => number(value, 5), { scale: "time" }),
    ],
  },
  { title: "Loss of training", term: "loss", needs: "loss", log: true, series: [line("loss", "loss", "--purple", (value) => number(value))] },
];

let palette = {};

function readPalette() {
  const style = getComputedStyle(document.documentElement);
  const names = ["--text", "--muted", "--grid", "--accent", ...COLOURS];
  palette = Object.fromEntries(names.map((name) => [name, style.getPropertyValue(name).trim()]));
  palette.font = `${0.75 * parseFloat(style.fontSize)}px system-ui, sans-serif`;
}

const rem = () => parseFloat(getComputedStyle(document.documentElement).fontSize);

function range(spec) {
  return (_, min, max) => {
    if (min == null) return [0, spec.ceiling ?? 1];
    const pad = 0.08 * (max - min) || 0.05 * Math.abs(max) || 1;
    return [spec.floor ?? min - pad, spec.ceiling ?? max + pad];
  };
}

// Log scales choose their own range.
const yScale = (spec) => (spec.log ? { distr: 3 } : { range: range(spec) });

function axis(more) {
  const grid = { stroke: () => palette["--grid"], width: 1 };
  return { stroke: () => palette["--muted"], font: palette.font, grid, ticks: grid, ...more };
}

function axes(spec) {
  const words = spec.share ? percent : (value) => number(value, spec.log ? 1 : 3);
  const left = axis({ scale: "y", size: 3.6 * rem(), values: (_, splits) => splits.map((value) => (value === null ? "" : words(value))) });
  const right = axis({ scale: "time", side: 1, size: 3.6 * rem(), grid: { show: false }, values: (_, splits) => splits.map((value) => number(value, 5)) });
  const bottom = axis({ size: 1.8 * rem(), space: 4 * rem(), incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1e3, 2e3, 5e3, 1e4, 1e5, 1e6] });
  return [bottom, left, ...(spec.series.some((series) => series.scale) ? [right] : [])];
}

function seriesOptions(spec, rows) {
  return spec.series.map(({ key, label, colour, words, width = rem() / 8, dash, scale = "y" }, index) => ({
    label, dash, scale, width,
    stroke: () => palette[colour],
    // The bands fill the others.
    fill: spec.stacked && index === 0 ? () => palette[colour] : undefined,
    points: { show: () => width > 0 && rows().length < 40, size: 5 },
    value: (_, __, ___, index) => (index === null ? DASH : words(rows()[index]?.[key] ?? null)),
  }));
}

function bands(spec) {
  return (spec.bands ?? []).map((series) => {
    const { colour } = spec.series[series[0] - 1];
    return { series, fill: () => palette[colour] + (spec.stacked ? "" : "40") };
  });
}

/** Columns of a chart; of a stacked one the sums up to each series. */
function columns(spec, rows) {
  const frames = rows.map((row) => row.frame);
  if (!spec.stacked) return [frames, ...spec.series.map(({ key }) => rows.map((row) => row[key]))];
  const sums = new Float64Array(rows.length);
  const stack = spec.series.map(({ key }) => rows.map((row, index) => (sums[index] += row[key] ?? 0)));
  return [frames, ...stack];
}

/** All charts of the page. `choose(frame)` is called when the viewer clicks at a frame. */
export class Charts {
  constructor(root, choose) {
    this.root = root;
    this.choose = choose;
    this.rows = [];
    this.marked = null;
    this.plots = new Map();
    this.figures = new Map(CHARTS.map((spec) => [spec, this.figure(spec)]));
    root.append(...this.figures.values());
    readPalette();
    new ResizeObserver(() => this.resize()).observe(root);
  }

  figure(spec) {
    const figure = document.createElement("figure");
    figure.className = spec.stacked ? "chart stacked" : "chart";
    figure.hidden = true;
    const caption = document.createElement("figcaption");
    caption.append(spec.term ? termButton(spec.term, spec.title) : spec.title, spec.unit ? ` in ${spec.unit}` : "");
    figure.append(caption);
    return figure;
  }

  /** Size of the plot in a figure. */
  size(figure) {
    return { width: Math.max(200, Math.floor(figure.clientWidth)), height: Math.round(parseFloat(getComputedStyle(this.root).getPropertyValue("--height")) * rem()) };
  }

  plot(spec) {
    const showCurrent = (plot) => { if (plot.cursor.idx == null && this.rows.length > 0) plot.setLegend({ idx: this.current() }, false); };
    const options = {
      ...this.size(this.figures.get(spec)),
      cursor: { sync: { key: "frames" }, drag: { x: false, y: false }, points: { size: 7 } },
      scales: { x: { time: false }, y: yScale(spec), ...(spec.series.some((series) => series.scale) ? { time: { range: range({}) } } : {}) },
      series: [{ label: "frame", value: (_, value) => (value === null ? DASH : number(value, 9)) }, ...seriesOptions(spec, () => this.rows)],
      bands: bands(spec),
      axes: axes(spec),
      hooks: { draw: [(plot) => this.drawMark(plot)], setCursor: [showCurrent], setData: [showCurrent] },
    };
    const plot = new uPlot(options, columns(spec, this.rows), this.figures.get(spec));
    plot.over.addEventListener("click", () => { if (plot.cursor.idx != null) this.choose(this.rows[plot.cursor.idx].frame); });
    return plot;
  }

  /** Index of the row whose values the legends show while the cursor is elsewhere. */
  current() {
    const marked = this.marked === null ? -1 : this.rows.findIndex((row) => row.frame >= this.marked);
    return marked < 0 ? this.rows.length - 1 : marked;
  }

  drawMark(plot) {
    if (this.marked === null) return;
    const { ctx, bbox } = plot;
    const x = Math.round(plot.valToPos(this.marked, "x", true));
    if (x < bbox.left || x > bbox.left + bbox.width) return;
    ctx.save();
    ctx.strokeStyle = palette["--text"];
    ctx.lineWidth = 2 * devicePixelRatio;
    ctx.setLineDash([]);
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    ctx.restore();
  }

  /** Draws the rows. */
  update(rows) {
    this.rows = rows.slice();
    const shown = CHARTS.filter(({ needs }) => this.rows.length > 0 && (needs === undefined || this.rows.some((row) => row[needs] !== null)));
    const changed = CHARTS.filter((spec) => this.figures.get(spec).hidden === shown.includes(spec));
    for (const spec of changed) this.figures.get(spec).hidden = !shown.includes(spec);
    for (const spec of shown) this.updateOne(spec);
    // Others may have more or less room now.
    if (changed.length > 0) this.resize();
  }

  updateOne(spec) {
    if (!this.plots.has(spec)) this.plots.set(spec, this.plot(spec));
    else this.plots.get(spec).setData(columns(spec, this.rows));
  }

  /** Marks the frame that is shown while looking back; null for none. */
  mark(frame) {
    if (frame === this.marked) return;
    this.marked = frame;
    for (const plot of this.plots.values()) {
      plot.setLegend({ idx: this.current() }, false);
      plot.redraw(false);
    }
  }

  resize() {
    for (const [spec, plot] of this.plots) if (!this.figures.get(spec).hidden) plot.setSize(this.size(this.figures.get(spec)));
  }

  /** Takes over the colours of another theme. */
  restyle() {
    readPalette();
    for (const plot of this.plots.values()) plot.redraw(false);
  }
}
