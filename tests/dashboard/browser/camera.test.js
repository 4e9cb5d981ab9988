// Cameras that are turned, moved and zoomed, against closed forms.
import assert from "node:assert/strict";
import { test } from "node:test";
import { orbit, pan, zoom } from "../../../src/dashboard/page/camera.js";

const camera = { eye: [0, -2, 0], look_at: [0, 0, 0], up: [0, 0, 1], field_of_view: 90, orthographic: false };
const map = { eye: [1, 0.5, 3], look_at: [1, 0.5, 0], up: [0, 1, 0], field_of_view: 90, orthographic: true };
// f64 rounding of a few operations.
const near = (found, expected) => expected.forEach((value, k) => assert.ok(Math.abs(found[k] - value) < 1e-12, `${found} is not ${expected}`));

test("turning keeps the distance, and stops before the pole", () => {
  near(orbit(camera, Math.PI / 2, 0).eye, [-2, 0, 0]);
  near(orbit(camera, 0, Math.PI / 4).eye, [0, -Math.SQRT2, Math.SQRT2]);
  for (const upward of [9, -9]) {
    const { eye } = orbit(camera, 0.3, upward);
    assert.ok(Math.abs(Math.hypot(...eye) - 2) < 1e-12 && Math.abs(eye[2]) < 2 * Math.cos((2.9 * Math.PI) / 180));
    assert.equal(Math.sign(eye[2]), Math.sign(upward));
  }
  assert.deepEqual(orbit(camera, 0.1, 0.1).look_at, camera.look_at);
});

test("moving by the whole width moves by two half-widths, and by the height likewise", () => {
  near(pan(camera, 1, 0, 2).look_at, [-4, 0, 0]);
  // Of the published camera: the angle is divided by width over height.
  near(pan(camera, 0, 1, 2).look_at, [0, 0, -4 * Math.tan(Math.PI / 8)]);
  near(pan(map, 0.5, 0.5, 2).eye, [1 - 3, 0.5 - 1.5, 3]);
});

test("zooming goes nearer, or on a map keeps the point under the pointer", () => {
  near(zoom(camera, 0.5, 2).eye, [0, -1, 0]);
  const half = ({ field_of_view: angle }) => 3 * Math.tan((angle * Math.PI) / 360);
  for (const factor of [0.25, 2]) {
    const next = zoom(map, factor, 2, [0.5, -1]);
    assert.ok(Math.abs(half(next) - 3 * factor) < 1e-9);
    // The point at x = 0.5 and y = -1 of the film.
    near([next.look_at[0] + 0.5 * half(next), next.look_at[1] - half(next) / 2], [1 + 1.5, 0.5 - 1.5]);
  }
  assert.equal(zoom(map, 1e9, 2).field_of_view, 170);
});
