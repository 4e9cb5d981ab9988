// What the page keeps is bounded, and belongs to one run.
import assert from "node:assert/strict";
import { test } from "node:test";
import { ticks } from "../../../src/dashboard/page/colour_bar.js";
import { Pictures, Records } from "../../../src/dashboard/page/history.js";
import { parseMessage } from "../../../src/dashboard/page/protocol.js";
import { compose } from "./kit.js";

const picture = (frame, size, elapsed = frame) => ({ frame, elapsed, blob: { size } });

test("pictures are bounded in number and in bytes", () => {
  const many = new Pictures();
  for (let frame = 0; frame < 1000; frame += 1) many.add(picture(frame, 10));
  assert.deepEqual([many.list.length, many.list[0].frame, many.bytes], [300, 700, 3000]);
  const large = new Pictures();
  for (let frame = 0; frame < 10; frame += 1) large.add(picture(frame, 50 << 20));
  assert.deepEqual([large.list.length, large.bytes], [2, 100 << 20]);
  const huge = new Pictures();
  for (let frame = 0; frame < 3; frame += 1) huge.add(picture(frame, 200 << 20));
  assert.deepEqual([huge.list.length, huge.list[0].frame, huge.bytes], [1, 2, 200 << 20]);
});

test("the same frame replaces itself", () => {
  const pictures = new Pictures();
  pictures.add(picture(4, 10));
  assert.equal(pictures.add(picture(4, 30)), false);
  assert.deepEqual([pictures.list.length, pictures.bytes], [1, 30]);
});

test("records are bounded, and missing ones are counted", () => {
  const records = new Records();
  for (let frame = 0; frame < 5000; frame += 2) records.add({ frame, elapsed: frame });
  assert.deepEqual([records.rows.length, records.rows.at(-1).frame, records.missing], [2000, 4998, 2499]);
  assert.ok(records.has({ frame: 3000, elapsed: 3000 }));
  assert.ok(!records.has({ frame: 3000, elapsed: 1 }) && !records.has({ frame: 3001, elapsed: 3001 }) && !records.has({ frame: 6000, elapsed: 6000 }));
});

test("a smaller frame or an earlier clock begins a new run", () => {
  for (const next of [{ frame: 3, elapsed: 90 }, { frame: 12, elapsed: 2 }]) {
    const records = new Records();
    records.add({ frame: 10, elapsed: 50 });
    assert.equal(records.add(next), true);
    assert.deepEqual([records.rows.length, records.missing], [1, 0]);
    const pictures = new Pictures();
    pictures.add(picture(10, 5, 50));
    assert.equal(pictures.add(picture(next.frame, 7, next.elapsed)), true);
    assert.equal(pictures.bytes, 7);
  }
});

test("the nearest picture is found", () => {
  const pictures = new Pictures();
  assert.equal(pictures.nearest(5), -1);
  for (const frame of [10, 20, 40]) pictures.add(picture(frame, 1));
  assert.deepEqual([0, 16, 31, 99].map((frame) => pictures.nearest(frame)), [0, 1, 2, 2]);
});

test("messages are split, and malformed ones refused", () => {
  const exact = (buffer) => buffer.buffer.slice(buffer.byteOffset, buffer.byteOffset + buffer.length);
  const message = parseMessage(exact(compose({ kind: "frame", sequence: 3 }, Buffer.from("picture"))));
  assert.deepEqual([message.kind, message.sequence, Buffer.from(message.payload).toString()], ["frame", 3, "picture"]);
  for (const bad of [Buffer.alloc(3), Buffer.from([9, 0, 0, 0, 1]), compose(null, Buffer.alloc(0)), Buffer.from([1, 0, 0, 0, 0x7b])]) {
    assert.throws(() => parseMessage(exact(bad)));
  }
});

test("ticks are round and within the scale", () => {
  assert.deepEqual(ticks(0.05, 0.45).map((value) => Number(value.toFixed(6))), [0.1, 0.2, 0.3, 0.4]);
  assert.deepEqual(ticks(-1, 1).map((value) => Number(value.toFixed(6))), [-1, -0.5, 0, 0.5, 1]);
});
