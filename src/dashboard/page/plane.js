// A layer of a frame as the server sends it: half floats with a scale. And the colours of its values.
import { parseMessage } from "./protocol.js";

/** All half floats (IEEE 754 binary16) by their bits. */
const HALVES = Float32Array.from({ length: 1 << 16 }, (_, bits) => {
  const [exponent, fraction] = [(bits >> 10) & 31, (bits & 1023) / 1024];
  const size = exponent === 31 ? (fraction ? NaN : Infinity) : exponent === 0 ? fraction * 2 ** -14 : (1 + fraction) * 2 ** (exponent - 15);
  return bits >> 15 ? -size : size;
});

// Viridis (Smith and van der Walt 2015), which is told apart also with colour blindness: eleven of its colours, between which it is nearly straight.
const VIRIDIS = ["440154", "482475", "414487", "355f8d", "2a788e", "21918c", "22a884", "44bf70", "7ad151", "bddf26", "fde725"].map((hex) =>
  [0, 2, 4].map((at) => Number.parseInt(hex.slice(at, at + 2), 16)),
);

/** Colour of a share of the range; beyond 0 and 1 that of the ends. */
export function viridis(share) {
  const at = Math.min(Math.max(share, 0), 1) * (VIRIDIS.length - 1);
  const [below, above] = [VIRIDIS[Math.floor(at)], VIRIDIS[Math.ceil(at)]];
  return below.map((value, k) => Math.round(value + (at % 1) * (above[k] - value)));
}

/** Splits an answer of the server: its head, and `bits` of half floats. Throws if it is malformed. */
export function parsePlane(buffer) {
  const { payload, ...head } = parseMessage(buffer);
  const { columns, rows, scale } = head;
  if (![columns, rows].every((n) => Number.isInteger(n) && n >= 0) || !(scale > 0) || payload.byteLength !== 2 * columns * rows) throw new Error("a plane is not as long as it says");
  // A copy, since the values of a view must begin at an even byte.
  return { ...head, bits: new Uint16Array(payload.slice().buffer) };
}

/** The value at an index; NaN: none. */
export const valueAt = ({ bits, scale }, index) => HALVES[bits[index]] * scale;

// Values from which a range is taken.
const SAMPLE = 20_000;

/** Values from the share `from` to the share `to` of those that are known, of an even sample; null without any. */
export function spread(plane, from, to) {
  const { length } = plane.bits;
  const sample = Float64Array.from({ length: Math.min(length, SAMPLE) }, (_, k) => valueAt(plane, Math.floor((k * length) / Math.min(length, SAMPLE))));
  const known = sample.filter(Number.isFinite).sort();
  return known.length === 0 ? null : [from, to].map((share) => known[Math.round(share * (known.length - 1))]);
}

/** RGBA of the values, in [low, high]; nothing is drawn where there is no value, and at 0 if `zero` is false. */
export function paintPlane({ bits, scale, columns, rows }, [low, high], zero) {
  const colours = new Uint32Array(1 << 16);
  const bytes = new Uint8Array(colours.buffer);
  HALVES.forEach((half, k) => {
    if (Number.isNaN(half) || (half === 0 && !zero)) return;
    bytes.set([...viridis((half * scale - low) / (high - low)), 255], 4 * k);
  });
  const image = new ImageData(columns, rows);
  const pixels = new Uint32Array(image.data.buffer);
  bits.forEach((half, index) => { pixels[index] = colours[half]; });
  return image;
}
