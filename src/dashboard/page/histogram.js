// How often the newest frame shows each FTLE, with the ramp of the colours over it, whose ends are dragged.
import { showTicks } from "./colour_bar.js";
import { count, number, withUnit } from "./words.js";

const SPACING = 1000;
// After this time a range that no frame shows is no longer waited for.
const LOST = 15_000;
// Of the axis: room at its ends, steps of the keys, and the smallest distance of the ends.
const [ROOM, STEP, GAP] = [0.08, 0.01, 0.004];

/** Axis that has the values and the range, with some room. */
export function axisOf(values, { low, high }) {
  const [from, to] = [Math.min(low, values?.[0] ?? low), Math.max(high, values?.[1] ?? high)];
  const room = ROOM * (to - from);
  return { low: from - room, high: to + room };
}

/** The range with one end at another value, which stays on the axis and apart from the other end; in steps that are seen. */
export function moved(range, end, value, axis) {
  const span = axis.high - axis.low;
  const unit = 10 ** (Math.floor(Math.log10(span)) - 3);
  const [from, to] = end === "low" ? [axis.low, range.high - GAP * span] : [range.low + GAP * span, axis.high];
  const round = (x) => Number((Math.round(x / unit) * unit).toPrecision(12));
  return { ...range, [end]: round(Math.min(Math.max(value, from), to)) };
}

const KEYS = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10 };

export class Histogram {
  /** `ask()` returns a promise of the counts, or throws an error with words; `change(range)` is called with a range that was chosen. */
  constructor({ root, ask, change }) {
    Object.assign(this, { root, ask, change });
    this.plot = root.querySelector("#histogram-plot");
    this.canvas = root.querySelector("canvas");
    this.handles = { low: root.querySelector("#handle-low"), high: root.querySelector("#handle-high") };
    this.kept = null;
    this.counted = null;
    this.transfer = null;
    this.colours = null;
    // Range that was chosen and that no frame shows yet, and when.
    this.wanted = null;
    this.at = 0;
    this.dragged = null;
    this.axis = null;
    this.busy = false;
    for (const [end, handle] of Object.entries(this.handles)) this.listen(end, handle);
    new ResizeObserver(() => this.draw()).observe(this.plot);
  }

  listen(end, handle) {
    handle.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      event.preventDefault();
      handle.focus();
      handle.setPointerCapture(event.pointerId);
      this.dragged = end;
    });
    handle.addEventListener("pointermove", (event) => {
      if (this.dragged !== end) return;
      const box = this.plot.getBoundingClientRect();
      this.move(end, this.axis.low + ((event.clientX - box.left) / box.width) * (this.axis.high - this.axis.low));
    });
    for (const type of ["pointerup", "pointercancel"]) handle.addEventListener(type, () => { this.dragged = null; });
    handle.addEventListener("keydown", (event) => {
      const steps = KEYS[event.key];
      if (steps === undefined || event.ctrlKey || event.altKey || event.metaKey || this.axis === null) return;
      event.preventDefault();
      // These keys turn over pictures elsewhere.
      event.stopPropagation();
      this.move(end, this.range[end] + steps * (event.shiftKey ? 10 : 1) * STEP * (this.axis.high - this.axis.low));
    });
  }

  receiveState({ values }) { this.kept = values ?? null; }

  get range() { return this.wanted ?? this.transfer; }

  move(end, value) {
    // The newest record may have no colours.
    if (this.range === null || this.axis === null) return;
    const range = moved(this.range, end, value, this.axis);
    if (range[end] !== this.range[end]) this.choose(range);
  }

  /** Asks for a range, which is shown until its frame comes. */
  choose(range) {
    [this.wanted, this.at] = [range, performance.now()];
    this.change(range);
    this.draw();
  }

  /** Goes back to the range of the newest frame. */
  forget() { this.wanted = null; }

  /** Takes in the newest record and colours, and asks for the counts of a newer frame. */
  refresh(record, colours) {
    const { low, high } = record?.transfer ?? {};
    this.transfer = high > low ? { low, high } : null;
    this.colours = colours ?? null;
    const isShown = this.wanted && this.transfer && ["low", "high"].every((end) => Math.abs(this.wanted[end] - this.transfer[end]) <= 1e-9 * Math.abs(this.transfer[end]));
    if (this.dragged === null && (isShown || performance.now() - this.at > LOST)) this.wanted = null;
    this.draw();
    if (this.kept?.ready !== undefined && !this.busy && record && record.frame !== this.counted?.frame) this.count();
  }

  async count() {
    this.busy = true;
    try {
      this.counted = await this.ask();
      this.problem = null;
    } catch (error) {
      this.problem = error.message;
    }
    setTimeout(() => { this.busy = false; }, SPACING);
    this.draw();
  }

  /** What is said below. */
  get words() {
    if (this.kept?.none !== undefined) return `No histogram here: ${this.kept.none}.`;
    if (this.counted === null) return this.problem ? `No histogram: ${this.problem}` : "";
    const { frame, range } = this.counted;
    return range === null ? `Frame ${count(frame)} shows nothing: its FTLE is below the range of colours.` : `FTLE that frame ${count(frame)} shows, by pixels, and the ramp of its colours. What is below the ramp is not seen.`;
  }

  draw() {
    const { words } = this;
    const text = this.root.querySelector("#histogram-text");
    if (text.textContent !== words) text.textContent = words;
    const hidden = this.range === null || this.counted === null;
    this.plot.hidden = hidden;
    this.root.querySelector(".ticks").hidden = hidden;
    if (hidden) return;
    if (this.dragged === null) this.axis = axisOf(this.counted.range, this.range);
    const drawn = JSON.stringify([this.axis, this.range, this.counted.frame, this.canvas.clientWidth, this.colours, getComputedStyle(this.canvas).color]);
    if (drawn === this.drawn) return;
    this.drawn = drawn;
    const { low, high } = this.axis;
    const share = (value) => (value - low) / (high - low);
    for (const [end, handle] of Object.entries(this.handles)) {
      handle.style.left = `${100 * share(this.range[end])}%`;
      const limits = { low: [low, this.range.high], high: [this.range.low, high] }[end];
      Object.assign(handle, { ariaValueMin: String(limits[0]), ariaValueMax: String(limits[1]), ariaValueNow: String(this.range[end]) });
      handle.ariaValueText = `FTLE ${withUnit(this.range[end], this.counted.unit)}`;
    }
    showTicks(this.root.querySelector(".ticks"), this.axis);
    this.paint(share);
  }

  paint(share) {
    const { canvas, range } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((length) => Math.max(1, Math.round(length * devicePixelRatio)));
    Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d");
    const style = getComputedStyle(canvas);
    const colour = (value) => {
      const at = Math.min(Math.max((value - range.low) / (range.high - range.low), 0), 1);
      const rgb = this.colours?.[Math.round(at * (this.colours.length - 1))];
      return value < range.low || !rgb ? style.getPropertyValue("--muted") : `rgb(${rgb.join(" ")})`;
    };
    const { counts, range: counted } = this.counted;
    const most = Math.max(...counts, 1);
    context.lineWidth = devicePixelRatio;
    context.strokeStyle = style.getPropertyValue("--border");
    // A frame that shows nothing has no range.
    if (counted !== null) counts.forEach((pixels, k) => {
      const [from, to] = [k, k + 1].map((edge) => counted[0] + (edge / counts.length) * (counted[1] - counted[0]));
      const bar = [share(from) * width, height, (share(to) - share(from)) * width, (-pixels / most) * 0.92 * height];
      context.fillStyle = colour((from + to) / 2);
      context.fillRect(...bar);
      if (pixels > 0) context.strokeRect(...bar);
    });
    context.lineWidth = 2 * devicePixelRatio;
    context.strokeStyle = style.getPropertyValue("--accent");
    context.beginPath();
    for (const [x, y] of [[0, 0], [share(range.low), 0], [share(range.high), 1], [1, 1]]) context.lineTo(x * width, height - 1 - y * (height - 2));
    context.stroke();
    canvas.setAttribute("aria-label", `Histogram of the FTLE of frame ${count(this.counted.frame)}; colours from ${number(range.low)} to ${number(range.high)}`);
  }
}
