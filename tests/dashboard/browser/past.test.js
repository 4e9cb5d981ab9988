// Looking back in Chromium further than the page was open: to pictures that the run keeps, and records over all of it.
import assert from "node:assert/strict";
import { readFileSync, readdirSync, rmSync } from "node:fs";
import path from "node:path";
import { after, before, test } from "node:test";
import { TOKEN, launch, shownPicture, startDashboard, startShown, stop, temporary, until } from "./kit.js";

const folder = temporary();
const frames = path.join(folder, "run/frames");
let browser;
let shown;
let beside;
let complaints;

before(async () => {
  browser = await launch();
  shown = await startShown(folder, { changes: { "publish.preview": true } });
  beside = await startDashboard(`ipc://${folder}/frames`, folder, 0, TOKEN, ["--run", path.join(folder, "run")]);
  await until("a past", () => readdirSync(frames).length > 20);
});

after(async () => {
  await browser?.close();
  for (const child of [shown?.child, beside?.child]) if (child) await stop(child);
});

async function open(address) {
  const page = await (await browser.newContext({ viewport: { width: 1280, height: 800 } })).newPage();
  complaints = [];
  page.on("console", (message) => { if (["error", "warning"].includes(message.type()) && !/getImageData|status of 410/.test(message.text())) complaints.push(message.text()); });
  page.on("pageerror", (error) => complaints.push(String(error)));
  await page.goto(address);
  await until("a picture", async () => /\d/.test(await page.textContent("#position")));
  return page;
}

const file = (frame) => path.join(frames, `frame_${String(frame).padStart(6, "0")}.png`);

/** Pixels of a PNG. */
const decoded = (page, bytes) => page.evaluate(async (base64) => {
  const bitmap = await createImageBitmap(new Blob([Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0))]));
  const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
  context.drawImage(bitmap, 0, 0);
  return [...context.getImageData(0, 0, bitmap.width, bitmap.height).data];
}, bytes.toString("base64"));

for (const [name, address, gone] of [["the run's own page", () => shown.url, 3], ["a page beside it", () => `http://127.0.0.1:${beside.port}/?token=${TOKEN}`, 4]]) {
  test(`${name}, opened late, looks back to the first frames`, async () => {
    const page = await open(address());
    const first = (await shownPicture(page)).frame;
    assert.ok(first > 10, `opened at frame ${first}`);
    await until("what the run keeps", async () => Number(await page.getAttribute("#scrub", "max")) > 10);
    await page.locator("#scrub").focus();
    await page.keyboard.press("Home");
    await until("the first frame", async () => (await shownPicture(page)).frame === 0);
    await page.keyboard.press("ArrowRight");
    // The slider is there before the picture, which is fetched; the sentence comes with the picture.
    await until("the next", async () => /newest: frame 1\b/.test(await page.textContent("#state")));
    assert.equal((await shownPicture(page)).frame, 1);
    assert.deepEqual((await shownPicture(page)).data, await decoded(page, readFileSync(file(1))));
    // One that the run has deleted since.
    rmSync(file(gone));
    await page.keyboard.press("ArrowRight");
    await until("the next", async () => /newest: frame 2\b/.test(await page.textContent("#state")));
    await page.keyboard.press("ArrowRight");
    await until("it is said", async () => (await page.textContent("#warnings")).includes(`The picture of frame ${gone} cannot be shown: the run has no picture of frame ${gone} any more`));
    assert.equal((await shownPicture(page)).frame, 2);
    await page.keyboard.press("End");
    await until("the newest", async () => (await shownPicture(page)).frame > first);
    assert.deepEqual(complaints, []);
    await page.context().close();
  });
}
