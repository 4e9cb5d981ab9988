// Steering from the page in Chromium: what is done there is in the records of the run, and who only watches is refused by the server.
import assert from "node:assert/strict";
import { mkdirSync, readFileSync } from "node:fs";
import path from "node:path";
import { after, before, beforeEach, test } from "node:test";
import { WebSocket } from "ws";
import { TOKEN, apart, launch, parse, shownPicture, startDashboard, startProxy, startPublisher, stop, temporary, until } from "./kit.js";

const SCREENSHOTS = process.env.SCREENSHOTS ?? path.join(import.meta.dirname, "screenshots");
// Of a box, and of a map.
const box = { "time.frames_per_slide": 100_000, "time.warmup_frames": 0, "surrogate.table_nodes": "[17, 17, 17]", "flow.steps": 20 };
const map = { "camera.orthographic": true };
const scenes = { box: { scene: "configs/abc.toml", changes: box }, map: { scene: "configs/double_gyre.toml", changes: map } };
// trust.audit_min_per_cell in each of trust.cells.
const AUDITED = 8 * 16 ** 3;
const stages = {};
let browser;

async function stage(name, options) {
  const folder = temporary();
  const [endpoint, commands] = [`ipc://${folder}/frames`, `${folder}/commands`];
  const publisher = startPublisher(endpoint, folder, { ...options, more: [`--steer=ipc://${commands}`] });
  const dashboard = await startDashboard(endpoint, folder, 0, TOKEN, [`--steer=${commands}.connection`]);
  const proxy = await startProxy(dashboard.child, dashboard.port);
  const records = () => readFileSync(path.join(folder, "run/records.jsonl"), "utf8").split("\n").slice(0, -1).map((line) => JSON.parse(line));
  stages[name] = { folder, endpoint, publisher, dashboard, records, address: (token) => proxy.address(token) };
}

before(async () => {
  mkdirSync(SCREENSHOTS, { recursive: true });
  browser = await launch();
  for (const [name, options] of Object.entries(scenes)) await stage(name, options);
});

after(async () => {
  await browser?.close();
  for (const { publisher, dashboard } of Object.values(stages)) for (const child of [publisher, dashboard?.child]) if (child) await stop(child);
});

let complaints;
beforeEach(() => { complaints = []; });

async function open(address) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 800 }, hasTouch: true, permissions: ["clipboard-read", "clipboard-write"] });
  const page = await context.newPage();
  page.on("console", (message) => { if (["error", "warning"].includes(message.type())) complaints.push(message.text()); });
  page.on("pageerror", (error) => complaints.push(String(error)));
  await page.goto(address);
  await until("a picture", async () => /\d/.test(await page.textContent("#position")));
  return page;
}

async function steered(name, work) {
  const page = await open(stages[name].address(TOKEN));
  await until("the controls", () => page.isVisible("#pause"));
  await work(page, stages[name]);
  assert.deepEqual(complaints, []);
  await page.context().close();
}

const newest = ({ records }) => records().at(-1);
const camera = (where) => newest(where).camera;
const away = ({ eye, look_at: at }) => eye.map((value, k) => value - at[k]);
const close = (a, b) => a.every((value, k) => Math.abs(value - b[k]) <= 1e-9 * (1 + Math.abs(b[k])));

/** The first record with a command of these keys after `frame`. */
const commanded = (where, frame, keys) => until(`a record with ${keys}`, () => where.records().find((record) => record.frame > frame && record.commands.some(({ set }) => String(Object.keys(set)) === String(keys))), 60_000);

/** Drags by shares of the picture. */
async function drag(page, across, down, button = "left") {
  const box = await page.locator("#frame").boundingBox();
  const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
  await page.mouse.move(x, y);
  await page.mouse.down({ button });
  await page.mouse.move(x + across * box.width, y + down * box.height, { steps: 5 });
  await page.mouse.up({ button });
}

/** The camera once it stands still. */
async function settled(where, page) {
  await page.waitForTimeout(500);
  const { frame } = newest(where);
  await until("two more frames", () => newest(where).frame > frame + 2);
  return camera(where);
}

test("a drag turns the camera of the next record about its point", async () => {
  await steered("box", async (page, where) => {
    const [from, { frame }] = [camera(where), newest(where)];
    await drag(page, 0.1, 0.05);
    const record = await commanded(where, frame, ["camera"]);
    assert.ok(!close(record.camera.eye, from.eye) && close(record.camera.look_at, from.look_at));
    const to = await settled(where, page);
    assert.ok(Math.abs(Math.hypot(...away(to)) / Math.hypot(...away(from)) - 1) < 1e-9);
    // To the right by a tenth of the width: 18 degrees about `up`.
    const azimuth = ([x, y]) => Math.atan2(y, x);
    assert.ok(Math.abs(azimuth(away(from)) - azimuth(away(to)) - 0.1 * Math.PI) < 0.05, `${away(from)} ${away(to)}`);
    assert.ok(to.eye[2] > from.eye[2], "dragged down, seen from further above");
    await until("it is told", async () => /Command \d+ is in effect: camera/.test(await page.textContent("#log")));
    await page.screenshot({ path: path.join(SCREENSHOTS, "steering.png") });
  });
});

test("shift and the right button move, the wheel zooms, a double click goes home", async () => {
  await steered("box", async (page, where) => {
    await page.dblclick("#frame");
    const home = await settled(where, page);
    await page.keyboard.down("Shift");
    await drag(page, 0.1, 0);
    await page.keyboard.up("Shift");
    const moved = await settled(where, page);
    assert.ok(close(away(moved), away(home)) && !close(moved.look_at, home.look_at));
    await drag(page, -0.1, 0, "right");
    assert.ok(close((await settled(where, page)).eye, home.eye));
    await page.mouse.wheel(0, -200);
    const near = await settled(where, page);
    assert.ok(close(near.look_at, home.look_at) && Math.hypot(...away(near)) < 0.9 * Math.hypot(...away(home)));
    await page.keyboard.press("-");
    assert.ok(Math.hypot(...away(await settled(where, page))) > Math.hypot(...away(near)));
    await page.keyboard.press("a");
    assert.ok(!close(away(await settled(where, page)), away(near)));
    await page.keyboard.press("0");
    assert.ok(close((await settled(where, page)).eye, home.eye));
    await page.keyboard.press("W");
    assert.ok(!close((await settled(where, page)).look_at, home.look_at));
    await page.click("#home");
    assert.ok(close((await settled(where, page)).eye, home.eye));
  });
});

test("a map is moved and zoomed, and not turned", async () => {
  await steered("map", async (page, where) => {
    const home = camera(where);
    await drag(page, 0.1, -0.1);
    const moved = await settled(where, page);
    assert.ok(close(away(moved), away(home)) && moved.look_at[0] < home.look_at[0] && moved.look_at[1] < home.look_at[1], JSON.stringify(moved));
    await page.mouse.wheel(0, -300);
    const near = await settled(where, page);
    assert.ok(near.field_of_view < moved.field_of_view && near.orthographic);
    await page.dblclick("#frame");
    assert.ok(close((await settled(where, page)).eye, home.eye));
  });
});

/** Two fingers that go from two places to two others, in shares of the picture. */
async function pinch(page, from, to) {
  const touch = await page.context().newCDPSession(page);
  const box = await page.locator("#frame").boundingBox();
  const send = (type, points) => touch.send("Input.dispatchTouchEvent", { type, touchPoints: points.map(([x, y], id) => ({ x: box.x + x * box.width, y: box.y + y * box.height, id })) });
  await send("touchStart", [from[0]]);
  await send("touchStart", from);
  for (const share of [0.25, 0.5, 0.75, 1]) await send("touchMove", from.map((point, k) => point.map((value, axis) => value + share * (to[k][axis] - value))));
  // The second finger stays for a moment, and does not turn the view.
  await send("touchEnd", [to[1]]);
  await send("touchMove", [[to[1][0] + 0.2, to[1][1]]]);
  await send("touchEnd", []);
}

test("two fingers zoom and move: what is under them stays under them", async () => {
  // The point of the scene at a share of the picture.
  const at = ({ eye, look_at: look, field_of_view: angle }, [x, y]) => {
    const half = Math.abs(eye[2] - look[2]) * Math.tan((angle * Math.PI) / 360);
    return [look[0] + (2 * x - 1) * half, look[1] + ((1 - 2 * y) * half) / 2];
  };
  await steered("map", async (page, where) => {
    await page.keyboard.press("0");
    const home = await settled(where, page);
    const [from, to] = [[[0.4, 0.6], [0.6, 0.6]], [[0.3, 0.4], [0.8, 0.4]]];
    const { frame } = newest(where);
    await pinch(page, from, to);
    await commanded(where, frame, ["camera"]);
    // Whole pixels of the window, twice.
    await until("both fingers hold their points", () => from.every((point, k) => at(camera(where), to[k]).every((value, axis) => Math.abs(value - at(home, point)[axis]) < 0.02)));
    const near = await settled(where, page);
    assert.ok(from.every((point, k) => at(near, to[k]).every((value, axis) => Math.abs(value - at(home, point)[axis]) < 0.02)), "the finger that was left moved nothing");
    assert.ok(Math.tan((near.field_of_view * Math.PI) / 360) / Math.tan((home.field_of_view * Math.PI) / 360) < 0.45);
    await pinch(page, to, from);
    await until("back again", () => Math.abs(camera(where).field_of_view - home.field_of_view) < 0.5);
    await page.keyboard.press("0");
    assert.ok(close((await settled(where, page)).eye, home.eye));
  });
  await steered("box", async (page, where) => {
    await page.keyboard.press("0");
    const home = await settled(where, page);
    await pinch(page, [[0.4, 0.5], [0.6, 0.5]], [[0.35, 0.6], [0.65, 0.6]]);
    await until("nearer", () => Math.abs(Math.hypot(...away(camera(where))) / Math.hypot(...away(home)) - 2 / 3) < 0.02);
    const near = await settled(where, page);
    // Moved, and not turned.
    assert.ok(close(away(near).map((value) => value * Math.hypot(...away(home))), away(home).map((value) => value * Math.hypot(...away(near)))) && !close(near.look_at, home.look_at));
    await page.keyboard.press("0");
    assert.ok(close((await settled(where, page)).eye, home.eye));
  });
});

test("a tolerance is in a later record, and one that is not accepted is refused by name", async () => {
  await steered("box", async (page, where) => {
    const { frame } = newest(where);
    await page.fill("#tolerance", "0.125");
    await page.press("#tolerance", "Enter");
    const record = await commanded(where, frame, ["trust.tolerance"]);
    assert.equal(record.tolerance, 0.125);
    await page.fill("#tolerance", "-1");
    await page.press("#tolerance", "Enter");
    await until("it is refused", async () => /Refused: `trust.tolerance` is -1.0; accepted: a number above 0/.test(await page.textContent("#warnings")));
    await until("two more frames", () => newest(where).frame > record.frame + 2);
    assert.equal(newest(where).tolerance, 0.125);
  });
});

test("a range of colours is in a later record, and on the colour bar", async () => {
  await steered("map", async (page, where) => {
    const { frame } = newest(where);
    await page.fill("#high", "0.25");
    await page.press("#high", "Enter");
    const record = await commanded(where, frame, ["transfer"]);
    assert.deepEqual([record.transfer.low, record.transfer.high], [0.05, 0.25]);
    await until("the bar ends there", async () => (await page.locator("#scale-ticks span").allTextContents()).every((text) => Number(text) <= 0.25));
    await page.fill("#low", "0.5");
    await page.press("#low", "Enter");
    await until("it is refused", async () => /Refused: `transfer.high` is 0.25; accepted: a finite number above transfer.low/.test(await page.textContent("#warnings")));
  });
});

test("a transfer function edit changes the picture, and traces no points but the audit points of its own frame", async () => {
  await steered("box", async (page, where) => {
    // Two pictures of the same colours, which only noise tells apart.
    const first = await shownPicture(page);
    const before = await until("a later picture", async () => { const picture = await shownPicture(page); return picture.frame > first.frame + 3 && picture; });
    const { frame, slide, transfer } = newest(where);
    const high = (transfer.low + transfer.high) / 2;
    await page.fill("#high", String(high));
    await page.press("#high", "Enter");
    const record = await commanded(where, frame, ["transfer"]);
    assert.ok(record.transfer.high === high && record.slide === slide);
    const after = await until("its picture", async () => { const picture = await shownPicture(page); return picture.frame >= record.frame && picture; });
    const [noise, change] = [apart(first, before), apart(before, after)];
  assert.ok(change > 3 * noise && change > 0.5, `levels change by ${change}, with the same colours by ${noise}`);
    // Had the slide been traced anew, there were points before the frame. Trust begins anew: 8 points in each of the 16^3 cells, as of any frame, and none
    // that a trusted cell gets besides.
    assert.equal(record.preparation_traces, 0);
    assert.equal(record.audited, AUDITED);
    // Frames above a table are audited as their queries warrant.
    const former = where.records().filter((other) => other.frame < record.frame && other.audited > 0).at(-1);
    assert.ok(former.trusted_volume > 0 && former.audited >= AUDITED, `${former.audited} points before`);
  });
});

test("extinction and palette are in effect with a later record", async () => {
  await steered("box", async (page, where) => {
    const { frame, transfer } = newest(where);
    await until("the extinction is shown", async () => Math.abs(Number(await page.inputValue("#extinction")) / transfer.extinction - 1) < 1e-4);
    await page.fill("#extinction", "3.5");
    await page.press("#extinction", "Enter");
    const record = await commanded(where, frame, ["transfer.extinction"]);
    assert.deepEqual(record.transfer, { ...transfer, extinction: 3.5 });
    await page.selectOption("#albedo", "deep");
    await commanded(where, record.frame, ["transfer.albedo"]);
    assert.equal(await page.inputValue("#albedo"), "");
    await page.fill("#extinction", "-1");
    await page.press("#extinction", "Enter");
    await until("it is refused", async () => /Refused: `transfer.extinction` is -1.0/.test(await page.textContent("#warnings")));
  });
});

test("method and budget are in effect with a later record, and a budget needs its method", async () => {
  await steered("map", async (page, where) => {
    const { frame, method } = newest(where);
    assert.equal(method, "two_level");
    await until("the method is shown", async () => (await page.inputValue("#method")) === "two_level");
    await until("the budget is shown", async () => (await page.inputValue("#budget")) === "50");
    await page.selectOption("#method", "gated");
    const gated = await commanded(where, frame, ["render.method"]);
    assert.deepEqual([gated.method, gated.picture_error], ["gated", null]);
    await until("there is no budget", () => page.isDisabled("#budget"));
    assert.equal(await page.inputValue("#budget"), "");
    await page.selectOption("#method", "two_level");
    const back = await commanded(where, gated.frame, ["render.method"]);
    assert.ok(back.method === "two_level" && back.picture_error !== null);
    await until("there is a budget", async () => (await page.isEnabled("#budget")) && (await page.inputValue("#budget")) === "50");
    await page.fill("#budget", "20");
    await page.press("#budget", "Enter");
    assert.deepEqual((await commanded(where, back.frame, ["render.budget"])).commands.at(-1).set, { "render.budget": 20 });
    await page.fill("#budget", "0.01");
    await page.press("#budget", "Enter");
    await until("it is refused", async () => /Refused: `render.budget` is 0.01; accepted: milliseconds, 0.1 to 600000/.test(await page.textContent("#warnings")));
  });
});

test("tau and direction are in effect with a later record, and a tau that is none is refused", async () => {
  await steered("map", async (page, where) => {
    const { frame, tau, direction } = newest(where);
    assert.deepEqual([tau, direction], [10, "forward"]);
    await until("both are shown", async () => (await page.inputValue("#direction")) === "forward" && (await page.inputValue("#tau")) === "10");
    await page.selectOption("#direction", "backward");
    const back = await commanded(where, frame, ["time.direction"]);
    assert.deepEqual([back.direction, back.tau], ["backward", 10]);
    await page.fill("#tau", "4");
    await page.press("#tau", "Enter");
    const short = await commanded(where, back.frame, ["time.tau"]);
    assert.deepEqual([short.direction, short.tau], ["backward", 4]);
    await page.fill("#tau", "-1");
    await page.press("#tau", "Enter");
    await until("it is refused", async () => /Refused: `time.tau` is -1.0; accepted: a number above 0/.test(await page.textContent("#warnings")));
    await page.fill("#tau", "10");
    await page.press("#tau", "Enter");
    await commanded(where, short.frame, ["time.tau"]);
    await page.selectOption("#direction", "forward");
    await commanded(where, short.frame, ["time.direction"]);
  });
});

test("a pause holds the window, is said, and the view still moves", async () => {
  await steered("map", async (page, where) => {
    const { frame } = newest(where);
    await page.keyboard.press("p");
    const { slide } = await commanded(where, frame, ["paused"]);
    await until("it is said", async () => /^The window is paused, frame/.test(await page.textContent("#state")));
    // The run refines the picture, and then waits.
    await until("no more frames", async () => { const before = newest(where).frame; await page.waitForTimeout(4_000); return newest(where).frame === before; }, 60_000);
    assert.match(await page.textContent("#state"), /^The window is paused/);
    assert.equal(await page.textContent("#warnings"), "");
    await page.screenshot({ path: path.join(SCREENSHOTS, "paused.png") });
    const last = newest(where);
    await drag(page, 0.1, 0);
    assert.equal((await commanded(where, last.frame, ["camera"])).slide, slide);
    await page.click("#pause");
    await until("the window moves on", () => newest(where).slide > slide + 2);
    await until("it is said", async () => /^Following/.test(await page.textContent("#state")));
  });
});

/** Sends a command as a page would, and returns the answer. */
async function answer(where, token, set) {
  const socket = new WebSocket(`ws://127.0.0.1:${where.dashboard.port}/socket?token=${token}`);
  await new Promise((resolve) => { socket.on("open", resolve); });
  const answered = new Promise((resolve) => {
    socket.on("message", (data) => { const { json } = parse(data); if (json.kind === "answer") resolve(json); });
  });
  socket.send(JSON.stringify({ command: 7, set }));
  const json = await answered;
  socket.terminate();
  return json;
}

test("who has the address for watching sees the run, and is refused by the server", async () => {
  const where = stages.box;
  let shared;
  await steered("box", async (page) => {
    await page.click("#share");
    shared = new URL(await page.evaluate(() => navigator.clipboard.readText()));
  });
  const watching = shared.searchParams.get("token");
  assert.ok(watching.length === 64 && watching !== TOKEN);
  const page = await open(where.address(watching));
  await until("it is said", async () => (await page.textContent("#obstacle")) === "This address only watches the run.");
  assert.ok(!(await page.isVisible("#pause")) && !(await page.isVisible("#share")));
  const { frame } = newest(where);
  await drag(page, 0.2, 0.1);
  await page.keyboard.press("p");
  const refused = await answer(where, watching, { paused: true });
  assert.ok(refused.command === 7 && /only watches/.test(refused.refused), JSON.stringify(refused));
  await until("some frames", () => newest(where).frame > frame + 5);
  assert.deepEqual(where.records().filter((record) => record.frame > frame).flatMap(({ commands }) => commands), []);
  await page.context().close();
  assert.ok((await answer(where, TOKEN, {})).accepted);
});

test("without a command socket the page says why", async () => {
  const { endpoint, folder } = stages.map;
  for (const [more, why] of [[[], /^The run is not steered: the dashboard or the run was started without --steer\.$/], [[`--steer=${folder}/none`], /^The run is not steered: its command socket cannot be reached .*none/]]) {
    const { child, port } = await startDashboard(endpoint, temporary(), 0, TOKEN, more);
    const page = await open(`http://127.0.0.1:${port}/?token=${TOKEN}`);
    await until("it is said", async () => why.test(await page.textContent("#obstacle")));
    assert.ok(!(await page.isVisible("#pause")));
    await page.context().close();
    await stop(child);
  }
});
