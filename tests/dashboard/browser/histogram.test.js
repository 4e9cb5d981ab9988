// The histogram of the FTLE in Chromium: its handles set the range of colours of later records, by mouse, finger and keys.
import assert from "node:assert/strict";
import { mkdirSync, readFileSync } from "node:fs";
import path from "node:path";
import { after, before, test } from "node:test";
import { axisOf, moved } from "../../../src/dashboard/page/histogram.js";
import { TOKEN, apart, launch, shownPicture, startDashboard, startShown, stop, temporary, until } from "./kit.js";

const SCREENSHOTS = process.env.SCREENSHOTS ?? path.join(import.meta.dirname, "screenshots");
// trust.audit_min_per_cell in each of trust.cells.
const AUDITED = 8 * 16 ** 3;
const folder = temporary();
let browser;
let shown;
let beside;
let complaints;

before(async () => {
  mkdirSync(SCREENSHOTS, { recursive: true });
  browser = await launch();
  // One slide.
  const changes = { "time.frames_per_slide": 100_000, "time.warmup_frames": 0, "surrogate.table_nodes": "[17, 17, 17]", "flow.steps": 20 };
  shown = await startShown(folder, { scene: "configs/abc.toml", changes, more: [`--steer=ipc://${folder}/commands`] });
  beside = await startDashboard(`ipc://${folder}/frames`, folder, 0, TOKEN, [`--steer=${folder}/commands.connection`]);
});

after(async () => {
  await browser?.close();
  for (const child of [shown?.child, beside?.child]) if (child) await stop(child);
});

const records = () => readFileSync(path.join(folder, "run/records.jsonl"), "utf8").split("\n").slice(0, -1).map((line) => JSON.parse(line));

async function open(address, options = {}) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 1000 }, ...options });
  const page = await context.newPage();
  complaints = [];
  page.on("console", (message) => { if (["error", "warning"].includes(message.type())) complaints.push(message.text()); });
  page.on("pageerror", (error) => complaints.push(String(error)));
  await page.goto(address);
  await until("the controls", () => page.isVisible("#pause"));
  return page;
}

async function opened(options) {
  const page = await open(shown.url, options);
  await until("a histogram", () => page.isVisible("#histogram-plot"));
  await page.locator("#histogram").scrollIntoViewIfNeeded();
  return page;
}

const value = async (page, end) => Number(await page.getAttribute(`#handle-${end}`, "aria-valuenow"));
const middle = async (page, end) => {
  const box = await page.locator(`#handle-${end}`).boundingBox();
  return [box.x + box.width / 2, box.y + box.height / 2];
};

/** The first record from `frame` on whose range ends there. */
const shownBy = (frame, range) => until(`a record of ${JSON.stringify(range)}`, () => records().find(({ frame: number, transfer }) => number > frame && transfer.low === range.low && transfer.high === range.high), 60_000);

const range = async (page) => ({ low: await value(page, "low"), high: await value(page, "high") });

test("an axis has the values and the ramp, and its ends stay apart", () => {
  const at = axisOf([0, 1], { low: 0.5, high: 2 });
  assert.ok(Math.abs(at.low + 0.16) < 1e-12 && Math.abs(at.high - 2.16) < 1e-12);
  assert.ok(axisOf(null, { low: 1, high: 2 }).low < 1);
  const axis = { low: 0, high: 1 };
  assert.deepEqual(moved({ low: 0.2, high: 0.8 }, "high", 0.61234567, axis), { low: 0.2, high: 0.612 });
  assert.deepEqual(moved({ low: 0.2, high: 0.8 }, "high", 0.1, axis), { low: 0.2, high: 0.204 });
  assert.deepEqual(moved({ low: 0.2, high: 0.8 }, "low", 9, axis), { low: 0.796, high: 0.8 });
  assert.deepEqual(moved({ low: 0.2, high: 0.8 }, "high", 9, axis), { low: 0.2, high: 1 });
  // Of ocean currents in 1/s.
  assert.deepEqual(moved({ low: 2e-7, high: 8e-7 }, "high", 6.1234567e-7, { low: 0, high: 1e-6 }), { low: 2e-7, high: 6.12e-7 });
});

test("a handle that is dragged changes the range of a later record and its picture, and traces no slide anew", async () => {
  const page = await opened();
  // Two pictures of the same colours, which only noise tells apart.
  const first = await shownPicture(page);
  const before = await until("a later picture", async () => { const picture = await shownPicture(page); return picture.frame > first.frame + 3 && picture; });
  const { frame, transfer } = records().at(-1);
  const [x, y] = await middle(page, "high");
  const plot = await page.locator("#histogram-plot").boundingBox();
  await page.mouse.move(x, y);
  await page.mouse.down();
  await page.mouse.move(x - 0.25 * plot.width, y, { steps: 5 });
  const axis = { low: Number(await page.getAttribute("#handle-low", "aria-valuemin")), high: Number(await page.getAttribute("#handle-high", "aria-valuemax")) };
  await page.mouse.up();
  const chosen = await range(page);
  assert.ok(chosen.low === transfer.low && Math.abs(chosen.high - (transfer.high - 0.25 * (axis.high - axis.low))) < 0.01 * (axis.high - axis.low), JSON.stringify({ chosen, transfer, axis }));
  const record = await shownBy(frame, chosen);
  const later = records().filter(({ frame: number }) => number > frame && number <= record.frame);
  assert.ok(later.some(({ commands }) => commands.some(({ set }) => set.transfer?.high === chosen.high)));
  const after = await until("its picture", async () => { const picture = await shownPicture(page); return picture.frame >= record.frame && picture; });
  const [noise, change] = [apart(first, before), apart(before, after)];
  assert.ok(change > 3 * noise && change > 0.5, `levels change by ${change}, with the same colours by ${noise}`);
  // The slide is not prepared anew, and trust begins anew: a frame of other colours traces 8 audit points in each of the 16^3 cells, as any frame, and none
  // that a trusted cell gets besides.
  assert.ok(later.every(({ slide, preparation_traces: traced }) => slide === 0 && traced === 0), JSON.stringify(later));
  const audited = later.filter(({ commands }) => commands.some(({ set }) => set.transfer)).map((record) => record.audited);
  assert.deepEqual([...new Set(audited)], [AUDITED]);
  assert.ok(records()[0].preparation_traces > 0);
  await until("the field shows it", async () => Number(await page.inputValue("#high")) === Number(chosen.high.toPrecision(6)));
  await page.screenshot({ path: path.join(SCREENSHOTS, "histogram.png") });
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("keys move a handle, and do not turn over pictures", async () => {
  const page = await opened();
  for (const [end, key, sign] of [["low", "ArrowRight", 1], ["high", "ArrowRight", 1], ["high", "PageDown", -1], ["low", "Shift+ArrowLeft", -1]]) {
    const [{ frame }, before] = [records().at(-1), await range(page)];
    await page.focus(`#handle-${end}`);
    await page.keyboard.press(key);
    const chosen = await range(page);
    assert.equal(Math.sign(chosen[end] - before[end]), sign, `${end} ${key}`);
    await shownBy(frame, chosen);
  }
  assert.equal(await page.getAttribute("#live", "aria-pressed"), "true");
  for (const [end, name] of [["low", "FTLE at which colours begin"], ["high", "FTLE from which colours are full"]]) {
    assert.ok(await page.getByRole("slider", { name, exact: true }).evaluate((node, id) => node.id === id, `handle-${end}`));
    assert.match(await page.getAttribute(`#handle-${end}`, "aria-valuetext"), /^FTLE [\d.]+/);
  }
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("a picture that shows nothing is told, and the colours come back", async () => {
  const page = await opened();
  const { transfer } = records().at(-1);
  const set = async (id, number) => {
    await page.fill(`#${id}`, String(number));
    await page.press(`#${id}`, "Enter");
  };
  // Above all values. The page is drawn anew meanwhile, and an end that waits for its frame is not given up.
  await set("high", 2e6);
  // A field that has the focus keeps its text anyway.
  await page.locator("#high").blur();
  await page.waitForTimeout(600);
  assert.equal(Number(await page.inputValue("#high")), 2e6);
  await set("low", 1e6);
  await until("it is told", async () => /shows nothing: its FTLE is below the range of colours/.test(await page.textContent("#histogram-text")), 60_000);
  assert.ok(await page.isVisible("#handle-low"));
  // Downwards the lower end goes first.
  await set("low", transfer.low);
  await set("high", transfer.high);
  await until("it counts again", async () => /shows, by pixels/.test(await page.textContent("#histogram-text")), 60_000);
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("a finger drags a handle", async () => {
  const page = await opened({ hasTouch: true });
  const touch = await page.context().newCDPSession(page);
  const send = (type, points) => touch.send("Input.dispatchTouchEvent", { type, touchPoints: points.map(([x, y]) => ({ x, y, id: 1 })) });
  const [{ frame }, before] = [records().at(-1), await range(page)];
  const [x, y] = await middle(page, "high");
  await send("touchStart", [[x, y]]);
  for (const by of [5, 20, 40]) await send("touchMove", [[x - by, y]]);
  await send("touchEnd", []);
  await until("it has moved", async () => (await value(page, "high")) < before.high);
  await shownBy(frame, await range(page));
  assert.deepEqual(complaints, []);
  await page.context().close();
});

test("beside a run there is the histogram of its layers", async () => {
  const page = await open(`http://127.0.0.1:${beside.port}/?token=${TOKEN}`);
  await until("it is said", async () => /^FTLE that frame [\d,]+ shows/.test(await page.textContent("#histogram-text")));
  assert.ok(await page.isVisible("#histogram-plot"));
  assert.deepEqual(complaints, []);
  await page.context().close();
});

for (const [width, height] of [[1280, 1000], [390, 844]]) {
  for (const colorScheme of ["light", "dark"]) {
    test(`the histogram is not cut off at ${width} x ${height}, ${colorScheme}`, async () => {
      const page = await opened({ viewport: { width, height }, colorScheme, isMobile: width < 500, hasTouch: width < 500 });
      assert.ok((await page.evaluate(() => document.documentElement.scrollWidth)) <= width);
      await page.screenshot({ path: path.join(SCREENSHOTS, `histogram-${width}-${colorScheme}.png`) });
      assert.deepEqual(complaints, []);
      await page.context().close();
    });
  }
}
