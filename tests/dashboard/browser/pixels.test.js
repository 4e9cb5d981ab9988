// Values under the pointer and saved frames in Chromium: of a run that shows itself, and of a dashboard beside one.
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { existsSync, mkdirSync, readFileSync } from "node:fs";
import path from "node:path";
import { after, before, test } from "node:test";
import { valueWords } from "../../../src/dashboard/page/values.js";
import { PROGRAM, TOKEN, launch, readExr, startDashboard, startShown, stop, temporary, until } from "./kit.js";

const SCREENSHOTS = process.env.SCREENSHOTS ?? path.join(import.meta.dirname, "screenshots");
const folder = temporary();
let browser;
let shown;
let beside;
let complaints;

before(async () => {
  mkdirSync(SCREENSHOTS, { recursive: true });
  browser = await launch();
  shown = await startShown(folder, { changes: { "publish.payload": '"png"' }, more: [`--steer=ipc://${folder}/commands`] });
  beside = await startDashboard(`ipc://${folder}/frames`, folder);
});

after(async () => {
  await browser?.close();
  for (const child of [shown?.child, beside?.child]) if (child) await stop(child);
});

// What the server refuses is told on the page, and by the browser on its console.
const isComplaint = (message) => ["error", "warning"].includes(message.type()) && !/getImageData|status of 410/.test(message.text());

async function open(address) {
  const page = await (await browser.newContext({ viewport: { width: 1280, height: 800 } })).newPage();
  complaints = [];
  page.on("console", (message) => { if (isComplaint(message)) complaints.push(message.text()); });
  page.on("pageerror", (error) => complaints.push(String(error)));
  await page.goto(address);
  await until("a picture", async () => /\d/.test(await page.textContent("#position")));
  return page;
}

const line = (page) => page.textContent("#values");
const fits = (page) => page.$eval("#values", (node) => node.scrollWidth <= node.clientWidth && node.clientHeight < 2 * Number.parseFloat(getComputedStyle(node).lineHeight));
const number = async (page) => Number((await page.textContent("#position")).replace(/\D/g, ""));

/** Puts the pointer on a pixel. */
async function point(page, [x, y]) {
  const box = await page.locator("#frame").boundingBox();
  const [width, height] = await page.$eval("#frame", (canvas) => [canvas.width, canvas.height]);
  await page.mouse.move(box.x + ((x + 0.5) / width) * box.width, box.y + ((y + 0.5) / height) * box.height);
}

async function saved(page, ending) {
  const [file] = await Promise.all([page.waitForEvent("download"), page.click(`[data-save="${ending}"]`)]);
  return { name: file.suggestedFilename(), bytes: readFileSync(await file.path()) };
}

/** Pixels of the canvas, and those of an encoded picture. */
const pixels = (page, picture) => page.$eval("#frame", async (canvas, encoded) => {
  const all = (source) => {
    const context = Object.assign(document.createElement("canvas"), { width: canvas.width, height: canvas.height }).getContext("2d");
    context.drawImage(source, 0, 0);
    return [...context.getImageData(0, 0, canvas.width, canvas.height).data];
  };
  return [all(canvas), all(await createImageBitmap(new Blob([Uint8Array.from(encoded)])))];
}, [...picture]);

test("the value follows the pointer and the run, and does not wrap", async () => {
  const page = await open(shown.url);
  await until("what to do is said", async () => /^Point at the picture/.test(await line(page)));
  await point(page, [40, 20]);
  await until("a value", async () => /^frame [\d,]+ at 40, 20: .*colour [\d.]+ [\d.]+ [\d.]+ ± [\d.e−]+, alpha [\d.]+$/.test(await line(page)));
  const first = await line(page);
  await until("that of a later frame", async () => (await line(page)) !== first && /at 40, 20/.test(await line(page)));
  assert.ok(await fits(page));
  // A long run at the largest size that is usual.
  const channels = { R: 0.000123, G: 0.000456, B: 0.000789, A: 0.987, error: 0.00012, "ftle.mean": -0.000123 };
  const longest = valueWords({ frame: 1_234_567, x: 3839, y: 2159, unit: "1/snapshots", channels });
  await page.mouse.move(2, 2);
  await until("the pointer has left", async () => /^Point/.test(await line(page)));
  await page.evaluate(() => { document.getElementById("values").id = "still"; const twin = document.getElementById("still").cloneNode(); twin.id = "values"; document.getElementById("still").after(twin); });
  await page.$eval("#values", (node, text) => { node.textContent = text; }, longest);
  assert.ok(await fits(page), longest);
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("a frame that stands still is told and saved as it is shown", async () => {
  const page = await open(shown.url);
  await until("the controls", () => page.isVisible("#pause"));
  await page.click("#pause");
  let before = -1;
  await until("no more frames", async () => { const is = await number(page); const same = is === before; before = is; await page.waitForTimeout(2_500); return same; }, 60_000);
  await page.click("#live");
  const frame = await number(page);
  await point(page, [30, 30]);
  await until("its value", async () => (await line(page)).startsWith(`frame ${frame.toLocaleString("en-GB")} at 30, 30:`));
  const value = await line(page);
  await page.screenshot({ path: path.join(SCREENSHOTS, "values.png") });
  const [png, exr, record] = [await saved(page, "png"), await saved(page, "exr"), await saved(page, "json")];
  const name = new RegExp(`^run-frame-${String(frame).padStart(6, "0")}-slide-\\d{4}\\.(png|exr|json)$`);
  for (const file of [png, exr, record]) assert.match(file.name, name);
  assert.deepEqual([...exr.bytes.subarray(0, 4)], [0x76, 0x2f, 0x31, 0x01]);
  assert.equal(JSON.parse(record.bytes).frame, frame);
  const film = readExr(exr.bytes);
  const channels = Object.fromEntries(Object.entries(film.channels).map(([name, values]) => [name, values[30 * film.width + 30]]));
  const [, unit] = /FTLE \S+ (\S+),/.exec(value) ?? [];
  assert.equal(value, valueWords({ frame, x: 30, y: 30, unit, channels }), "the value that is told is that of the EXR");
  const [drawn, decoded] = await pixels(page, png.bytes);
  assert.deepEqual(drawn, decoded);
  await page.click("#pause");
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("of an earlier frame it is said that its values are gone", async () => {
  const page = await open(shown.url);
  await page.keyboard.press("Space");
  const held = await number(page);
  await until("later frames", async () => Number(await page.getAttribute("#scrub", "max")) > 3);
  await point(page, [5, 5]);
  const gone = new RegExp(`frame ${held} is no longer kept: the run keeps its newest one, \\d+ by now`);
  await until("it is said", async () => gone.test(await line(page)));
  assert.ok(await fits(page));
  await page.click('[data-save="exr"]');
  await until("it is said", async () => gone.test(await page.textContent("#warnings")));
  // The picture and the record are here.
  const [png, record] = [await saved(page, "png"), await saved(page, "json")];
  assert.equal(JSON.parse(record.bytes).frame, held);
  const [drawn, decoded] = await pixels(page, png.bytes);
  assert.deepEqual(drawn, decoded);
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("the field of a slide is saved, and the command for it writes it too, at the time of the slide", async () => {
  const page = await open(shown.url);
  const [file] = await Promise.all([page.waitForEvent("download"), page.click("#field")]);
  const of = Number(/^run-field-slide-(\d{4})\.nc$/.exec(file.suggestedFilename())[1]);
  assert.equal(readFileSync(await file.path()).subarray(0, 3).toString(), "CDF");
  await until("it is told", async () => (await page.textContent("#field-state")) === `Saved: ${file.suggestedFilename()}.`);
  const command = await page.textContent("#field-command");
  const slide = Number(/^ridgewatch ftle run\/scene.toml --slide (\d+) /.exec(command)[1]);
  assert.ok(Math.abs(slide - of) <= 1, "slides may follow each other between the two");
  assert.match(await page.textContent("#field-words"), new RegExp(`^The FTLE of slide ${slide.toLocaleString("en-GB")}, `));
  assert.ok((await page.evaluate(() => document.documentElement.scrollWidth)) <= 1280);
  // It is run beside the run, whose records have the slide.
  const told = JSON.parse(execFileSync(PROGRAM, [...command.split(" ").slice(1), "--grid", "5x3", "--device", "cpu", "--json"], { cwd: folder, encoding: "utf8" }));
  const lines = readFileSync(path.join(folder, "run/records.jsonl"), "utf8").split("\n").slice(0, -1);
  const record = lines.map((line) => JSON.parse(line)).find((of) => of.slide === slide);
  assert.deepEqual([told.time, told.tau, told.grid], [record.time, record.tau, [5, 3, 1]]);
  assert.ok(existsSync(path.join(folder, command.split(" ").at(-1))));
  await page.click("#field");
  await until("it is hidden", async () => !(await page.isVisible("#field-told")));
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("a dashboard beside the run gets values and layers when they are asked for, and later ones while they are", async () => {
  const page = await open(`http://127.0.0.1:${beside.port}/?token=${TOKEN}`);
  assert.match(await line(page), /^Point at the picture/);
  await point(page, [5, 5]);
  // A longer sentence above the picture moves it under the pointer.
  const told = async () => Number(/^frame ([\d,]+) at 5, \d: /.exec(await line(page))?.[1].replaceAll(",", ""));
  const first = await until("a value", told);
  assert.ok(await fits(page));
  await until("that of a later frame", async () => (await told()) > first);
  const exr = await saved(page, "exr");
  assert.match(exr.name, /^run-frame-\d{6}-slide-\d{4}\.exr$/);
  const { width, channels } = readExr(exr.bytes);
  assert.ok(width === 96 && channels.error.some((error) => error > 0));
  assert.match((await saved(page, "json")).name, /^run-frame-\d{6}-slide-\d{4}\.json$/);
  assert.match((await saved(page, "png")).name, /^run-frame-\d{6}-slide-\d{4}\.png$/);
  assert.deepEqual(complaints, []);
  await page.context().close();
});
