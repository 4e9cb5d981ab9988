// The value under the pointer: which pixel it is, what is asked, and in which words it is told.
import assert from "node:assert/strict";
import { test } from "node:test";
import { Values, asker, fieldCommand, fieldWords, fileName, pixelAt, valueWords } from "../../../src/dashboard/page/values.js";

const values = {
  frame: 1200, slide: 3, x: 5, y: 7, size: [96, 48], unit: "1/s",
  channels: { R: 0.5, G: 0.25, B: 0.125, A: 0.98765, "ftle.mean": 0.21317, error: 0.004126, "missing.share": 0 },
};

test("a pixel follows from the place and the drawn size, and outside there is none", () => {
  const box = { left: 100, top: 50, width: 192, height: 96 };
  const at = (clientX, clientY) => pixelAt({ clientX, clientY }, box, [96, 48]);
  assert.deepEqual([at(100, 50), at(101.9, 51.9), at(102, 52), at(291.9, 145.9)], [[0, 0], [0, 0], [1, 1], [95, 47]]);
  assert.deepEqual([at(99, 60), at(292, 60), at(150, 49), at(150, 146)], [null, null, null, null]);
});

test("a value is told with its error, and without one that is said", () => {
  assert.equal(valueWords(values), "frame 1,200 at 5, 7: FTLE 0.213 1/s, colour 0.500 0.250 0.125 ± 0.0041, alpha 0.988");
  const { error, ...without } = values.channels;
  assert.ok(error > 0);
  assert.match(valueWords({ ...values, channels: without, no_error: "gated states none" }), /colour 0.500 0.250 0.125 ± unknown,/);
  assert.match(valueWords({ ...values, channels: { ...values.channels, "ftle.mean": null } }), /: no FTLE shown, colour/);
  assert.match(valueWords({ ...values, channels: { ...values.channels, "missing.share": 1 } }), /: no data/);
  assert.match(valueWords({ ...values, channels: { ...values.channels, error: null } }), /± –/);
});

test("a map has a value with its error, and colours say no more", () => {
  const map = { ...values, method: "map" };
  assert.equal(valueWords(map), "frame 1,200 at 5, 7: FTLE 0.213 ± 0.0041 1/s");
  assert.equal(valueWords({ ...map, unit: "" }), "frame 1,200 at 5, 7: FTLE 0.213 ± 0.0041");
  assert.match(valueWords({ ...map, channels: { ...values.channels, error: null } }), /: FTLE 0.213 ± unknown 1\/s$/);
  assert.match(valueWords({ ...map, channels: { ...values.channels, "ftle.mean": null } }), /: no value$/);
  assert.match(valueWords({ ...map, channels: { ...values.channels, "missing.share": 1 } }), /: no data/);
});

test("names of files tell run, frame and slide", () => {
  assert.equal(fileName("gulf", { frame: 12, slide: 3 }, "exr"), "gulf-frame-000012-slide-0003.exr");
});

test("how far a field is has its time left, once seeds are traced", () => {
  assert.equal(fieldWords({ slide: null, share: 0, seconds_left: null }), "The run reads its next slide, whose FTLE is traced then.");
  assert.equal(fieldWords({ slide: 1234, share: 0, seconds_left: null }), "Tracing the FTLE of slide 1,234 beside the run: 0 %.");
  assert.equal(fieldWords({ slide: 3, share: 0.25, seconds_left: 9 }), "Tracing the FTLE of slide 3 beside the run: 25 %, about 9.0 s left.");
});

test("the command of a field names the slide, and of a simulation there is none", () => {
  const record = { slide: 3, time: 1.5, date: null, tau: 10, direction: "backward", live: null, time_unit: "s" };
  const { words, command } = fieldCommand("gulf", "tcp://127.0.0.1:5577", record);
  assert.equal(command, "ridgewatch ftle gulf/scene.toml --slide 3 --set time.tau=10 --set time.direction=backward --out gulf-slide-0003.nc");
  assert.match(words, /slide 3, t0 = 1.5 s, .*the folder gulf of the run/);
  assert.match(fieldCommand("gulf", "ipc:///tmp/frames", record).command, / --set publish.endpoint=private --out gulf/);
  const live = fieldCommand("gulf", null, { ...record, live: { step: 5 } });
  assert.ok(live.command === null && /running simulation/.test(live.words));
});

test("the server's words are told, and of a proxy's page the status alone", async (context) => {
  const answers = [["frame 3 is no longer kept\n", 410, "text/plain; charset=utf-8"], ["<!DOCTYPE HTML>", 599, "text/html"], ["", 502, "text/plain"]];
  context.mock.method(globalThis, "fetch", async () => {
    const [text, status, type] = answers.shift();
    return new Response(text, { status, headers: { "content-type": type } });
  });
  globalThis.location = { href: "http://portal.example.org/proxy/8577/" };
  const told = [];
  while (answers.length > 0) told.push((await asker("token")({ x: 0, y: 0 })).problem);
  delete globalThis.location;
  assert.deepEqual(told, ["frame 3 is no longer kept", "the server answers 599", "the server answers 502"]);
});

/** With questions that the test answers. */
function stage() {
  const [asked, told] = [[], []];
  const ask = (query) => new Promise((resolve) => { asked.push({ query, resolve }); });
  const stage = new Values({ ask, show: (text) => told.push(text) });
  return { stage, asked, told };
}
const pause = (milliseconds) => new Promise((resolve) => { setTimeout(resolve, milliseconds); });

test("one question is on its way, and of those that wait the newest is asked", async () => {
  const { stage: asking, asked, told } = stage();
  asking.receiveState({ values: { ready: "run" } });
  for (let x = 0; x < 10; x += 1) asking.point([x, 1], null);
  assert.deepEqual(asked.map(({ query }) => query), [{ x: 0, y: 1 }]);
  asked[0].resolve({ values });
  await pause(100);
  assert.match(told.at(-1), /^frame 1,200 at 5, 7/);
  assert.deepEqual(asked[1].query, { x: 9, y: 1 });
  asked[1].resolve({ problem: "frame 3 is no longer kept" });
  await pause(100);
  assert.equal(told.at(-1), "No value: frame 3 is no longer kept");
  assert.equal(asked.length, 2, "nothing else waits");
  asking.point([2, 2], 77);
  assert.deepEqual(asked[2].query, { x: 2, y: 2, frame: 77 });
  // The pointer leaves before the answer comes.
  asking.point(null, null);
  asked[2].resolve({ values });
  await pause(100);
  assert.match(told.at(-1), /^Point at the picture/);
});

test("where nothing is kept, nothing is asked and the reason is said", () => {
  const { stage: asking, asked, told } = stage();
  asking.point([1, 1], null);
  asking.receiveState({ values: { none: "this dashboard runs beside the run" } });
  asking.point([1, 1], null);
  assert.deepEqual([asked.length, told.at(-1)], [0, "No values here: this dashboard runs beside the run."]);
});
