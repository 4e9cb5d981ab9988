// What the tests share: the programs, a proxy as in front of a cluster's nodes, and a browser.
import { chromium } from "playwright-core";
import { spawn } from "node:child_process";
import { once } from "node:events";
import { mkdtempSync, rmSync, writeFileSync } from "node:fs";
import http from "node:http";
import { tmpdir } from "node:os";
import path from "node:path";
import { inflateSync } from "node:zlib";
import { WebSocket, WebSocketServer } from "ws";

export const REPOSITORY = path.resolve(import.meta.dirname, "../../..");
export const PROGRAM = process.env.RIDGEWATCH ?? path.join(REPOSITORY, "target/release/ridgewatch");
const CHROMIUM = process.env.CHROMIUM ?? "/usr/bin/chromium";
const FLAGS = [
  "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
  "--disable-component-update", "--disable-sync",
];
// jupyter-server-proxy's clients accept messages of this length.
export const MESSAGE_LIMIT = 10_000_000;
// A path as Open OnDemand puts before a page.
export const PREFIX = "/node/compute-17/8577/";
export const TOKEN = "a-token-of-the-tests-0123456789abcdef";

// Small pictures, several a second, so that silence is noticed within its shortest limit.
const SMALL = {
  "render.width": 96, "render.height": 48, "render.samples": 1, "render.budget": 50, "time.slides": 5000, "publish.exr": '"none"', "publish.preview": false,
};

export function launch(...more) {
  return chromium.launch({ executablePath: CHROMIUM, args: [...FLAGS, ...more] });
}

/** A folder that is removed at the end of the tests. */
export function temporary() {
  const folder = mkdtempSync(path.join(tmpdir(), "ridgewatch-dashboard-"));
  process.on("exit", () => rmSync(folder, { recursive: true, force: true }));
  return folder;
}

const children = new Set();
// A run that takes too long is ended by a signal.
process.once("SIGTERM", () => process.exit(1));
process.on("exit", () => { for (const child of children) child.kill("SIGKILL"); });

function start(args) {
  const child = spawn(PROGRAM, args, { cwd: REPOSITORY, stdio: ["ignore", "pipe", "pipe"] });
  children.add(child);
  child.once("exit", () => children.delete(child));
  [child.text, child.log] = ["", ""];
  child.stdout.on("data", (text) => { child.text = (child.text + text).slice(-4000); });
  child.stderr.on("data", (text) => { child.log = (child.log + text).slice(-4000); });
  return child;
}

export async function stop(child, signal = "SIGTERM") {
  if (child.exitCode !== null || child.signalCode !== null) return;
  child.kill(signal);
  await once(child, "exit");
}

/** A run that publishes; `more` are further options, and `changes` further keys; `null` leaves a key out. */
export function startPublisher(endpoint, folder, { scene = "configs/double_gyre.toml", changes = {}, more = [] } = {}) {
  const settings = Object.entries({ ...SMALL, ...changes }).filter(([, value]) => value !== null).flatMap(([key, value]) => ["--set", `${key}=${value}`]);
  const child = start(["replay", scene, "--device", "cpu", "--publish", endpoint, "--out", path.join(folder, "run"), "--overwrite", ...settings, ...more]);
  child.once("exit", (code) => { if (code) console.error(`the publisher ended: ${child.log}`); });
  return child;
}

const printedUrl = (child) => until("an address is printed", () => {
  if (child.exitCode !== null) throw new Error(`it did not start: ${child.log}`);
  return /"url":\s*"([^"]+)"/.exec(child.text)?.[1];
});

/** A proxy with a path prefix before the page of a program, with which it ends. */
export async function startProxy(child, port) {
  const proxy = new Proxy(PREFIX);
  await proxy.listen();
  proxy.target = port;
  child.once("exit", () => proxy.close());
  return proxy;
}

/** A run that shows itself, and the address of its page behind a proxy. */
export async function startShown(folder, { more = [], ...options } = {}) {
  const child = startPublisher(`ipc://${folder}/frames`, folder, { ...options, more: ["--dashboard=0", "--json", ...more] });
  const { port, searchParams } = new URL(await printedUrl(child));
  const proxy = await startProxy(child, Number(port));
  return { child, url: proxy.address(searchParams.get("token")) };
}

/** A simulation that steps four times a second. */
export function startSolver(ring) {
  return start(["publish", "configs/turbulence_easy.toml", "--set", "source.nodes=[48,24,24]", "--ring", ring, "--rate", "4", "--steps", "100000"]);
}

/** A run beside the simulation of a ring, which can be steered, and the address of its page. */
export async function startAttached(ring, folder) {
  const small = ["render.width=96", "render.height=48", "render.budget=50", 'publish.exr="none"'].flatMap((key) => ["--set", key]);
  const child = start(["attach", ring, "--tau", "11", "--device", "cpu", "--out", path.join(folder, "run"), "--publish", `ipc://${folder}/frames`, `--steer=ipc://${folder}/commands`, "--dashboard=0", "--json", ...small]);
  return { child, url: await printedUrl(child) };
}

/** The server, and the port of its page. */
export async function startDashboard(endpoint, folder, port = 0, token = TOKEN, more = []) {
  const file = path.join(folder, "token");
  writeFileSync(file, `${token}\n`, { mode: 0o600 });
  const child = start(["dashboard", endpoint, "--port", String(port), "--token-file", file, "--json", ...more]);
  return { child, port: Number(new URL(await printedUrl(child)).port) };
}

/**
 * A proxy that puts `prefix` before every path and keeps it, as Open OnDemand's /node/ does, and refuses long messages. `change(message)`, if set, may
 * return other bytes for a message of the server; while `mute` is set nothing passes.
 */
export class Proxy {
  constructor(prefix) {
    this.prefix = prefix;
    this.target = 0;
    this.change = null;
    this.mute = false;
    this.longest = 0;
    this.upstreams = new Set();
    this.server = http.createServer((request, response) => this.pass(request, response));
    this.sockets = new WebSocketServer({ server: this.server });
    this.sockets.on("connection", (client, request) => this.join(client, request));
  }

  async listen() {
    await once(this.server.listen(0, "127.0.0.1"), "listening");
    this.origin = `http://127.0.0.1:${this.server.address().port}`;
  }

  address(token = TOKEN) {
    return `${this.origin}${this.prefix}?token=${token}`;
  }

  pass(request, response) {
    if (!request.url.startsWith(this.prefix)) { response.writeHead(404).end(); return; }
    const { method, headers, url } = request;
    const upstream = http.request({ port: this.target, host: "127.0.0.1", path: url, method, headers: { ...headers, connection: "close" } }, (answer) => {
      response.writeHead(answer.statusCode, answer.headers);
      answer.pipe(response);
    });
    upstream.on("error", () => {
      if (!response.headersSent) response.writeHead(502);
      response.end();
    });
    // Who gives up does so all the way.
    response.on("close", () => upstream.destroy());
    request.pipe(upstream);
  }

  join(client, { url, headers: { origin, cookie, host } }) {
    const headers = Object.fromEntries(Object.entries({ origin, cookie, host }).filter(([, value]) => value !== undefined));
    const upstream = new WebSocket(`ws://127.0.0.1:${this.target}${url}`, { headers, maxPayload: MESSAGE_LIMIT });
    this.upstreams.add(upstream);
    upstream.on("message", (data) => {
      this.longest = Math.max(this.longest, data.length);
      if (!this.mute) client.send(this.change?.(data) ?? data);
    });
    client.on("message", (data) => { if (upstream.readyState === WebSocket.OPEN) upstream.send(data.toString()); });
    client.on("close", () => upstream.terminate());
    upstream.on("close", () => { this.upstreams.delete(upstream); client.terminate(); });
    upstream.on("error", () => client.terminate());
  }

  close() {
    this.sockets.clients.forEach((client) => client.terminate());
    this.server.close();
    this.server.closeAllConnections();
  }
}

/** Splits a message of the server. */
export function parse(data) {
  const length = data.readUInt32LE(0);
  return { json: JSON.parse(data.subarray(4, 4 + length)), payload: data.subarray(4 + length) };
}

export function compose(json, payload) {
  const text = Buffer.from(JSON.stringify(json));
  const length = Buffer.alloc(4);
  length.writeUInt32LE(text.length);
  return Buffer.concat([length, text, payload]);
}

/** Waits until `probe` returns something true, and returns it. */
export async function until(what, probe, milliseconds = 20_000) {
  const end = Date.now() + milliseconds;
  for (;;) {
    const found = await probe();
    if (found) return found;
    if (Date.now() > end) throw new Error(`not within ${milliseconds} ms: ${what}`);
    await new Promise((resolve) => setTimeout(resolve, 50));
  }
}

/** The number of the frame that the page shows, and its pixels. Read from a copy, since browsers warn of canvases that are read often. */
export const shownPicture = (page) => page.evaluate(() => {
  const canvas = document.getElementById("frame");
  const context = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
  context.drawImage(canvas, 0, 0);
  const frame = Number(document.getElementById("position").textContent.replace(/\D/g, ""));
  return { frame, data: [...context.getImageData(0, 0, canvas.width, canvas.height).data] };
});

/** Mean difference of the levels of two pictures. */
export const apart = ({ data: a }, { data: b }) => a.reduce((sum, level, k) => sum + Math.abs(level - b[k]), 0) / a.length;

/** Channels of a picture as the program writes it (openexr.com, "OpenEXR File Layout": one part, 32-bit floats, ZIP): its width, and by name values in rows. */
export function readExr(bytes) {
  let at = 8;
  const text = () => { const [from, end] = [at, bytes.indexOf(0, at)]; at = end + 1; return bytes.toString("latin1", from, end); };
  const header = {};
  for (let name = text(); name; name = text()) {
    text();
    const length = bytes.readInt32LE(at);
    header[name] = bytes.subarray(at + 4, at + 4 + length);
    at += 4 + length;
  }
  const [left, top, right, bottom] = [0, 4, 8, 12].map((place) => header.dataWindow.readInt32LE(place));
  const [width, height] = [right - left + 1, bottom - top + 1];
  const names = [];
  for (let list = header.channels; list[0]; list = list.subarray(list.indexOf(0) + 17)) names.push(list.toString("latin1", 0, list.indexOf(0)));
  const channels = Object.fromEntries(names.map((name) => [name, new Float32Array(width * height)]));
  // A table of places, then blocks of 16 rows: differences of bytes, lower bytes first.
  at += 8 * Math.ceil(height / 16);
  for (let first = 0; first < height; first += 16) {
    const rows = Math.min(16, height - first);
    const packed = bytes.subarray(at + 8, at + 8 + bytes.readInt32LE(at + 4));
    at += 8 + packed.length;
    let block = packed;
    if (packed.length < 4 * rows * width * names.length) {
      const mixed = inflateSync(packed);
      for (let i = 1; i < mixed.length; i += 1) mixed[i] = (mixed[i] + mixed[i - 1] - 128) & 255;
      block = Buffer.from(mixed.map((_, i) => mixed[(i >> 1) + (i % 2) * Math.ceil(mixed.length / 2)]));
    }
    let place = 0;
    for (let row = first; row < first + rows; row += 1) {
      for (const name of names) for (let x = 0; x < width; x += 1, place += 4) channels[name][row * width + x] = block.readFloatLE(place);
    }
  }
  return { width, channels };
}
