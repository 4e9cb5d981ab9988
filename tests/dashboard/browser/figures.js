// Measures the dashboard's server and page: `node figures.js [SECONDS] [RATE]`. A publisher sends one real picture of 1280 x 720 pixels again and again with
// new numbers, so that nothing is rendered meanwhile. One page in Chromium, 20 clients that acknowledge, one that stops reading, and one whose process is
// stopped without closing its connection. PYTHON names a Python with pyzmq. Prints one line of JSON, and fails if a client lacks a twentieth of the pictures,
// or the server's memory grows by 8 MiB in the second half.
import { spawn } from "node:child_process";
import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";
import { WebSocket } from "ws";
import { TOKEN, launch, parse, startDashboard, startPublisher, stop, temporary, until } from "./kit.js";

const [seconds, rate] = [process.argv[2] ?? 60, process.argv[3] ?? 20].map(Number);
const CLIENTS = 20;
const PUBLISHER = `
import json, sys, time, zmq
source, endpoint, rate, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3]), float(sys.argv[4])
context = zmq.Context()
frames = context.socket(zmq.SUB)
frames.connect(source)
frames.subscribe(b"frame")
_, head, picture = frames.recv_multipart()
header = json.loads(head)
out = context.socket(zmq.PUB)
out.sndhwm = 4
out.bind(endpoint)
print("ready", len(picture), flush=True)
sys.stdin.readline()
begin = time.monotonic()
for number in range(int(rate * seconds)):
    time.sleep(max(0.0, begin + number / rate - time.monotonic()))
    header["frame"] = header["record"]["frame"] = number
    record = json.dumps(header["record"]).encode()
    print(number, 1e3 * time.time(), flush=True)
    out.send_multipart([b"frame", json.dumps(header).encode(), picture])
    out.send_multipart([b"record", record])
`;

const folder = temporary();
const [source, endpoint] = [`ipc://${folder}/source`, `ipc://${folder}/frames`];
// A coarse table: what is shown does not matter.
const size = { "render.width": 1280, "render.height": 720, "surrogate.table_nodes": "[201, 101, 2]", "time.warmup_frames": 0 };
const run = startPublisher(source, folder, { changes: size });
const publisher = spawn(process.env.PYTHON ?? "python3", ["-c", PUBLISHER, source, endpoint, String(rate), String(seconds)], { stdio: ["pipe", "pipe", "inherit"] });
const sent = new Map();
let bytes = 0;
createInterface({ input: publisher.stdout }).on("line", (line) => {
  const [first, second] = line.split(" ");
  if (first === "ready") bytes = Number(second);
  else sent.set(Number(first), Number(second));
});
await until("a picture to publish", () => bytes > 0, 120_000);
await stop(run);

const dashboard = await startDashboard(endpoint, folder);
const address = `ws://127.0.0.1:${dashboard.port}/socket?token=${TOKEN}`;
const browser = await launch();
const page = await (await browser.newContext({ viewport: { width: 1280, height: 900 } })).newPage();
await page.goto(`http://127.0.0.1:${dashboard.port}/?token=${TOKEN}`);
// The number changes when the picture is on the canvas; the next animation frame shows it.
await page.evaluate(() => {
  window.drawn = [];
  new MutationObserver(() => {
    const frame = Number(document.getElementById("position").textContent.replace(/\D/g, ""));
    requestAnimationFrame(() => window.drawn.push([frame, Date.now()]));
  }).observe(document.getElementById("position"), { childList: true, characterData: true, subtree: true });
});

const counts = Array(CLIENTS).fill(0);
const clients = counts.map((_, number) => {
  const socket = new WebSocket(address);
  socket.on("message", (data) => {
    const { json } = parse(data);
    if (json.kind !== "frame") return;
    counts[number] += 1;
    socket.send(JSON.stringify({ ack: json.sequence }));
  });
  return socket;
});
const stalled = new WebSocket(address);
stalled.on("open", () => stalled._socket.pause());
const dead = spawn(process.execPath, ["--input-type=module", "-e", `import { WebSocket } from "ws"; new WebSocket("${address}").on("open", () => console.log("open"));`], {
  cwd: import.meta.dirname, stdio: ["ignore", "pipe", "inherit"],
});
await until("all are connected", () => [...clients, stalled].every((socket) => socket.readyState === WebSocket.OPEN), 30_000);
await new Promise((resolve) => { dead.stdout.once("data", resolve); });
dead.kill("SIGSTOP");

const resident = () => Number(/VmRSS:\s+(\d+)/.exec(readFileSync(`/proc/${dashboard.child.pid}/status`, "utf8"))[1]) / 1024;
const memory = [];
const sampler = setInterval(() => memory.push(resident()), 1000);
publisher.stdin.write("\n");
await new Promise((resolve) => { publisher.once("exit", resolve); });
await new Promise((resolve) => { setTimeout(resolve, 500); });
clearInterval(sampler);
const drawn = await page.evaluate(() => window.drawn);
await browser.close();
dead.kill("SIGKILL");
[...clients, stalled].forEach((socket) => socket.terminate());
await stop(dashboard.child);

const late = drawn.filter(([frame]) => sent.has(frame)).map(([frame, at]) => at - sent.get(frame)).sort((a, b) => a - b);
const at = (values, share) => values[Math.min(values.length - 1, Math.floor(share * values.length))];
const round = (value) => Math.round(10 * value) / 10;
const rates = counts.map((count) => count / seconds).sort((a, b) => a - b);
const later = memory.slice(Math.floor(memory.length / 2));
console.log(JSON.stringify({
  seconds, published_per_second: rate, picture_bytes: bytes,
  page: { frames_per_second: round(late.length / seconds), latency_ms: { median: round(at(late, 0.5)), p99: round(at(late, 0.99)) } },
  clients: { number: CLIENTS, slowest_per_second: round(rates[0]), median_per_second: round(at(rates, 0.5)) },
  memory_mib: { first: round(memory[0]), later_least: round(Math.min(...later)), later_most: round(Math.max(...later)) },
}));
const growth = Math.max(...later) - later[0];
process.exit(rates[0] >= 0.95 * rate && late.length >= 0.95 * seconds * rate && growth < 8 ? 0 : 1);
