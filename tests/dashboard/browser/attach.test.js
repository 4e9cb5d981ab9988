// A running simulation in Chromium: its steps and lag, its loss and its restart.
import assert from "node:assert/strict";
import { mkdirSync, mkdtempSync, readFileSync, rmSync } from "node:fs";
import path from "node:path";
import { after, before, test } from "node:test";
import { launch, startAttached, startSolver, stop, temporary, until } from "./kit.js";

const SCREENSHOTS = process.env.SCREENSHOTS ?? path.join(import.meta.dirname, "screenshots");
const folder = temporary();
// Rings lie in memory.
const ring = mkdtempSync("/dev/shm/ridgewatch-test-");
process.on("exit", () => rmSync(ring, { recursive: true, force: true }));
let browser;
let solver;
let shown;

before(async () => {
  mkdirSync(SCREENSHOTS, { recursive: true });
  browser = await launch();
  solver = startSolver(ring);
  shown = await startAttached(ring, folder);
});

after(async () => {
  await browser?.close();
  for (const child of [shown?.child, solver]) if (child) await stop(child);
});

const records = () => readFileSync(path.join(folder, "run/records.jsonl"), "utf8").split("\n").slice(0, -1).map((line) => JSON.parse(line));

test("a running simulation is followed, its loss is told within 5 s, and its restart is followed too", { timeout: 120_000 }, async () => {
  const page = await (await browser.newContext({ viewport: { width: 1280, height: 800 } })).newPage();
  const complaints = [];
  page.on("console", (message) => { if (["error", "warning"].includes(message.type())) complaints.push(message.text()); });
  page.on("pageerror", (error) => complaints.push(String(error)));
  await page.goto(shown.url);
  const sentence = () => page.textContent("#state");
  const step = async () => Number(/step ([\d,]+)/.exec(await sentence())?.[1].replaceAll(",", ""));
  await until("a step", async () => await step() >= 0, 60_000);
  const first = await step();
  await until("later steps", async () => await step() > first + 3);
  assert.match(await sentence(), /behind the simulation/);
  assert.equal(await page.textContent("#source"), "a running simulation, 48 x 24 x 24 nodes in 1 block(s), time without a unit");
  // The lag is that of the record.
  const { live } = records().at(-1);
  assert.ok(live.delay >= 0 && live.delay < 5, `${live.delay} s`);
  await page.screenshot({ path: path.join(SCREENSHOTS, "attach.png") });

  // A drag moves the camera of a later frame.
  const { frame, camera } = records().at(-1);
  const box = await page.locator("#frame").boundingBox();
  await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
  await page.mouse.down();
  await page.mouse.move(box.x + box.width / 4, box.y + box.height / 2, { steps: 5 });
  await page.mouse.up();
  await until("a turned view", () => records().some((record) => record.frame > frame && String(record.camera.eye) !== String(camera.eye)));

  // The field of the window that the run shows, which slides on meanwhile.
  const [field] = await Promise.all([page.waitForEvent("download"), page.click("#field")]);
  assert.match(field.suggestedFilename(), /^run-field-slide-\d{4}\.nc$/);
  assert.equal(readFileSync(await field.path()).subarray(0, 3).toString(), "CDF");

  const warnings = () => page.textContent("#warnings");
  assert.doesNotMatch(await warnings(), /simulation/);
  const killed = Date.now();
  await stop(solver, "SIGKILL");
  await until("a warning", async () => /simulation has ended or is gone/.test(await warnings()), 5000);
  console.log(`the loss of the simulation was told after ${Date.now() - killed} ms`);
  solver = startSolver(ring);
  await until("a restart", async () => /simulation restarted/.test(await warnings()), 30_000);
  await until("no loss", async () => !/has ended or is gone/.test(await warnings()), 30_000);
  const restarted = await step();
  await until("steps after the restart", async () => await step() > restarted);
  assert.deepEqual(complaints, []);
});
