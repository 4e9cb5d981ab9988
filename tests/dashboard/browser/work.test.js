// Work that takes long, in Chromium: the sentence of state says what the run is at.
import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { launch, startShown, stop, temporary, until } from "./kit.js";

const folder = temporary();
let browser;
let shown;

before(async () => {
  browser = await launch();
  shown = await startShown(folder, { changes: { "render.method": '"reference"', "render.samples": 20000, "render.budget": null } });
});

after(async () => {
  await browser?.close();
  // A signal to stop waits for the frame.
  if (shown) await stop(shown.child, "SIGKILL");
});

test("before the first frame the page says how far it is and how long it takes", async () => {
  const page = await (await browser.newContext()).newPage();
  await page.goto(shown.url);
  const said = /^Waiting for the first frame from ipc:\/\/.*; now rendering the frame: (\d+) %, about \d+ (s|min) left\.$/;
  const share = async () => Number(said.exec(await page.textContent("#state"))?.[1]);
  await until("it is said", async () => (await share()) >= 0);
  const first = await share();
  await until("it advances", async () => (await share()) > first);
});
