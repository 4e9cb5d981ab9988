// Commands to the run: one on its way at a time, of those that wait the newest value of each key.
import { orbit, pan, zoom } from "./camera.js";
import { pictureBox } from "./picture.js";

// Between two commands, so that a drag does not crowd out those of others.
const SPACING = 60;
const LOST = 15_000;
const TURN = Math.PI;
const WHEEL = 0.0015;
const STEP = 0.08;

export class Steering {
  /** `say(message)` sends, and returns whether it did; `told(text)` is called with what the viewer should know; `acted()` when the viewer steers; `refused(set)` when the run refuses a command. */
  constructor({ say, told, acted, refused }) {
    Object.assign(this, { say, told, acted, refused });
    this.state = null;
    this.mayCommand = false;
    this.record = null;
    this.number = 0;
    this.reset();
  }

  /** Forgets what is on its way: with a new connection no answer comes. */
  reset() {
    this.flying = null;
    this.waiting = {};
    this.wanted = null;
    // Number of the command with the wanted camera, once it is known; and of the newest one that was seen in a record.
    this.shownBy = null;
    this.seen = 0;
  }

  /** As `reset`, and says what got no answer. */
  abandon() {
    const { flying, waiting } = this;
    const keys = Object.keys({ ...(flying?.answered ? {} : flying?.set), ...waiting });
    if (keys.length > 0) this.told(`No answer came: ${keys.join(", ")} may be lost`, null, true);
    this.reset();
  }

  /** Takes in the server's state. */
  receiveState({ steering, token_to_share: token }) {
    this.state = steering ?? null;
    this.mayCommand = token !== undefined;
    if (this.flying && performance.now() - this.flying.at > LOST) this.abandon();
  }

  /** Takes in new records, in order. */
  receiveRecords(records) {
    for (const record of records) {
      if (record.frame < this.record?.frame) this.abandon();
      this.record = record;
      const commands = Array.isArray(record.commands) ? record.commands : [];
      for (const { number, set } of commands) {
        this.told(`Command ${number} is in effect: ${Object.keys(set ?? {}).join(", ")}`, record.frame);
        if (set?.camera) this.seen = number;
      }
    }
    this.settle();
  }

  /** Until its frame comes, the next move goes on from the camera that was asked for. */
  settle() {
    if (this.shownBy !== null && this.seen >= this.shownBy) this.wanted = this.shownBy = null;
  }

  get ready() { return this.state?.ready ?? null; }
  get can() { return this.ready !== null && this.mayCommand; }
  get paused() { return this.ready?.paused === true; }
  get flat() { return this.ready?.dimensions === 2; }

  /** Why nothing can be commanded here; null if it can. */
  get obstacle() {
    if (this.state === null) return "";
    if (this.ready === null) return `The run is not steered: ${this.state.none}.`;
    return this.mayCommand ? null : "This address only watches the run.";
  }

  command(set) {
    if (!this.can) return;
    this.acted();
    Object.assign(this.waiting, set);
    this.send();
  }

  send() {
    if (this.flying || Object.keys(this.waiting).length === 0) return;
    this.number += 1;
    this.flying = { number: this.number, set: this.waiting, at: performance.now() };
    this.waiting = {};
    if (this.say({ command: this.number, set: this.flying.set })) return;
    this.told("Not sent: no connection", null, true);
    this.reset();
  }

  receiveAnswer({ command, accepted, refused }) {
    if (this.flying?.number !== command || this.flying.answered) return;
    const { set, at } = this.flying;
    this.flying.answered = true;
    if (accepted) {
      this.state = { ready: accepted };
      if (set.camera !== undefined && this.waiting.camera === undefined) this.shownBy = accepted.commands;
      this.settle();
    } else {
      this.told(`Refused: ${refused}`, null, true);
      this.refused(set);
      if (set.camera !== undefined) this.wanted = this.shownBy = null;
    }
    const next = () => {
      // After a reset a later command may be on its way.
      if (this.flying?.number !== command) return;
      this.flying = null;
      this.send();
    };
    setTimeout(next, Math.max(0, SPACING - (performance.now() - at)));
  }

  get camera() { return this.wanted ?? this.record?.camera ?? null; }
  get aspect() { return this.record?.size ? this.record.size[0] / this.record.size[1] : 1; }

  look(camera) {
    if (!this.can) return;
    this.wanted = camera;
    this.shownBy = null;
    this.command({ camera });
  }

  /** By shares of the picture's width and height, to the right and up. Maps are not turned. */
  turn(across, upward) {
    if (this.camera === null) return;
    this.look(this.flat ? pan(this.camera, across, upward, this.aspect) : orbit(this.camera, TURN * across, -TURN * upward));
  }

  move(across, upward) {
    if (this.camera !== null) this.look(pan(this.camera, across, upward, this.aspect));
  }

  zoom(factor, at) {
    if (this.camera !== null) this.look(zoom(this.camera, factor, this.aspect, at));
  }

  home() {
    this.wanted = null;
    this.command({ camera: null });
  }

  togglePause() { this.command({ paused: !this.paused }); }
}

/** Keys that steer. */
export const steeringKeys = (steering) => ({
  a: () => steering.turn(-STEP, 0),
  d: () => steering.turn(STEP, 0),
  w: () => steering.turn(0, STEP),
  s: () => steering.turn(0, -STEP),
  A: () => steering.move(-STEP, 0),
  D: () => steering.move(STEP, 0),
  W: () => steering.move(0, STEP),
  S: () => steering.move(0, -STEP),
  "+": () => steering.zoom(0.8),
  "-": () => steering.zoom(1.25),
  0: () => steering.home(),
  p: () => steering.togglePause(),
});

/** Middle and distance of the first two of some points. */
function spanned(points) {
  const [a, b = a] = points.values();
  return { clientX: (a.x + b.x) / 2, clientY: (a.y + b.y) / 2, distance: Math.max(Math.hypot(a.x - b.x, a.y - b.y), 1) };
}

/** Lets the pointer steer on the picture. */
export function steerBy(canvas, steering) {
  const shown = () => pictureBox(canvas);
  /** A place of the window on the film: -1 to 1, from the left and the bottom. */
  const onFilm = ({ clientX, clientY }) => {
    const { width, height, left, top } = shown();
    return [(2 * (clientX - left)) / width - 1, 1 - (2 * (clientY - top)) / height];
  };
  // Pointers that are down: two are fingers, which zoom and move.
  const down = new Map();
  let last = null;
  canvas.addEventListener("pointerdown", (event) => {
    if (!steering.can || event.button > 2) return;
    event.preventDefault();
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, { x: event.clientX, y: event.clientY });
    last = down.size === 1 ? { x: event.clientX, y: event.clientY, moves: event.shiftKey || event.button !== 0 } : null;
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!down.has(event.pointerId)) return;
    const before = spanned(down);
    down.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (down.size === 2) pinch(before, spanned(down));
    if (last === null) return;
    const { width, height } = shown();
    const [across, upward] = [(event.clientX - last.x) / width, (last.y - event.clientY) / height];
    [last.x, last.y] = [event.clientX, event.clientY];
    if (last.moves) steering.move(across, upward);
    else steering.turn(across, upward);
  });
  // A finger that is left of two does not turn the view.
  for (const type of ["pointerup", "pointercancel"]) canvas.addEventListener(type, (event) => { down.delete(event.pointerId); last = null; });
  const pinch = (before, after) => {
    const { width, height } = shown();
    steering.zoom(before.distance / after.distance, onFilm(before));
    steering.move((after.clientX - before.clientX) / width, (before.clientY - after.clientY) / height);
  };
  canvas.addEventListener("contextmenu", (event) => steering.can && event.preventDefault());
  canvas.addEventListener("dblclick", () => steering.home());
  const turnWheel = (event) => {
    if (!steering.can) return;
    event.preventDefault();
    // Lines and pages, which some browsers count instead of pixels.
    const pixels = event.deltaY * [1, 30, 300][event.deltaMode];
    steering.zoom(Math.exp(WHEEL * pixels), onFilm(event));
  };
  canvas.addEventListener("wheel", turnWheel, { passive: false });
}
