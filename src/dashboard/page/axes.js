// The layer of the axes over the picture.
import { axesOf } from "./graticule.js";
import { pictureBox } from "./picture.js";
import { recall, remember } from "./preferences.js";

const SVG = "http://www.w3.org/2000/svg";
// Between a label and its line, another label, and the edge of the picture.
const GAP = 4;

/** From a place on a line with these ends to the middle of its label of some size; all in pixels. */
function offset({ side, of }, [a, b], [width, height]) {
  if (side === "below") return [0, -GAP - height / 2];
  if (side === "left") return [GAP + width / 2, -height / 2];
  const length = Math.hypot(b[0] - a[0], b[1] - a[1]) || 1;
  const across = [(b[1] - a[1]) / length, (a[0] - b[0]) / length];
  const away = Math.sign(across[0] * (a[0] - of[0]) + across[1] * (a[1] - of[1])) || 1;
  return across.map((value) => value * away * (GAP + (Math.abs(across[0]) * width + Math.abs(across[1]) * height) / 2));
}

const inside = (middle, size, low, high) => Math.max(Math.min(middle, high - GAP / 2 - size / 2), low + GAP / 2 + size / 2);

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
    const drawn = JSON.stringify([record?.camera, record?.scale, record?.projection, record?.domain, record?.size]);
    if (drawn === this.drawn) return;
    this.drawn = drawn;
    this.record = record ?? null;
    this.draw();
  }

  draw() {
    const lines = this.on && this.record ? axesOf(this.record) : [];
    const stage = this.root.getBoundingClientRect();
    const { left, top, width, height } = pictureBox(this.canvas);
    const corner = [left - stage.left, top - stage.top];
    const at = ([x, y]) => [corner[0] + x * width, corner[1] + y * height];
    const node = (name, attributes, text = "") => {
      const made = document.createElementNS(SVG, name);
      for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
      made.textContent = text;
      return made;
    };
    this.root.replaceChildren(...lines.flatMap(({ ends, points, hidden }) => ["halo", "line"].map((kind) => {
      if (points) return node("polyline", { points: points.map((place) => at(place).map((value) => value.toFixed(1)).join()).join(" "), class: kind });
      const [x1, y1, x2, y2] = ends.flatMap(at).map((value) => value.toFixed(1));
      return node("line", { x1, y1, x2, y2, class: hidden ? `${kind} hidden-edge` : kind });
    })));
    // Their sizes are known once they are there. Of labels without room the first stays.
    const taken = [];
    for (const { ends, labels } of lines) {
      for (const { text, place, side, of } of labels) {
        const label = this.root.appendChild(node("text", {}, text));
        const box = label.getBBox();
        const size = [box.width, box.height];
        const moved = offset({ side, of: of && at(of) }, ends.map(at), size);
        const middle = at(place).map((value, k) => inside(value + moved[k], size[k], corner[k], corner[k] + [width, height][k]));
        if (taken.some((other) => size.every((value, k) => Math.abs(other.middle[k] - middle[k]) < (other.size[k] + value + [GAP, 0][k]) / 2))) {
          label.remove();
          continue;
        }
        taken.push({ middle, size });
        const [x, y] = middle.map((value, k) => (value - size[k] / 2 - [box.x, box.y][k]).toFixed(1));
        label.setAttribute("transform", `translate(${x} ${y})`);
      }
    }
  }
}
