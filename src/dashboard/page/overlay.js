// A layer of the newest frame over its picture, with its scale.
import { paint, showTicks } from "./colour_bar.js";
import { paintPlane, parsePlane, spread, viridis } from "./plane.js";
import { LATER } from "./values.js";
import { count, number } from "./words.js";

// Between two planes, so that they leave room for pictures.
const SPACING = 100;
const COLOURS = Array.from({ length: 64 }, (_, k) => viridis(k / 63));

// What each layer is called, and its range of colours; `zero` tells whether 0 is drawn.
const LAYERS = {
  error: { title: "Stated error of the linear colours", range: (plane) => [0, spread(plane, 0, 0.995)?.[1]], zero: true },
  traced: { title: "Share of the queries that were traced", range: () => [0, 1], zero: true },
  trusted: { title: "Share of the way in which the surrogate is trusted", range: () => [0, 1], zero: true },
  missing: { title: "Share of the rays that met missing data", range: () => [0, 1], zero: false },
  ftle: { title: "Mean FTLE of what is seen", range: (plane) => spread(plane, 0.005, 0.995), zero: true },
};

/** Limits of colours with some room between them. */
function limits(range) {
  const [low, high] = range ?? [0, 1];
  return high > low ? [low, high] : [low, low + (Math.abs(low) || 1)];
}

export class Overlay {
  /** `ask(query)` returns a promise of a buffer, or throws an error with words. `root` has the scale. */
  constructor({ ask, canvas, root }) {
    Object.assign(this, { ask, canvas, root });
    this.kept = null;
    this.of = "none";
    this.frame = null;
    this.gone = false;
    this.newest = null;
    this.busy = false;
    this.due = false;
    this.pause = null;
  }

  receiveState({ values }) {
    this.kept = values ?? null;
    this.tell();
  }

  /** Shows this layer from now on; `none` for none. */
  choose(of) {
    this.of = of;
    this.clear();
    // Another layer is not waited for.
    if (this.pause !== null) this.go();
    this.changed();
  }

  /** Ends the pause after a plane. */
  go() {
    clearTimeout(this.pause);
    [this.pause, this.busy] = [null, false];
  }

  /** The layer after this one, of those that a select has. */
  cycle(select) {
    select.selectedIndex = (select.selectedIndex + 1) % select.options.length;
    this.choose(select.value);
  }

  /** Another picture is shown: of the frame that is looked back at, `held` (null: the newest is followed). `newest` is the number of the newest. */
  look(held, newest) {
    this.frame = held;
    this.newest = newest;
    this.gone = held !== null && newest !== null && held !== newest;
    this.changed();
  }

  changed() {
    this.due = this.tell();
    this.next();
  }

  /** Says why nothing is drawn. Returns whether something may be. */
  tell() {
    if (this.of === "none" || this.kept === null) { this.clear(""); return false; }
    if (this.kept.ready === undefined) this.clear(`No overlay here: ${this.kept.none}.`);
    else if (this.gone) this.clear("Overlays are of the newest frame: go back to live.");
    else return true;
    return false;
  }

  clear(text = "") {
    this.canvas.hidden = true;
    this.say(text);
    this.root.querySelector("#overlay-scale").hidden = true;
  }

  say(text) {
    const node = this.root.querySelector("#overlay-text");
    if (node.textContent !== text) node.textContent = text;
  }

  async next() {
    if (this.busy || !this.due || !this.tell()) return;
    [this.busy, this.due] = [true, false];
    const { of, frame } = this;
    let plane;
    let problem;
    try {
      plane = parsePlane(await this.ask({ of, frame }));
    } catch (error) {
      problem = error.message;
    }
    // Another layer may have been chosen meanwhile, or another picture be looked at.
    if (this.of === of && this.frame === frame && this.tell()) {
      if (plane && !plane.none) this.draw(plane);
      else this.clear(`No overlay: ${problem ?? plane.none}`);
    }
    // A server apart from the run gets its layers about once a second.
    const isLate = frame === null && plane?.frame < this.newest;
    this.due ||= isLate;
    this.pause = setTimeout(() => { this.go(); this.next(); }, isLate ? LATER : SPACING);
  }

  draw(plane) {
    const { title: usual, range, zero } = LAYERS[plane.plane];
    const title = plane.plane === "error" && plane.method === "map" ? "Stated error of the FTLE" : usual;
    const [low, high] = limits(range(plane));
    const { step, columns, rows, size, unit } = plane;
    const image = paintPlane(plane, [low, high], zero);
    const whole = Object.assign(document.createElement("canvas"), { width: columns, height: rows });
    whole.getContext("2d").putImageData(image, 0, 0);
    Object.assign(this.canvas, { width: size[0], height: size[1], hidden: false });
    const context = this.canvas.getContext("2d");
    context.imageSmoothingEnabled = false;
    context.drawImage(whole, 0, 0, step * columns, step * rows);
    const words = `${title}${unit ? ` (${unit})` : ""}, frame ${count(plane.frame)}`;
    const empty = image.data.every((value) => value === 0);
    const nothing = plane.plane === "missing" ? ": no data are missing" : ": no pixel has a value";
    this.say(`${words}${empty ? nothing : ""}${step > 1 ? `, one pixel of ${step} × ${step}` : ""}`);
    this.canvas.setAttribute("aria-label", `${words}, from ${number(low)} to ${number(high)}`);
    const scale = this.root.querySelector("#overlay-scale");
    scale.hidden = false;
    paint(scale.querySelector("canvas"), COLOURS);
    scale.querySelector("canvas").setAttribute("aria-label", `Colours from ${number(low)} to ${number(high)}`);
    showTicks(scale.querySelector(".ticks"), { low, high });
  }
}
