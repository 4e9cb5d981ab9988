// The view of examples/widget.py, in Chromium with a model as a notebook gives it.
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import path from "node:path";
import { after, before, test } from "node:test";
import { REPOSITORY, launch, until } from "./kit.js";

const source = readFileSync(path.join(REPOSITORY, "examples/widget.js"), "utf8");
const record = {
  frame: 12, slide: 3, time: 0.6000000000000001, time_unit: "s", date: null, traced_share: 0.25, device: "cpu",
  picture_error: { rms: { value: 0.00912 }, psnr: { value: 40.83 } },
};
let browser;

before(async () => { browser = await launch(); });
after(() => browser?.close());

/** A page with the view, and its model as `window.model`. */
async function open() {
  const page = await browser.newPage();
  await page.setContent("<div id='cell'></div>");
  await page.evaluate(async ({ source, record }) => {
    const { default: widget } = await import(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
    const canvas = Object.assign(document.createElement("canvas"), { width: 32, height: 16 });
    canvas.getContext("2d").fillRect(0, 0, 16, 16);
    const png = await new Promise((resolve) => { canvas.toBlob(resolve); });
    const values = { picture: new DataView(await png.arrayBuffer()), encoding: "png", record, state: "" };
    const listeners = new Map();
    window.sent = [];
    window.listeners = listeners;
    window.model = {
      get: (name) => values[name],
      set: (changes) => { Object.assign(values, changes); for (const name of Object.keys(changes)) listeners.get(`change:${name}`)?.(); },
      on: (event, act) => listeners.set(event, act),
      off: (event) => listeners.delete(event),
      send: (message) => window.sent.push(message),
    };
    window.end = widget.render({ model: window.model, el: document.getElementById("cell") });
  }, { source, record });
  return page;
}

test("the picture is drawn and acknowledged, and its record told", async () => {
  const page = await open();
  await until("an answer", () => page.evaluate(() => window.sent.length === 1));
  assert.deepEqual(await page.evaluate(() => window.sent), [{ drawn: 12 }]);
  assert.deepEqual(await page.$eval("#cell img", ({ naturalWidth, naturalHeight }) => [naturalWidth, naturalHeight]), [32, 16]);
  assert.equal(await page.textContent("#cell div"), "frame 12, slide 3, t = 0.6 s; error 0.912 % rms, 40.8 dB; 25.0 % traced; cpu");
  await page.evaluate(() => window.model.set({ record: { frame: 13, slide: 3, time: 5, date: "2002-01-03", picture_error: null } }));
  assert.equal(await page.textContent("#cell div"), "frame 13, slide 3, 2002-01-03; no error stated; – traced; –");
  for (const [changes, told] of [
    [{ method: "two_level", surrogate: "table", traced: 2552 }, "drawn by a table and corrected with 2552 traced points"],
    [{ method: "marched", surrogate: "residual", traced: 2552 }, "drawn by a table with a network, uncorrected: 2552 traced points only measure its error"],
    [{ method: "map", picture_error: { ...record.picture_error, samples_per_pixel: 24 } }, "24 seeds a pixel"],
    [{ method: "gated", surrogate: "network", traced: 2552 }, "25.0 % traced"],
  ]) {
    await page.evaluate((set) => window.model.set({ record: set }), { ...record, ...changes });
    assert.equal(await page.textContent("#cell div"), `frame 12, slide 3, t = 0.6 s; error 0.912 % rms, 40.8 dB; ${told}; cpu`);
  }
  await page.evaluate(() => window.model.set({ state: "nothing new for 6 s" }));
  assert.match(await page.textContent("#cell"), /nothing new for 6 s/);
  await page.close();
});

test("a picture that cannot be drawn is told, and the next one still comes", async () => {
  const page = await open();
  await until("an answer", () => page.evaluate(() => window.sent.length === 1));
  await page.evaluate(() => window.model.set({ picture: new DataView(new Uint8Array([1, 2, 3]).buffer) }));
  await until("another answer", () => page.evaluate(() => window.sent.length === 2));
  assert.match(await page.textContent("#cell"), /The picture of frame 12 cannot be drawn/);
  await page.evaluate(() => window.end());
  assert.equal(await page.evaluate(() => window.listeners.size), 0);
  await page.close();
});
