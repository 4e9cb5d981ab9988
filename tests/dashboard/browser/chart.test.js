// The chart of a scene in Chromium: it is there once it exists, and is fetched once it is opened.
import assert from "node:assert/strict";
import { copyFileSync, writeFileSync } from "node:fs";
import path from "node:path";
import { after, before, test } from "node:test";
import { REPOSITORY, launch, startShown, stop, temporary, until } from "./kit.js";

const SVG = '<svg xmlns="http://www.w3.org/2000/svg" width="40" height="20"><rect width="40" height="20" fill="#fff"/></svg>';
const folder = temporary();
let browser;
let complaints;

before(async () => { browser = await launch(); });
after(async () => { await browser?.close(); });

async function open(address, colorScheme) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 800 }, colorScheme });
  const page = await context.newPage();
  complaints = [];
  page.on("console", (message) => { if (["error", "warning"].includes(message.type())) complaints.push(message.text()); });
  page.on("pageerror", (error) => complaints.push(String(error)));
  await page.goto(address);
  await until("a picture", async () => /\d/.test(await page.textContent("#position")));
  return page;
}

test("a scene with a chart shows it, and one without does not", async () => {
  const scene = path.join(folder, "gyre.toml");
  copyFileSync(path.join(REPOSITORY, "configs/double_gyre.toml"), scene);
  const bare = await startShown(folder, { scene });
  const without = await open(bare.url, "light");
  await until("a state", async () => /at ipc/.test(await without.textContent("#about")));
  assert.ok(!(await without.isVisible("#accuracy")));
  assert.deepEqual(complaints, []);
  await without.context().close();
  await stop(bare.child);

  writeFileSync(path.join(folder, "gyre.chart.svg"), SVG);
  const charted = await startShown(folder, { scene });
  const page = await open(charted.url, "dark");
  await until("the chart", () => page.isVisible("#accuracy summary"));
  const width = () => page.evaluate(() => document.querySelector("#accuracy img").naturalWidth);
  assert.equal(await width(), 0, "not fetched yet");
  await page.click("#accuracy summary");
  await until("its picture", async () => (await width()) === 40);
  assert.deepEqual(complaints, []);
  await page.context().close();
  await stop(charted.child);
});
