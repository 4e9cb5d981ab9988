// Commands of the page: one on its way at a time, and moves that go on from what was asked for.
import assert from "node:assert/strict";
import { test } from "node:test";
import { Steering } from "../../../src/dashboard/page/steering.js";

const eye = [0, -2, 0];
const camera = { eye, look_at: [0, 0, 0], up: [0, 0, 1], field_of_view: 90, orthographic: false };
const ready = (commands, paused = false) => ({ commands, paused, dimensions: 3 });
const pause = (milliseconds) => new Promise((resolve) => { setTimeout(resolve, milliseconds); });

function steered() {
  const said = [];
  const told = [];
  const steering = new Steering({ say: (message) => said.push(message), told: (text) => told.push(text), acted: () => {}, refused: () => {} });
  steering.receiveState({ steering: { ready: ready(0) }, token_to_share: "abc" });
  steering.receiveRecords([{ frame: 1, camera, size: [96, 48], commands: [] }]);
  return { steering, said, told };
}

test("of what waits for an answer the newest value of each key is sent", async () => {
  const { steering, said } = steered();
  for (let k = 0; k < 10; k += 1) steering.zoom(0.5);
  steering.togglePause();
  assert.deepEqual(said.map(({ command, set }) => [command, Object.keys(set)]), [[1, ["camera"]]]);
  steering.receiveAnswer({ command: 7, accepted: ready(1) });
  steering.receiveAnswer({ command: 1, accepted: ready(1) });
  await pause(100);
  assert.deepEqual(said[1].set.paused, true);
  assert.ok(Math.abs(Math.hypot(...said[1].set.camera.eye) - 2 * 0.5 ** 10) < 1e-12, "each zoom began at the one before");
  assert.equal(said.length, 2);
});

test("until the frame of a camera comes, moves begin at what was asked for", async () => {
  const { steering } = steered();
  const distance = () => Math.hypot(...steering.camera.eye);
  steering.zoom(0.5);
  // A frame of the former view.
  steering.receiveRecords([{ frame: 2, camera, size: [96, 48], commands: [] }]);
  assert.equal(distance(), 1);
  steering.receiveAnswer({ command: 1, accepted: ready(1) });
  steering.receiveRecords([{ frame: 3, camera, size: [96, 48], commands: [] }]);
  assert.equal(distance(), 1);
  const nearer = { ...camera, eye: [0, -1, 0] };
  steering.receiveRecords([{ frame: 4, camera: nearer, size: [96, 48], commands: [{ number: 1, set: { camera: nearer } }] }]);
  // From now on the camera is that of the run, which another one may move.
  steering.receiveRecords([{ frame: 5, camera, size: [96, 48], commands: [{ number: 2, set: { camera } }] }]);
  assert.equal(distance(), 2);
  // A record that comes before the answer.
  await pause(100);
  steering.zoom(0.5);
  steering.receiveRecords([{ frame: 6, camera: nearer, size: [96, 48], commands: [{ number: 3, set: { camera: nearer } }] }]);
  steering.receiveAnswer({ command: 2, accepted: ready(3) });
  steering.receiveRecords([{ frame: 7, camera, size: [96, 48], commands: [{ number: 4, set: { camera } }] }]);
  assert.equal(distance(), 2);
});

test("a command without a connection is told, and the next one is sent", () => {
  const { steering, said, told } = steered();
  const say = steering.say;
  steering.say = () => false;
  steering.zoom(0.5);
  assert.deepEqual([told, said, steering.camera], [["Not sent: no connection"], [], camera]);
  steering.say = say;
  steering.togglePause();
  assert.deepEqual(said.map(({ set }) => set), [{ paused: true }]);
  // The connection ends before the answer.
  steering.abandon();
  assert.equal(told[1], "No answer came: paused may be lost");
  steering.abandon();
  assert.equal(told.length, 2);
});

test("an answer from before a reset does not end a later command", async () => {
  const { steering, said } = steered();
  steering.togglePause();
  steering.receiveAnswer({ command: 1, accepted: ready(1, true) });
  steering.abandon();
  steering.togglePause();
  steering.zoom(0.5);
  await pause(100);
  assert.deepEqual(said.map(({ command }) => command), [1, 2]);
  steering.receiveAnswer({ command: 2, accepted: ready(2) });
  await pause(100);
  assert.deepEqual(Object.keys(said[2].set), ["camera"]);
});

test("a refusal is told and leaves the view, and who may not command sends nothing", () => {
  const { steering, said, told } = steered();
  steering.zoom(0.5);
  steering.receiveAnswer({ command: 1, refused: "`camera.up` is 0" });
  assert.deepEqual([told, steering.camera], [["Refused: `camera.up` is 0"], camera]);
  steering.receiveState({ steering: { ready: ready(0) } });
  assert.equal(steering.obstacle, "This address only watches the run.");
  steering.receiveState({ steering: { none: "it is far" }, token_to_share: "abc" });
  assert.equal(steering.obstacle, "The run is not steered: it is far.");
  for (const act of ["home", "togglePause"]) steering[act]();
  steering.turn(0.1, 0.1);
  assert.equal(said.length, 1);
});
