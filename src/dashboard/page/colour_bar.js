// The colour bar: FTLE to colour, with ticks and unit.
import { number } from "./words.js";

const TICKS = 5;

const valid = (bar) => Array.isArray(bar?.colors) && bar.colors.length > 1 && Number.isFinite(bar.low) && Number.isFinite(bar.high) && bar.high > bar.low;

/** Round values in [low, high], about `TICKS` of them. */
export function ticks(low, high) {
  const rough = (high - low) / TICKS;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
  const first = Math.ceil(low / step - 1e-9);
  const last = Math.floor(high / step + 1e-9);
  return Array.from({ length: last - first + 1 }, (_, index) => (first + index) * step);
}

/** Draws colours side by side. */
export function paint(canvas, colors) {
  canvas.width = colors.length;
  canvas.height = 1;
  const image = new ImageData(colors.length, 1);
  colors.forEach(([r, g, b], index) => image.data.set([r, g, b, 255], 4 * index));
  canvas.getContext("2d").putImageData(image, 0, 0);
}

function tickLabel(value, { low, high }) {
  const label = document.createElement("span");
  const share = (value - low) / (high - low);
  label.textContent = number(value);
  label.style.left = `${100 * share}%`;
  label.classList.toggle("first", share < 0.03);
  label.classList.toggle("last", share > 0.97);
  return label;
}

/** Labels round values of a range. */
export const showTicks = (node, range) => node.replaceChildren(...ticks(range.low, range.high).map((value) => tickLabel(value, range)));

function fallback(transfer) {
  if (!transfer) return "The frames carry no colour scale.";
  return `The frames carry no colour scale. Colours begin at FTLE ${number(transfer.low)} and are full from ${number(transfer.high)} (1/time).`;
}

export class ColourBar {
  constructor(root) {
    this.root = root;
    this.shown = null;
  }

  /** Shows the scale of a frame, or says that there is none. */
  show({ color_bar: bar, record }) {
    const drawn = JSON.stringify([bar ?? null, record?.transfer ?? null]);
    if (drawn === this.shown) return;
    this.shown = drawn;
    const [scale, note] = ["#scale", "#scale-note"].map((name) => this.root.querySelector(name));
    scale.hidden = !valid(bar);
    note.hidden = valid(bar);
    if (!valid(bar)) { note.textContent = fallback(record?.transfer); return; }
    const unit = bar.unit || "1/time";
    paint(scale.querySelector("canvas"), bar.colors);
    scale.querySelector("canvas").setAttribute("aria-label", `Colours of FTLE from ${number(bar.low)} to ${number(bar.high)} ${unit}`);
    scale.querySelector("#scale-unit").textContent = `(${unit})`;
    showTicks(scale.querySelector("#scale-ticks"), bar);
  }
}
