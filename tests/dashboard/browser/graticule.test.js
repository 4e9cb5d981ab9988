// Where lines and labels of the axes lie.
import assert from "node:assert/strict";
import { test } from "node:test";
import { axesOf, placeWords } from "../../../src/dashboard/page/graticule.js";

const map = (camera = {}) => ({
  size: [320, 160], scale: [1, 1, 1],
  camera: { eye: [1, 0.5, 1.2], look_at: [1, 0.5, 0.2], up: [0, 1, 0], field_of_view: 90, orthographic: true, ...camera },
  domain: { min: [0, 0, 0], max: [2, 1, 0.2], axes: [["x", ""], ["y", ""]] },
});
const labels = (lines) => lines.flatMap((line) => line.labels);
const find = (lines, words) => lines.find((line) => line.labels.some(({ text }) => text === words));
const near = (found, wanted) => assert.ok(found.every((value, k) => Math.abs(value - wanted[k]) < 1e-5), `${found}, not ${wanted}`);

test("a line of a map lies where its value does", () => {
  const lines = axesOf(map());
  // The domain of two by one fills the picture.
  const middle = find(lines, "1").ends;
  near(middle.map(([x]) => x), [0.5, 0.5]);
  near(middle.map(([, y]) => y).sort(), [0, 1]);
  near(find(lines, "0.6").ends.map(([, y]) => y), [0.4, 0.4]);
  assert.deepEqual(labels(lines).filter(({ text }) => text.includes("=")).map(({ text }) => text), ["x = 0", "y = 1"]);
  for (const { place, side } of labels(lines)) assert.ok(side === "left" ? place[0] < 1e-5 : place[1] > 1 - 1e-5, `${place} ${side}`);
});

test("a nearer view has finer lines, of what it shows only", () => {
  const lines = axesOf(map({ field_of_view: 2 * Math.atan(0.1) * (180 / Math.PI) }));
  near(find(lines, "1").ends.map(([x]) => x), [0.5, 0.5]);
  near(find(lines, "1.05").ends.map(([x]) => x), [0.75, 0.75]);
  assert.equal(find(lines, "1.2"), undefined);
  // So near that six digits would name neighbours alike.
  const texts = labels(axesOf(map({ field_of_view: 1e-5, eye: [1.234567, 0.5, 1.2], look_at: [1.234567, 0.5, 0.2] }))).map(({ text }) => text);
  assert.ok(texts.length > 6 && new Set(texts).size === texts.length && texts.includes("1.23456705"), String(texts));
});

test("perspective sees the middle of a slab from nearer than its top", () => {
  const lines = axesOf(map({ orthographic: false }));
  // 1.1 from the eye to z = 0.1, where half of the width is 1.1.
  near(find(lines, "1.5").ends.map(([x]) => x), [0.5 + 0.25 / 1.1, 0.5 + 0.25 / 1.1]);
});

test("degrees are told by their hemisphere", () => {
  const words = (unit) => (value) => placeWords(value, unit);
  assert.deepEqual([10, 350, -20.5, 0, 180, 190].map(words("degrees_east")), ["10°E", "10°W", "20.5°W", "0°", "180°", "170°W"]);
  assert.deepEqual([35, -35, 0].map(words("degrees_north")), ["35°N", "35°S", "0°"]);
  assert.deepEqual([1500, 2.5e6, -1e6, 2_512_500].map(words("m")), ["1500", "2.5e6", "−1e6", "2.5125e6"]);
});

const cube = {
  size: [200, 200], scale: [1, 1, 0.5],
  camera: { eye: [4, -6, 4], look_at: [0.5, 0.5, 0.5], up: [0, 0, 1], field_of_view: 40, orthographic: false },
  domain: { min: [0, 0, 0], max: [1, 1, 2], axes: [["lon", "degrees_east"], ["lat", "degrees_north"], ["height", "m"]] },
};

test("a volume has twelve edges, three of them behind it, and an edge of each axis is named", () => {
  const lines = axesOf(cube);
  assert.equal(lines.length, 12);
  assert.equal(lines.filter(({ hidden }) => hidden).length, 3);
  assert.deepEqual(labels(lines).map(({ text }) => text).sort(), ["0", "0°", "0°", "1°E", "1°N", "2", "height (m)", "lat", "lon"].sort());
  const ends = lines.flatMap((line) => line.ends.flat());
  assert.ok(ends.every((value) => value > 0 && value < 1), "all of the box is in view");
  // Parallel projection along an axis: faces are seen edge on, and nothing breaks.
  const along = { ...cube, camera: { ...cube.camera, eye: [0.5, -5, 0.5], orthographic: true } };
  assert.equal(axesOf(along).length >= 8, true);
});

test("an edge that is cut off has its name, and no value where it does not end", () => {
  const seen = (look_at, field_of_view) => labels(axesOf({ ...cube, camera: { ...cube.camera, look_at, field_of_view } })).map(({ text }) => text);
  // The corner at x = 1, y = 0 and z = 2, where three edges meet.
  assert.deepEqual(seen([1, 0, 1], 4), ["lon", "1°E", "lat", "0°", "height (m)", "2"]);
  // The middle of an edge.
  const across = seen([0.5, 0, 1], 2);
  assert.ok(across.includes("lon") && across.every((text) => !/\d/.test(text)), String(across));
});

test("edges behind the eye are cut off", () => {
  const lines = axesOf({ ...cube, camera: { ...cube.camera, eye: [0.5, 0.2, 0.5], look_at: [0.5, 0.9, 0.5], field_of_view: 120 } });
  // The four of the far face, and what is seen of the four that come from behind.
  assert.ok(lines.length === 8 && lines.flatMap((line) => line.ends.flat()).every((value) => value >= 0 && value <= 1));
});

test("records that lack the view have no axes", () => {
  for (const record of [null, {}, { ...map(), camera: null }, { ...map(), domain: undefined }, { ...map(), size: [0, 0] }]) assert.deepEqual(axesOf(record), []);
});
