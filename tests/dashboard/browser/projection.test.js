// The plane of a map, by numbers of Rust (tests/map/projections.rs).
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { axesOf } from "../../../src/dashboard/page/graticule.js";
import { isKnown, toDegrees, toScene } from "../../../src/dashboard/page/projection.js";

const cases = JSON.parse(readFileSync(new URL("projections.json", import.meta.url)));

test("places of the scene are those of Rust, there and back", () => {
  assert.deepEqual(new Set(cases.map(({ projection }) => projection.kind)), new Set(["plate_carree", "mercator", "lambert", "polar"]));
  for (const { projection, places, scene } of cases) {
    assert.ok(isKnown(projection) && places.length > 8);
    places.forEach((place, index) => {
      const found = toScene(projection, place);
      const back = toDegrees(projection, scene[index]);
      const near = (a, b, room) => a.every((value, k) => Math.abs(value - b[k]) < room);
      assert.ok(near(found, scene[index], 1e-10), `${projection.kind}: ${found}, not ${scene[index]}`);
      const turned = [back[0] + 360 * Math.round((place[0] - back[0]) / 360), back[1]];
      assert.ok(near(turned, place, 1e-8), `${projection.kind}: ${back}, not ${place}`);
    });
  }
});

/** A map of the northern cap that fills a square picture: the pole is its middle, and the parallel of 60 degrees its rim. */
const cap = (() => {
  const projection = cases.find(({ projection: { kind, pole } }) => kind === "polar" && pole > 0).projection;
  const rim = projection.unit * 2 * Math.tan(Math.PI / 12);
  const [x, y] = projection.origin;
  const camera = { eye: [x, y, 1 + rim], look_at: [x, y, 1], up: [0, 1, 0], field_of_view: 90, orthographic: true };
  const domain = { min: [0, 60, 0], max: [360, 90, 1], axes: [["lon", "degrees_east"], ["lat", "degrees_north"]] };
  return { size: [200, 200], scale: [0.02, 0.02, 0.25], camera, domain, projection };
})();
const radius = ([x, y]) => 2 * Math.hypot(x - 0.5, y - 0.5);

test("parallels of a polar map are circles about the pole, and meridians lead to it", () => {
  const lines = axesOf(cap);
  const named = (words) => lines.filter((line) => line.labels.some(({ text }) => text === words));
  const [parallel] = named("75°N");
  const wanted = Math.tan((7.5 * Math.PI) / 180) / Math.tan(Math.PI / 12);
  assert.ok(parallel.points.length > 60 && parallel.points.every((point) => Math.abs(radius(point) - wanted) < 1e-3), String(parallel.points.map(radius)));
  // The plane's middle longitude, 180 degrees, points down, and 90 degrees east to the left of it.
  for (const [words, [x, y]] of [["180°", [0.5, 1]], ["0°", [0.5, 0]], ["120°E", [0.5 - Math.sin(Math.PI / 3) / 2, 0.75]]]) {
    const [{ labels: [{ place }] }] = named(words);
    assert.ok(Math.hypot(place[0] - x, place[1] - y) < 1e-3, `${words}: ${place}`);
  }
  assert.equal(named("0°").length, 1, "where the circle closes there is one line");
});

test("a near view of a projected map has finer lines of what it shows only", () => {
  const { projection } = cap;
  // About 75 degrees north at 180 degrees, below the pole.
  const [x, y] = toScene(projection, [180, 75]);
  const near = { ...cap, camera: { ...cap.camera, eye: [x, y, 1 + 0.01 * projection.unit], look_at: [x, y, 1] } };
  const texts = axesOf(near).flatMap(({ labels }) => labels.map(({ text }) => text));
  assert.ok(texts.includes("180°") && texts.includes("75°N") && texts.includes("179°E") && !texts.includes("90°E"), String(texts));
  const meridian = axesOf(near).find(({ labels }) => labels.some(({ text }) => text === "180°"));
  assert.ok(meridian.points.every(([across]) => Math.abs(across - 0.5) < 1e-6));
});

test("lines of plate carree and Mercator are straight, and a projection of a newer version has none", () => {
  for (const { projection } of cases.filter(({ projection: { kind } }) => ["plate_carree", "mercator"].includes(kind))) {
    const [min, max] = projection.kind === "mercator" ? [[-60, -40], [40, 60]] : [[14.875, -40.125], [34.875, -30.125]];
    const [low, high] = [min, max].map((place) => toScene(projection, place));
    const middle = low.map((value, k) => (value + high[k]) / 2);
    const half = Math.max(high[0] - low[0], high[1] - low[1]) / 2;
    const camera = { eye: [...middle, 1 + half], look_at: [...middle, 1], up: [0, 1, 0], field_of_view: 90, orthographic: true };
    const record = { ...cap, projection, camera, domain: { ...cap.domain, min: [...min, 0], max: [...max, 1] } };
    const lines = axesOf(record);
    assert.ok(lines.length > 6, String(lines.length));
    for (const { points } of lines) assert.ok([0, 1].some((k) => points.every((point) => Math.abs(point[k] - points[0][k]) < 1e-9)), String(points[0]));
    assert.deepEqual(axesOf({ ...record, projection: { ...projection, kind: "sinusoidal" } }), []);
  }
});
