// Planes of half floats, and the colours of their values.
import assert from "node:assert/strict";
import { test } from "node:test";
import { parsePlane, spread, valueAt, viridis } from "../../../src/dashboard/page/plane.js";
import { compose } from "./kit.js";

/** A message as it comes: the payload begins at an odd byte for one of two lengths of the head. */
function message(bits, head) {
  const payload = Buffer.from(Uint16Array.from(bits).buffer);
  const bytes = compose({ columns: bits.length, rows: 1, scale: 1, ...head }, payload);
  return bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length);
}

test("half floats are those of IEEE 754, times the scale", () => {
  // From the table of the standard's encodings.
  const known = [[0x0000, 0], [0x0001, 2 ** -24], [0x03ff, 1023 * 2 ** -24], [0x0400, 2 ** -14], [0x3555, 0.333251953125], [0x3c00, 1], [0x3c01, 1 + 2 ** -10], [0xc000, -2], [0x7bff, 65504], [0x7c00, Infinity], [0xfc00, -Infinity], [0x7e00, NaN]];
  for (const padding of ["", "x"]) {
    const plane = parsePlane(message(known.map(([bits]) => bits), { scale: 4, padding }));
    known.forEach(([, value], index) => assert.equal(valueAt(plane, index), 4 * value));
  }
});

test("a plane of another length than it says is refused", () => {
  for (const head of [{ columns: 2 }, { rows: 2 }, { columns: -1, rows: -3 }, { columns: null }, { scale: 0 }, { columns: 1.5, rows: 2 }]) {
    assert.throws(() => parsePlane(message([1, 2, 3], head)), /not as long as it says/, JSON.stringify(head));
  }
});

test("a range is that of the known values", () => {
  // 0 to 100 as half floats, which hold whole numbers up to 2048.
  const half = (n) => (n === 0 ? 0 : ((Math.floor(Math.log2(n)) + 15) << 10) | ((n / 2 ** Math.floor(Math.log2(n)) - 1) * 1024));
  const bits = [0x7e00, ...Array.from({ length: 101 }, (_, n) => half(100 - n)), 0x7c00];
  const plane = parsePlane(message(bits, {}));
  assert.deepEqual(spread(plane, 0, 1), [0, 100]);
  assert.deepEqual(spread(plane, 0.1, 0.9), [10, 90]);
  assert.equal(spread(parsePlane(message([0x7e00], {})), 0, 1), null);
});

test("colours go from dark to light, and beyond the range are those of its ends", () => {
  assert.deepEqual([viridis(0), viridis(-1), viridis(1), viridis(2)], [[68, 1, 84], [68, 1, 84], [253, 231, 37], [253, 231, 37]]);
  const light = ([r, g, b]) => 0.2126 * r + 0.7152 * g + 0.0722 * b;
  for (let k = 0; k < 50; k += 1) assert.ok(light(viridis((k + 1) / 50)) > light(viridis(k / 50)));
});
