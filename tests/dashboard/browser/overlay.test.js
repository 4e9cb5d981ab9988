// Overlays in Chromium: what is drawn is what the run knows of each pixel, and where nothing can be drawn the page says why.
import assert from "node:assert/strict";
import { mkdirSync } from "node:fs";
import path from "node:path";
import { after, before, test } from "node:test";
import { viridis } from "../../../src/dashboard/page/plane.js";
import { TOKEN, launch, startDashboard, startShown, stop, temporary, until } from "./kit.js";

const SCREENSHOTS = process.env.SCREENSHOTS ?? path.join(import.meta.dirname, "screenshots");
const folder = temporary();
let browser;
let shown;
let beside;
let complaints;

before(async () => {
  mkdirSync(SCREENSHOTS, { recursive: true });
  browser = await launch();
  shown = await startShown(folder, { changes: { "camera.orthographic": true }, more: [`--steer=ipc://${folder}/commands`] });
  beside = await startDashboard(`ipc://${folder}/frames`, folder);
});

after(async () => {
  await browser?.close();
  for (const child of [shown?.child, beside?.child]) if (child) await stop(child);
});

async function open(address, options = {}) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 800 }, ...options });
  const page = await context.newPage();
  complaints = [];
  page.on("console", (message) => { if (["error", "warning"].includes(message.type()) && !/getImageData/.test(message.text())) complaints.push(message.text()); });
  page.on("pageerror", (error) => complaints.push(String(error)));
  await page.goto(address);
  await until("a picture", async () => /\d/.test(await page.textContent("#position")));
  return page;
}

const text = (page) => page.textContent("#overlay-text");

/** What is drawn at some pixels, and of which frame it is said to be; of one moment. */
const drawn = (page, pixels) => page.evaluate((at) => {
  const canvas = document.getElementById("overlay");
  const context = canvas.getContext("2d");
  return { text: document.getElementById("overlay-text").textContent, hidden: canvas.hidden, size: [canvas.width, canvas.height], colours: at.map(([x, y]) => [...context.getImageData(x, y, 1, 1).data]) };
}, pixels);

/** Text, plane and scale of the overlay, of one moment. */
const shownNow = (page) => page.evaluate(() => ({
  told: document.getElementById("overlay-text").textContent,
  hidden: document.getElementById("overlay").hidden || document.getElementById("overlay-scale").hidden,
  ticks: document.querySelectorAll("#overlay-scale .ticks span").length,
}));

/** The channel of these pixels of a frame, and null if the run keeps another frame by now. */
async function channels(name, frame, pixels) {
  const address = new URL(shown.url);
  address.pathname += "values";
  const values = [];
  for (const [x, y] of pixels) {
    for (const [key, value] of Object.entries({ x, y, frame })) address.searchParams.set(key, value);
    const answer = await fetch(address);
    if (!answer.ok) return null;
    values.push((await answer.json()).channels[name]);
  }
  return values;
}

// The range of the share traced is fixed; that of the error ends where it does, which the colours of two pixels tell.
const PIXELS = [[0, 0], [95, 0], [10, 7], [31, 40], [48, 24], [60, 11], [80, 30], [0, 47], [95, 47]];

test("the colours are those of the values, at their pixels", async () => {
  const page = await open(shown.url);
  await until("the controls", () => page.isVisible("#pause"));
  await page.click("#pause");
  await page.selectOption("#overlay-of", "traced");
  const compared = await until("a plane and its values", async () => {
    const { text: told, hidden, size, colours } = await drawn(page, PIXELS);
    const frame = /^Share of the queries that were traced, frame ([\d,]+)$/.exec(told)?.[1].replaceAll(",", "");
    if (hidden || frame === undefined) return false;
    assert.deepEqual(size, [96, 48]);
    const values = await channels("trust.traced", frame, PIXELS);
    const queries = values && (await channels("queries.count", frame, PIXELS));
    return queries && { values, queries, colours };
  }, 60_000);
  const { values, queries, colours } = compared;
  values.forEach((value, k) => {
    const wanted = queries[k] === 0 ? [0, 0, 0, 0] : [...viridis(value), 255];
    assert.ok(wanted.every((level, c) => Math.abs(level - colours[k][c]) <= 1), `${PIXELS[k]}: ${colours[k]}, not ${wanted}`);
  });
  await page.selectOption("#overlay-of", "error");
  const error = await until("the error and its values", async () => {
    const { text: told, hidden, colours: levels } = await drawn(page, PIXELS);
    const frame = /^Stated error of the linear colours, frame ([\d,]+)$/.exec(told)?.[1].replaceAll(",", "");
    const found = !hidden && frame !== undefined && (await channels("error", frame, PIXELS));
    return found && found.map((value, k) => ({ value, light: levels[k][0] + 2 * levels[k][1], alpha: levels[k][3] })).sort((a, b) => a.value - b.value);
  }, 60_000);
  assert.ok(error.every(({ alpha }) => alpha === 255) && error.at(-1).value > error[0].value);
  error.slice(1).forEach(({ value, light }, k) => assert.ok(light >= error[k].light - 3, `${value} is darker than ${error[k].value}`));
  await page.click("#pause");
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("the key goes through the layers, each said with its frame and scale, and follows the run", async () => {
  const page = await open(shown.url);
  for (const [of, words] of [
    ["error", /^Stated error of the linear colours, frame [\d,]+$/],
    ["traced", /^Share of the queries that were traced, frame [\d,]+$/],
    ["trusted", /^Share of the way in which the surrogate is trusted, frame [\d,]+$/],
    ["missing", /^Share of the rays that met missing data, frame [\d,]+: no data are missing$/],
    ["ftle", /^Mean FTLE of what is seen( \([^)]+\))?, frame [\d,]+$/],
  ]) {
    await page.keyboard.press("o");
    assert.equal(await page.inputValue("#overlay-of"), of);
    await until(`the words of ${of}`, async () => words.test(await text(page)));
    const first = await text(page);
    await until("a later frame", async () => (await text(page)) !== first && words.test(await text(page)));
    // Frames go on: text, plane and scale are looked at in one moment.
    await until(`the plane and scale of ${of}`, async () => {
      const { told, hidden, ticks } = await shownNow(page);
      return words.test(told) && !hidden && ticks >= 2;
    });
    // In one moment too: a longer sentence above moves both.
    const [frame, over] = await page.evaluate(() => ["frame", "overlay"].map((id) => document.getElementById(id).getBoundingClientRect().toJSON()));
    assert.deepEqual(over, frame);
  }
  await page.keyboard.press("o");
  await until("nothing is drawn", async () => !(await page.isVisible("#overlay")) && (await text(page)) === "");
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("of an earlier frame and of a method without an error the page says why there is none, and a page beside the run has them", async () => {
  const page = await open(shown.url);
  await until("the controls", () => page.isVisible("#pause"));
  await page.selectOption("#overlay-of", "error");
  await until("an error", async () => /^Stated error/.test(await text(page)));
  await page.selectOption("#method", "gated");
  await until("it is said", async () => (await text(page)) === "No overlay: gated states no error of a pixel; map, marched and two_level do");
  assert.ok(!(await page.isVisible("#overlay")) && !(await page.isVisible("#overlay-scale")));
  await page.selectOption("#method", "two_level");
  await until("an error again", async () => /^Stated error/.test(await text(page)));
  await until("earlier pictures", async () => Number(await page.getAttribute("#scrub", "max")) > 3);
  await page.keyboard.press("Home");
  await until("it is said", async () => (await text(page)) === "Overlays are of the newest frame: go back to live.");
  assert.ok(!(await page.isVisible("#overlay")));
  await page.keyboard.press("End");
  await until("an error again", async () => /^Stated error/.test(await text(page)));
  assert.deepEqual(complaints, []);
  await page.context().close();
  const other = await open(`http://127.0.0.1:${beside.port}/?token=${TOKEN}`);
  await other.keyboard.press("o");
  const frame = async () => Number(/^Stated error of the linear colours.*, frame ([\d,]+)$/.exec(await text(other))?.[1].replaceAll(",", ""));
  const first = await until("an error", frame);
  await until("that of a later frame", async () => (await frame()) > first);
  await other.selectOption("#overlay-of", "trusted");
  await until("trust", async () => /^Share of the way in which the surrogate is trusted/.test(await text(other)));
  assert.ok(await other.isVisible("#overlay"));
  assert.deepEqual(complaints, []);
  await other.context().close();
});

for (const [width, height] of [[1280, 800], [390, 844]]) {
  for (const colorScheme of ["light", "dark"]) {
    test(`an overlay is not cut off at ${width} x ${height}, ${colorScheme}`, async () => {
      const page = await open(shown.url, { viewport: { width, height }, colorScheme, isMobile: width < 500, hasTouch: width < 500 });
      await page.selectOption("#overlay-of", "error");
      await until("an error", async () => /^Stated error/.test(await text(page)));
      assert.ok((await page.evaluate(() => document.documentElement.scrollWidth)) <= width);
      await page.screenshot({ path: path.join(SCREENSHOTS, `overlay-${width}-${colorScheme}.png`), fullPage: width < 500 });
      assert.deepEqual(complaints, []);
      await page.context().close();
    });
  }
}
