// Cameras as in a scene file: turned, moved and zoomed.

export const add = (a, b, by = 1) => a.map((value, k) => value + by * b[k]);
export const subtract = (a, b) => add(a, b, -1);
export const dot = (a, b) => a.reduce((sum, value, k) => sum + value * b[k], 0);
const scale = (a, by) => a.map((value) => value * by);
export const unit = (a) => scale(a, 1 / Math.hypot(...a));
export const cross = (a, b) => [0, 1, 2].map((k) => a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3]);
const radians = (degrees) => (degrees * Math.PI) / 180;

// Angle to `up` that is kept, since a camera must not look along it.
const POLE = radians(3);
const WIDEST = 170;
const NARROWEST = 0.01;

/** Turns a vector about a unit axis (Rodrigues). */
function turned(vector, axis, angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return add(add(scale(vector, c), cross(axis, vector), s), axis, dot(axis, vector) * (1 - c));
}

/** Unit vectors to the right and up in the picture. */
export function film({ eye, look_at: at, up }) {
  const forward = unit(subtract(at, eye));
  const right = unit(cross(forward, up));
  return { right, upward: cross(right, forward) };
}

/** Half of the film's width and height, in scene units at the point that is looked at. */
export function halves({ eye, look_at: at, field_of_view: angle, orthographic }, aspect) {
  const [distance, half] = [Math.hypot(...subtract(at, eye)), radians(angle) / 2];
  const width = distance * Math.tan(half);
  return [width, orthographic ? width / aspect : distance * Math.tan(half / aspect)];
}

/** Turns the camera about the point that it looks at: by angles to the right and upward, in radians. */
export function orbit(camera, across, upward) {
  const axis = unit(camera.up);
  const offset = turned(subtract(camera.eye, camera.look_at), axis, -across);
  const polar = Math.acos(Math.min(Math.max(dot(unit(offset), axis), -1), 1));
  const wanted = Math.min(Math.max(polar - upward, POLE), Math.PI - POLE);
  const side = unit(cross(axis, offset));
  return { ...camera, eye: add(camera.look_at, turned(offset, side, wanted - polar)) };
}

/** Moves the picture's content by shares of its width and height, to the right and up. */
export function pan(camera, across, upward, aspect) {
  const [{ right, upward: up }, [width, height]] = [film(camera), halves(camera, aspect)];
  const move = add(scale(right, -2 * width * across), up, -2 * height * upward);
  return { ...camera, eye: add(camera.eye, move), look_at: add(camera.look_at, move) };
}

/** Shows `factor` times as much. In parallel projection the point at `[x, y]` of the film (-1 to 1, from the left and the bottom) stays where it is. */
export function zoom(camera, factor, aspect, [x, y] = [0, 0]) {
  if (!camera.orthographic) return { ...camera, eye: add(camera.look_at, subtract(camera.eye, camera.look_at), factor) };
  const half = Math.atan(Math.tan(radians(camera.field_of_view) / 2) * factor);
  const next = { ...camera, field_of_view: Math.min(Math.max((2 * half * 180) / Math.PI, NARROWEST), WIDEST) };
  const grown = halves(next, aspect)[0] / halves(camera, aspect)[0];
  return pan(next, (x * (grown - 1)) / (2 * grown), (y * (grown - 1)) / (2 * grown), aspect);
}
