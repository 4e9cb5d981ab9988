// The page in Chromium, against the real programs and through a proxy with a path prefix.
import assert from "node:assert/strict";
import { mkdirSync } from "node:fs";
import path from "node:path";
import { after, afterEach, before, beforeEach, test } from "node:test";
import { WebSocket } from "ws";
import { MESSAGE_LIMIT, PREFIX, Proxy, TOKEN, compose, launch, parse, startDashboard, startPublisher, stop, temporary, until } from "./kit.js";

const SCREENSHOTS = process.env.SCREENSHOTS ?? path.join(import.meta.dirname, "screenshots");

const folder = temporary();
const endpoint = `ipc://${folder}/frames`;
const proxy = new Proxy(PREFIX);
let browser;
let dashboard;
let publisher;
let page;
let complaints;

before(async () => {
  mkdirSync(SCREENSHOTS, { recursive: true });
  browser = await launch();
  dashboard = await startDashboard(endpoint, folder);
  publisher = startPublisher(endpoint, folder);
  await proxy.listen();
  proxy.target = dashboard.port;
});

after(async () => {
  await browser?.close();
  proxy.close();
  for (const child of [publisher, dashboard?.child]) if (child) await stop(child);
});

beforeEach(async () => { page = await open(); });
afterEach(async () => {
  proxy.change = null;
  await page.context().close();
});

// Reading the canvas back is what the tests do, not the page.
const isComplaint = (message) => ["error", "warning"].includes(message.type()) && !message.text().includes("getImageData");

async function open(options = {}) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 800 }, ...options });
  const opened = await context.newPage();
  complaints = [];
  opened.on("console", (message) => { if (isComplaint(message)) complaints.push(message.text()); });
  opened.on("pageerror", (error) => complaints.push(String(error)));
  await opened.goto(proxy.address());
  return opened;
}

const state = () => page.textContent("#state");
const warning = () => page.textContent("#warnings");
const position = async () => Number((await page.textContent("#position")).replace(/\D/g, ""));
const following = () => until("frames are followed", async () => /^Following, frame \d/.test(await state()) && (await position()) >= 0);
const advance = async (beyond) => until(`a frame after ${beyond}`, async () => (await position()) > beyond);

/** A number that differs between pictures. */
const pixels = () => page.$eval("#frame", (canvas) => {
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return data.reduce((sum, value, index) => (sum + value * (index % 8191)) % 1e9, 0);
});

test("the page follows the run", async () => {
  await following();
  const [first, picture] = [await position(), await pixels()];
  await advance(first + 3);
  assert.notEqual(await pixels(), picture);
  assert.match(await state(), /^Following, frame [\d,]+, slide [\d,]+, t = [\d.]+, error [\d.]+ % \([\d.]+ dB\), drawn by a table and corrected with [\d,]+ traced points\.$/);
  assert.equal(await page.textContent("#source"), "closed form: double_gyre");
  assert.equal(await warning(), "");
  assert.deepEqual(complaints, []);
});

test("the address does not keep the token, and a reload works", async () => {
  await following();
  assert.equal(page.url(), `${proxy.origin}${PREFIX}`);
  await page.reload();
  await following();
  assert.deepEqual(await page.context().cookies(), []);
  const other = await page.context().newPage();
  await other.goto(page.url());
  await until("another tab needs the token", async () => /^Not admitted/.test(await other.textContent("#state")));
  await other.close();
});

test("colour bar, facts and charts fill", async () => {
  await following();
  await advance((await position()) + 3);
  assert.ok(await page.isVisible("#scale"));
  assert.ok((await page.locator("#scale-ticks span").count()) >= 3);
  const facts = await page.$$eval("[data-fact]", (nodes) => Object.fromEntries(nodes.map((node) => [node.dataset.fact, node.textContent])));
  assert.deepEqual(Object.keys(facts).filter((key) => facts[key] === "–"), ["step"]);
  const charts = page.locator(".chart:not([hidden])");
  // The share traced of `two_level` is constant, and has none.
  const titles = ["Error of the picture (PSNR, higher is better) in dB", "Error of the surrogate, and tolerance", "Frame time by stage in s"];
  assert.deepEqual(await charts.locator("figcaption").allTextContents(), titles);
  for (const values of await charts.evaluateAll((nodes) => nodes.map((node) => node.querySelector(".u-legend").textContent))) {
    assert.match(values, /^frame\d+.*\d (%|s|dB)/);
  }
  const painted = await page.$$eval(".chart:not([hidden]) canvas", (nodes) => nodes.map((canvas) => canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.some((value) => value > 0)));
  assert.ok(painted.every(Boolean));
});

test("the cursor of the charts is shared", async () => {
  await following();
  await advance((await position()) + 5);
  const box = await page.locator(".chart .u-over").first().boundingBox();
  await page.mouse.move(box.x + 2, box.y + box.height / 2);
  const frames = await page.$$eval(".chart:not([hidden]) .u-legend .u-series:first-child .u-value", (nodes) => nodes.map((node) => node.textContent));
  assert.equal(new Set(frames).size, 1);
  assert.ok(Number(frames[0]) < (await position()));
});

test("looking back holds, frames go on being acknowledged, and live returns", async () => {
  await following();
  await advance((await position()) + 3);
  await page.keyboard.press("Space");
  const held = await position();
  const picture = await pixels();
  const kept = Number(await page.getAttribute("#scrub", "max"));
  await until("more pictures are kept", async () => Number(await page.getAttribute("#scrub", "max")) > kept + 3);
  assert.deepEqual([await position(), await pixels()], [held, picture]);
  await until("it is said", async () => /^Looking back, \d+ frames before the newest/.test(await state()));
  await page.keyboard.press("ArrowLeft");
  await until("an earlier picture", async () => (await position()) < held);
  await page.keyboard.press("ArrowRight");
  await until("the held picture again", async () => (await position()) === held);
  await page.keyboard.press("Home");
  await until("the oldest picture", async () => (await page.inputValue("#scrub")) === "0");
  await page.locator("#scrub").fill("2");
  await until("the third picture", async () => (await page.inputValue("#scrub")) === "2");
  await page.keyboard.press("Tab");
  await page.click("#live");
  await advance(held + 3);
  assert.match(await state(), /^(Following|Looking)/);
  await following();
  assert.deepEqual(complaints, []);
});

test("a click in a chart shows the picture of that frame", async () => {
  await following();
  await advance((await position()) + 5);
  const box = await page.locator(".chart .u-over").first().boundingBox();
  await page.mouse.click(box.x + 3, box.y + 20);
  await until("it looks back", async () => /^Looking back/.test(await state()));
  assert.equal(await page.inputValue("#scrub"), "0");
});

test("a picture that cannot be decoded is skipped, and said", async () => {
  await following();
  let broken = 0;
  proxy.change = (data) => {
    const { json, payload } = parse(data);
    if (json.kind !== "frame" || broken > 0) return data;
    broken += 1;
    return compose(json, payload.subarray(0, 20));
  };
  await until("it is said", async () => /The picture of frame [\d,]+ was skipped/.test(await warning()));
  await advance((await position()) + 2);
  assert.deepEqual(complaints, []);
});

test("unknown fields and null values are shown as unknown", async () => {
  proxy.change = (data) => {
    const { json, payload } = parse(data);
    const strip = (record) => Object.assign(record, { picture_error: null, trusted_error: null, traced_share: null, traced: null, device: null, novelty: [{}] });
    if (json.kind === "frame") strip(json.header.record);
    if (json.kind === "frame") delete json.header.color_bar;
    if (json.kind === "records") json.records.forEach(strip);
    return compose(json, payload);
  };
  await page.reload();
  await following();
  assert.match(await state(), /error unknown, drawn by a table and corrected with traced points\.$/);
  assert.equal(await page.textContent('[data-fact="device"]'), "–");
  assert.ok(await page.isVisible("#scale-note"));
  assert.deepEqual(complaints, []);
});

/** Changes the records that the page gets from now on. */
function changeRecords(changes) {
  proxy.change = (data) => {
    const { json, payload } = parse(data);
    if (json.kind === "records") json.records.forEach((record) => Object.assign(record, changes));
    return compose(json, payload);
  };
}

test("what is over the tolerance cannot be overlooked", async () => {
  await following();
  changeRecords({ tolerance_excess: 0.0123, warnings: ["snapshot repeats time 3"] });
  await until("it is said", async () => /Error of the colours \(optical residual\) above the tolerance by 0.0123/.test(await warning()));
  assert.ok(await page.isVisible("#warnings .critical"));
  await page.click("#messages summary");
  await until("the messages are counted", async () => /snapshot repeats time 3( \(\d+ times\))?/.test(await page.textContent("#log")));
  await page.screenshot({ path: path.join(SCREENSHOTS, "tolerance.png") });
});

test("terms are explained in warnings and messages, in which foreign text stays text", async () => {
  await following();
  const text = 'slide 3: <img src="none"> the log-stretch (FTLE times tau) differs, see `trust.tolerance`';
  changeRecords({ tolerance_excess: 0.0123, warnings: [text] });
  await until("it is said", async () => (await warning()).includes(text));
  const terms = (list) => page.$$eval(`${list} .term`, (nodes) => nodes.map(({ dataset, textContent }) => `${dataset.term}: ${textContent}`));
  for (const list of ["#warning-run", "#log li:first-child"]) {
    await until(`the terms of ${list}`, async () => String(await terms(list)) === "slide: slide,stretch: log-stretch,ftle: FTLE,tau: tau");
  }
  assert.deepEqual(await terms("#warning-tolerance"), ["optical: optical residual", "tolerance: tolerance"]);
  assert.equal(await page.locator("#warnings img, #log img").count(), 0);
  await page.hover('#warning-tolerance [data-term="optical"]');
  assert.match(await page.textContent("#tip"), /^Optical residual: /);
  assert.ok(await page.isVisible("#tip"));
  await page.click("#messages summary");
  await page.focus('#log [data-term="stretch"]');
  assert.match(await page.textContent("#tip"), /^Log-stretch: /);
  assert.deepEqual(complaints, []);
});

test("the error of the surrogate is drawn against the tolerance where nothing is trusted, which is warned of", async () => {
  await following();
  const legend = () => page.$$eval(".chart:not([hidden])", (nodes) => nodes.find((node) => node.textContent.startsWith("Error of the surrogate")).querySelector(".u-legend").textContent);
  changeRecords({ method: "gated", picture_error: null, trusted_error: null, tolerance: 0.03, over_budget: 40, tolerance_excess: 0.0123, traced_share: 0.5 });
  await until("both", async () => /error, rms:?4\.2 %95 % from:?–to:?–tolerance:?3 %$/.test(await legend()));
  await until("it is said", async () => /The surrogate is trusted nowhere yet/.test(await page.textContent("#warning-untrusted")));
  assert.match(await state(), /error where the surrogate answered 4\.2 %, of the picture unknown, 50 % traced\.$/);
  await until("the share traced", async () => (await page.locator(".chart:not([hidden]) figcaption").allTextContents()).includes("Share traced"));
  proxy.change = null;
  await until("it is over", async () => (await page.locator("#warning-untrusted").count()) === 0);
});

test("themes switch and are remembered, terms are explained, and help opens", async () => {
  await following();
  const ground = () => page.evaluate(() => getComputedStyle(document.body).backgroundColor);
  const light = await ground();
  await page.keyboard.press("t");
  assert.notEqual(await ground(), light);
  await page.reload();
  assert.notEqual(await ground(), light);
  await page.hover('#facts [data-term="tau"]');
  assert.match(await page.textContent("#tip"), /^tau: /);
  await page.keyboard.press("?");
  assert.ok(await page.isVisible("#help"));
  await page.screenshot({ path: path.join(SCREENSHOTS, "help.png") });
  await page.click("#help form button");
  assert.ok(!(await page.isVisible("#help")));
  await page.keyboard.press("f");
  await until("full screen", () => page.evaluate(() => document.fullscreenElement?.id === "picture"));
  assert.deepEqual(complaints, []);
});

for (const [width, height] of [[1280, 800], [3840, 2160], [390, 844]]) {
  for (const colorScheme of ["light", "dark"]) {
    test(`nothing is cut off at ${width} x ${height}, ${colorScheme}`, async () => {
      await page.context().close();
      page = await open({ viewport: { width, height }, colorScheme, isMobile: width < 500, hasTouch: width < 500 });
      await following();
      await advance((await position()) + 3);
      assert.ok((await page.evaluate(() => document.documentElement.scrollWidth)) <= width);
      const [frame, size] = [await page.locator("#frame").boundingBox(), await page.$eval("#frame", ({ width, height }) => width / height)];
      assert.ok(Math.abs(frame.width / frame.height - size) < 0.05 || frame.height <= 0.73 * height);
      if (width > 3000) {
        const bottom = async (selector) => { const { y, height: tall } = await page.locator(selector).boundingBox(); return y + tall; };
        const ends = [await bottom("#picture"), Math.max(await bottom("#charts"), await bottom("#facts"))];
        assert.ok(Math.abs(ends[0] - ends[1]) < 0.15 * height, `the columns end at ${ends}`);
      }
      await page.screenshot({ path: path.join(SCREENSHOTS, `${width}-${colorScheme}.png`), fullPage: width < 500 });
      assert.deepEqual(complaints, []);
    });
  }
}

test("a wrong token and a missing one are refused", async () => {
  const context = await browser.newContext();
  const stranger = await context.newPage();
  assert.equal((await stranger.goto(proxy.address("wrong"))).status(), 403);
  assert.equal((await stranger.goto(`${proxy.origin}${PREFIX}`)).status(), 200);
  await until("the page without a token says so", async () => /^Not admitted/.test(await stranger.textContent("#state")));
  await context.close();
  for (const query of ["?token=wrong", ""]) {
    const socket = new WebSocket(`ws://127.0.0.1:${dashboard.port}${PREFIX}socket${query}`);
    const status = await new Promise((resolve) => {
      socket.on("unexpected-response", (_, answer) => resolve(answer.statusCode));
      socket.on("open", () => resolve("open"));
      socket.on("error", () => {});
    });
    socket.terminate();
    assert.equal(status, 403);
  }
});

test("a publisher that is killed is noticed within 5 s, and its successor followed", async () => {
  await following();
  await advance((await position()) + 3);
  await stop(publisher, "SIGKILL");
  const killed = Date.now();
  await until("the silence is said", async () => /^Silent for/.test(await state()), 5_000);
  assert.ok(Date.now() - killed < 5_000);
  assert.match(await warning(), /Nothing new arrives/);
  assert.ok(await page.isVisible("#age"));
  const age = await page.textContent("#age");
  await until("the age counts", async () => (await page.textContent("#age")) !== age);
  await page.screenshot({ path: path.join(SCREENSHOTS, "silent.png") });
  publisher = startPublisher(endpoint, folder);
  await following();
  assert.ok(!(await page.isVisible("#age")));
  await until("the new run is told", async () => /A new run began/.test(await page.textContent("#log")));
  assert.deepEqual(complaints, []);
});

test("a connection that drops comes back, and nothing is told twice", async () => {
  await following();
  const [before, told] = [await position(), await page.textContent("#log")];
  for (const upstream of proxy.upstreams) upstream.terminate();
  await until("the loss is said", async () => /^Not connected/.test(await state()));
  await following();
  await advance(before + 3);
  assert.equal(await page.textContent("#log"), told);
  await advance((await position()) + 2);
  const frames = await page.textContent(".chart .u-legend .u-series:first-child .u-value");
  assert.ok(Number(frames) > before);
});

test("a connection that is open in name only is noticed", async () => {
  await following();
  proxy.mute = true;
  await until("the loss is said", async () => /^Not connected/.test(await state()), 15_000);
  proxy.mute = false;
  await following();
});

test("a page that had to make room says so and does not come back by itself", async () => {
  await following();
  for (const client of proxy.sockets.clients) client.close(4001);
  await until("it is said", async () => /Too many pages are open/.test(await warning()));
  await page.waitForTimeout(2_000);
  assert.match(await state(), /^Not connected/);
  assert.equal(proxy.sockets.clients.size, 0);
});

test("a server that is killed is noticed, and its successor followed", async () => {
  await following();
  await stop(dashboard.child, "SIGKILL");
  await until("the loss is said", async () => /Connection to the dashboard's server lost/.test(await warning()), 5_000);
  assert.match(await state(), /^Not connected; last seen: frame/);
  await page.screenshot({ path: path.join(SCREENSHOTS, "lost.png") });
  dashboard = await startDashboard(endpoint, folder, dashboard.port);
  await following();
  await advance((await position()) + 2);
  assert.equal(await page.locator("#warning-link").count(), 0);
});

test("a page whose token is no longer valid is told so", async () => {
  await following();
  const { port } = dashboard;
  await stop(dashboard.child);
  dashboard = await startDashboard(endpoint, folder, port, "another-token-of-the-tests-0123456789");
  await until("it is said", async () => /Not admitted/.test(await warning()));
  await stop(dashboard.child);
  dashboard = await startDashboard(endpoint, folder, port);
  await following();
});

test("messages stay within the limit of proxies", () => {
  assert.ok(proxy.longest > 1000 && proxy.longest < MESSAGE_LIMIT, String(proxy.longest));
});
