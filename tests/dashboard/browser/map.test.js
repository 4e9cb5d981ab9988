// A map in Chromium: its axes, values, file and picture without loss; and the box of a volume.
import assert from "node:assert/strict";
import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import path from "node:path";
import { after, before, test } from "node:test";
import { valueWords } from "../../../src/dashboard/page/values.js";
import { launch, readExr, startShown, stop, temporary, until } from "./kit.js";

const SCREENSHOTS = process.env.SCREENSHOTS ?? path.join(import.meta.dirname, "screenshots");
const folder = temporary();
const other = temporary();
const third = temporary();
let browser;
let map;
let volume;
let cap;
let complaints;

/** Winds of the northern cap as a store of Zarr 2, at three times. Returns its folder. */
function writeCap(folder) {
  const store = path.join(folder, "cap.zarr");
  const write = (name, dimensions, values, attributes) => {
    const shape = dimensions.map((dimension) => axes[dimension].length);
    mkdirSync(path.join(store, name), { recursive: true });
    const file = (ending, content) => writeFileSync(path.join(store, name, ending), content);
    file(".zarray", JSON.stringify({ zarr_format: 2, shape, chunks: shape, dtype: "<f4", compressor: null, fill_value: null, order: "C", filters: null }));
    file(".zattrs", JSON.stringify({ _ARRAY_DIMENSIONS: dimensions, ...attributes }));
    file(shape.map(() => 0).join("."), new Uint8Array(Float32Array.from(values).buffer));
  };
  const axes = { time: [0, 12, 24], lat: Array.from({ length: 31 }, (_, j) => 60 + j), lon: Array.from({ length: 180 }, (_, i) => 2 * i) };
  write("time", ["time"], axes.time, { units: "hours since 2002-01-01" });
  write("lat", ["lat"], axes.lat, { units: "degrees_north" });
  write("lon", ["lon"], axes.lon, { units: "degrees_east" });
  writeFileSync(path.join(store, ".zgroup"), JSON.stringify({ zarr_format: 2 }));
  const wind = (of) => axes.time.flatMap(() => axes.lat.flatMap((lat) => axes.lon.map((lon) => of((lat * Math.PI) / 180, (lon * Math.PI) / 180))));
  write("u", ["time", "lat", "lon"], wind((lat, lon) => (40 * Math.sin(6 * lat) + 15 * Math.sin(3 * lon)) * Math.cos(lat)), { units: "m s-1" });
  write("v", ["time", "lat", "lon"], wind((lat, lon) => 15 * Math.cos(3 * lon) * Math.sin(4 * lat)), { units: "m s-1" });
  return store;
}

before(async () => {
  mkdirSync(SCREENSHOTS, { recursive: true });
  browser = await launch();
  const changes = { "render.method": '"map"', "render.budget": null, "render.width": 320, "render.height": 160, "camera.orthographic": true };
  map = await startShown(folder, { changes, more: [`--steer=ipc://${folder}/commands`] });
  volume = await startShown(other, { scene: "configs/abc.toml", changes: { "time.frames_per_slide": 1000, "time.slides": 1 } });
  const still = { "render.budget": null, "render.width": 320, "render.height": 240, "time.tau": 86_400, "time.frames_per_slide": 100_000, "time.slides": 1, "flow.steps": 10 };
  cap = await startShown(third, { scene: writeCap(third), changes: still, more: [`--steer=ipc://${third}/commands`] });
});

after(async () => {
  await browser?.close();
  for (const child of [map?.child, volume?.child, cap?.child]) if (child) await stop(child);
});

async function open(address, options = {}) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 900 }, ...options });
  const page = await context.newPage();
  complaints = [];
  page.on("console", (message) => { if (["error", "warning"].includes(message.type()) && !/getImageData|status of 410/.test(message.text())) complaints.push(message.text()); });
  page.on("pageerror", (error) => complaints.push(String(error)));
  await page.goto(address);
  await until("a picture", async () => /\d/.test(await page.textContent("#position")));
  return page;
}

/** Texts of the axes, and where they are in shares of the picture. */
const labels = (page) => page.evaluate(() => {
  const canvas = document.getElementById("frame").getBoundingClientRect();
  return [...document.querySelectorAll("#axes text")].map((text) => {
    const { left, right, top, bottom } = text.getBoundingClientRect();
    const [x, y] = [((left + right) / 2 - canvas.left) / canvas.width, ((top + bottom) / 2 - canvas.top) / canvas.height];
    const inside = left >= canvas.left && right <= canvas.right && top >= canvas.top && bottom <= canvas.bottom;
    return { text: text.textContent, x, y, inside, box: { left, right, top, bottom } };
  });
});

/** Labels are whole, and none lies on another. */
async function assertLegible(page) {
  const found = await labels(page);
  assert.ok(found.length > 2 && found.every(({ inside }) => inside), JSON.stringify(found));
  found.forEach(({ text, box: a }, k) => found.slice(k + 1).forEach(({ text: other, box: b }) => {
    assert.ok(a.right <= b.left || b.right <= a.left || a.bottom <= b.top || b.bottom <= a.top, `${text} and ${other}`);
  }));
}

test("lines lie at their values, follow the view, and are switched off", async () => {
  const page = await open(map.url);
  const one = async () => (await labels(page)).find(({ text }) => text === "1");
  await until("the line of x = 1", one);
  // The camera looks at x = 1.
  assert.ok(Math.abs((await one()).x - 0.5) < 0.01 && (await one()).y > 0.9, JSON.stringify(await labels(page)));
  await assertLegible(page);
  await page.screenshot({ path: path.join(SCREENSHOTS, "map.png") });
  await page.keyboard.press("g");
  assert.deepEqual(await labels(page), []);
  assert.equal(await page.isChecked("#axes-on"), false);
  await page.reload();
  await until("a picture", async () => /\d/.test(await page.textContent("#position")));
  assert.deepEqual(await labels(page), [], "it is remembered");
  await page.focus("#axes-on");
  await page.keyboard.press("Space");
  await until("the line of x = 1", one);
  assert.equal(await page.getAttribute("#live", "aria-pressed"), "true", "Space is of the box");
  await until("the controls", () => page.isVisible("#pause"));
  await page.keyboard.press("d");
  await until("another place", async () => Math.abs(((await one())?.x ?? 0.5) - 0.5) > 0.02);
  await page.keyboard.press("Home");
  await until("the place of an earlier picture", async () => Math.abs(((await one())?.x ?? 0) - 0.5) < 0.01);
  await page.keyboard.press("End");
  await until("the present place", async () => Math.abs(((await one())?.x ?? 0.5) - 0.5) > 0.02);
  await page.keyboard.press("0");
  await until("the first place", async () => Math.abs(((await one())?.x ?? 0) - 0.5) < 0.01);
  await page.keyboard.press("f");
  await until("full screen", () => page.evaluate(() => document.fullscreenElement !== null));
  // All of the picture is there, and its labels with it.
  await until("a picture as high as its stage", () => page.evaluate(() => document.getElementById("frame").clientHeight <= document.getElementById("stage").clientHeight));
  await until("the line of x = 1", one);
  await assertLegible(page);
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("a map says its values, seeds and error, and is saved as a field", async () => {
  const page = await open(map.url);
  await until("the sentence", async () => /, [\d,]+ seeds a pixel\.$/.test(await page.textContent("#state")));
  assert.ok(await page.isHidden("#scale-light"), "colours of a map have no shadow");
  // Without a surrogate there is no tolerance, and all is traced.
  const titles = await page.locator(".chart:not([hidden]) figcaption").allTextContents();
  assert.deepEqual(titles, ["Error of the picture (PSNR, higher is better) in dB", "Frame time by stage in s"]);
  const box = await page.locator("#frame").boundingBox();
  await page.mouse.move(box.x + box.width / 3, box.y + box.height / 2);
  await until("a value", async () => /^frame [\d,]+ at \d+, \d+: FTLE [\d.]+ ± [\d.e−]+$/.test(await page.textContent("#values")));
  await page.selectOption("#overlay-of", "error");
  await until("the overlay", async () => /^Stated error of the FTLE, frame/.test(await page.textContent("#overlay-text")));
  await page.selectOption("#overlay-of", "trusted");
  await until("its absence", async () => /^No overlay: map has no surrogate to trust$/.test(await page.textContent("#overlay-text")));
  const [file] = await Promise.all([page.waitForEvent("download"), page.click("#field")]);
  assert.match(file.suggestedFilename(), /^run-frame-\d{6}-slide-\d{4}\.nc$/);
  assert.equal(readFileSync(await file.path()).subarray(0, 3).toString(), "CDF");
  await until("the method", async () => (await page.inputValue("#method")) === "map");
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("a map in a projection has meridians and parallels, moves in its plane, and is saved with it", async () => {
  const page = await open(cap.url);
  const named = async (words) => (await labels(page)).find(({ text }) => text === words);
  await until("the controls", () => page.isVisible("#pause"));
  await until("a meridian", () => named("180°"));
  // Down from the pole, which is the middle of the picture.
  assert.ok(Math.abs((await named("180°")).x - 0.5) < 0.05 && (await named("180°")).y > 0.9, JSON.stringify(await labels(page)));
  await assertLegible(page);
  assert.ok(await page.locator("#axes polyline.line").count() > 6);
  await page.screenshot({ path: path.join(SCREENSHOTS, "cap.png") });
  // Beside the disc there are no data.
  const box = await page.locator("#frame").boundingBox();
  await page.mouse.move(box.x + 4, box.y + 4);
  await until("no value in a corner", async () => /: no value$/.test(await page.textContent("#values")));
  await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
  await until("a value at the pole", async () => /: FTLE \S+ ± /.test(await page.textContent("#values")));
  await page.mouse.down();
  await page.mouse.move(box.x + box.width * 0.75, box.y + box.height / 2, { steps: 4 });
  await page.mouse.up();
  await until("a pole under the pointer", async () => Math.abs(((await named("180°"))?.x ?? 0) - 0.75) < 0.05);
  await page.mouse.wheel(0, -1500);
  await until("finer lines", async () => (await labels(page)).some(({ text }) => /^8[6-9](\.\d)?°N$/.test(text)));
  await page.screenshot({ path: path.join(SCREENSHOTS, "cap-near.png") });
  await page.keyboard.press("0");
  await until("the first view", async () => Math.abs(((await named("180°"))?.x ?? 0) - 0.5) < 0.05);
  const [file] = await Promise.all([page.waitForEvent("download"), page.click("#field")]);
  const bytes = readFileSync(await file.path());
  assert.ok(bytes.subarray(0, 3).toString() === "CDF" && bytes.includes("polar_stereographic"));
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("the value of a pixel is that of the frame's EXR", async () => {
  const page = await open(map.url);
  await until("the controls", () => page.isVisible("#pause"));
  await page.click("#pause");
  const shown = async () => Number((await page.textContent("#position")).replace(/\D/g, ""));
  let frame = -1;
  await until("no more frames", async () => { const is = await shown(); const same = is === frame; frame = is; await page.waitForTimeout(2_500); return same; }, 60_000);
  const [file] = await Promise.all([page.waitForEvent("download"), page.click('[data-save="exr"]')]);
  assert.match(file.suggestedFilename(), new RegExp(`^run-frame-${String(frame).padStart(6, "0")}-`));
  const { width, channels } = readExr(readFileSync(await file.path()));
  assert.equal(width, 320);
  const box = await page.locator("#frame").boundingBox();
  const told = [];
  for (const [x, y] of [[107, 40], [40, 107], [300, 12]]) {
    await page.mouse.move(box.x + ((x + 0.5) / 320) * box.width, box.y + ((y + 0.5) / 160) * box.height);
    await until("its value", async () => (await page.textContent("#values")).startsWith(`frame ${frame.toLocaleString("en-GB")} at ${x}, ${y}: FTLE `));
    told.push(await page.textContent("#values"));
    const of = Object.fromEntries(Object.entries(channels).map(([name, values]) => [name, values[y * width + x]]));
    assert.equal(told.at(-1), valueWords({ frame, x, y, channels: of, method: "map" }));
    const [, ftle, error] = /FTLE (\S+) ± (\S+)$/.exec(told.at(-1)).map((text) => Number(text.replaceAll("−", "-")));
    assert.ok(Math.abs(ftle / of["ftle.mean"] - 1) < 0.005 && Math.abs(error / of.error - 1) < 0.05, `${told.at(-1)}, not ${of["ftle.mean"]} and ${of.error}`);
  }
  assert.equal(new Set(told.map((text) => text.split(": ")[1])).size, 3, "values of different pixels");
  await page.click("#pause");
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("a picture that stands is drawn without the losses of JPEG", async () => {
  const page = await open(map.url);
  await until("the controls", () => page.isVisible("#pause"));
  const form = () => page.textContent('[data-fact="picture"]');
  await until("a picture of motion", async () => /, jpeg$/.test(await form()));
  await page.click("#pause");
  await until("a picture without loss", async () => /, png$/.test(await form()), 60_000);
  // Viridis has no grey: of the colours of JPEG many are none of its own.
  const address = new URL(map.url);
  address.pathname += "frame.png";
  const differing = await page.$eval("#frame", async (canvas, url) => {
    const bitmap = await createImageBitmap(await (await fetch(url)).blob());
    const pixels = (source) => {
      const context = Object.assign(document.createElement("canvas"), { width: canvas.width, height: canvas.height }).getContext("2d");
      context.drawImage(source, 0, 0);
      return context.getImageData(0, 0, canvas.width, canvas.height).data;
    };
    const [shown, exact] = [pixels(canvas), pixels(bitmap)];
    return shown.filter((value, k) => value !== exact[k]).length;
  }, address.href);
  assert.equal(differing, 0);
  await page.click("#pause");
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("the box of a volume names its axes, in both themes", async () => {
  for (const [colorScheme, viewport] of [["dark", { width: 1280, height: 900 }], ["light", { width: 390, height: 844 }]]) {
    const page = await open(volume.url, { colorScheme, viewport });
    await until("three axes", async () => (await labels(page)).filter(({ text }) => ["x", "y", "z"].includes(text)).length === 3);
    await assertLegible(page);
    assert.equal(await page.locator("#axes line.hidden-edge").count() > 0, true);
    await page.screenshot({ path: path.join(SCREENSHOTS, `volume-${colorScheme}.png`) });
    assert.deepEqual(complaints, []);
    await page.context().close();
  }
});
