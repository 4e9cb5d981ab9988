// The layer of the axes over the picture.
import { axesOf } from "./graticule.js";
import { pictureBox } from "./picture.js";
import { recall, remember } from "./preferences.js";

const SVG = "http://www.w3.org/2000/svg";

export class Axes {
  constructor({ root, canvas, toggle }) {
    Object.assign(this, { root, canvas, control: toggle });
    this.record = null;
    this.on = recall("axes") !== "off";
    toggle.checked = this.on;
    toggle.addEventListener("change", () => this.set(toggle.checked));
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  toggle() { this.set(!this.on); }

  set(on) {
    this.on = on;
    this.control.checked = on;
    remember("axes", on ? "on" : "off");
    this.draw();
  }

  /** Shows the axes of this record's picture. */
  show(record) {
    const drawn = JSON.stringify([record?.camera, record?.scale, record?.domain, record?.size]);
    if (drawn === this.drawn) return;
    this.drawn = drawn;
    this.record = record ?? null;
    this.draw();
  }

  draw() {
    const lines = this.on && this.record ? axesOf(this.record) : [];
    const stage = this.root.getBoundingClientRect();
    const { left, top, width, height } = pictureBox(this.canvas);
    const at = ([x, y]) => [left - stage.left + x * width, top - stage.top + y * height].map((value) => value.toFixed(1));
    const node = (name, attributes, text = "") => {
      const made = document.createElementNS(SVG, name);
      for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
      made.textContent = text;
      return made;
    };
    const nodes = lines.flatMap(({ ends: [a, b], hidden }) => ["halo", "line"].map((kind) => {
      const [[x1, y1], [x2, y2]] = [at(a), at(b)];
      return node("line", { x1, y1, x2, y2, class: hidden ? `${kind} hidden-edge` : kind });
    }));
    for (const { text, place, side } of lines.flatMap(({ labels }) => labels)) {
      const [x, y] = at(place).map(Number);
      const offset = side === "left" ? { x: x + 4, y: y - 4, "text-anchor": "start" } : { x, y: y - 5, "text-anchor": place[0] < 0.04 ? "start" : place[0] > 0.96 ? "end" : "middle" };
      nodes.push(node("text", offset, text));
    }
    this.root.replaceChildren(...nodes);
  }
}
