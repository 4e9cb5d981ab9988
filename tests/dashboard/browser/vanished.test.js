// A client that vanishes from the network, without a word and without its system acknowledging: a client in a network namespace whose cable is pulled.
import assert from "node:assert/strict";
import { execFileSync, spawn } from "node:child_process";
import { readFileSync } from "node:fs";
import { after, test } from "node:test";
import { WebSocket } from "ws";
import { TOKEN, parse, startDashboard, startPublisher, stop, temporary, until } from "./kit.js";

const [HERE, THERE] = ["10.213.77.1", "10.213.77.2"];
const [NAMESPACE, CABLE] = [`ridgewatch-${process.pid}`, `rw${process.pid}`];
// A client is pinged after 10 s of silence, and is given up 10 s later.
const GONE = 40_000;

const ip = (...words) => execFileSync("ip", words, { stdio: "pipe" });
const cleanUp = () => {
  try { ip("link", "del", CABLE); } catch { /* It was not made. */ }
  try { ip("netns", "del", NAMESPACE); } catch { /* Nor was it. */ }
};

/** Why there can be no second network here, or null. */
function refused() {
  try {
    ip("netns", "add", NAMESPACE);
    ip("link", "add", CABLE, "type", "veth", "peer", "name", `${CABLE}p`, "netns", NAMESPACE);
    ip("addr", "add", `${HERE}/30`, "dev", CABLE);
    ip("link", "set", CABLE, "up");
    ip("-n", NAMESPACE, "addr", "add", `${THERE}/30`, "dev", `${CABLE}p`);
    ip("-n", NAMESPACE, "link", "set", `${CABLE}p`, "up");
    return null;
  } catch (error) {
    cleanUp();
    return `no network namespace can be made (it needs root and iproute2): ${String(error.stderr ?? error.message).trim()}`;
  }
}

const why = refused();
if (why) console.log(`NOT RUN: the test of a client that vanishes, since ${why}`);
const folder = temporary();
const children = [];
after(async () => {
  for (const child of children) await stop(child, "SIGKILL");
  cleanUp();
});

/** Connections to THERE that a process still has; those that it closed have no inode (proc(5), /proc/net/tcp). */
const connections = () => {
  const remote = Buffer.from(THERE.split(".").map(Number)).readUInt32LE(0).toString(16).toUpperCase().padStart(8, "0");
  const lines = readFileSync("/proc/net/tcp", "utf8").split("\n").map((line) => line.trim().split(/\s+/));
  return lines.filter((fields) => fields[2]?.startsWith(remote) && fields[9] !== "0").length;
};

test("a client that vanishes is given up, and the others do not notice", { skip: why ?? false }, async () => {
  const endpoint = `ipc://${folder}/frames`;
  children.push(startPublisher(endpoint, folder));
  const dashboard = await startDashboard(endpoint, folder, 0, TOKEN, ["--bind", HERE]);
  children.push(dashboard.child);
  const address = `ws://${HERE}:${dashboard.port}/socket?token=${TOKEN}`;
  const clients = Array.from({ length: 5 }, () => {
    const socket = new WebSocket(address);
    const got = [];
    socket.on("message", (data) => {
      const { json } = parse(data);
      if (json.kind !== "frame") return;
      got.push({ frame: json.sequence, at: Date.now() });
      socket.send(JSON.stringify({ ack: json.sequence }));
    });
    return got;
  });
  await until("frames come", () => clients.every((got) => got.length > 3), 60_000);

  const code = `
    import { WebSocket } from "ws";
    const socket = new WebSocket("${address}");
    socket.on("message", (data) => {
      const { kind, sequence } = JSON.parse(data.subarray(4, 4 + data.readUInt32LE(0)));
      if (kind !== "frame") return;
      socket.send(JSON.stringify({ ack: sequence }));
      console.log(sequence);
    });`;
  const client = spawn("ip", ["netns", "exec", NAMESPACE, process.execPath, "--input-type=module", "-e", code], {
    cwd: import.meta.dirname, stdio: ["ignore", "pipe", "inherit"],
  });
  children.push(client);
  let seen = 0;
  client.stdout.on("data", () => { seen += 1; });
  await until("the client of the other network gets frames", () => seen > 3, 60_000);
  assert.equal(connections(), 1);

  ip("-n", NAMESPACE, "link", "set", `${CABLE}p`, "down");
  const from = Date.now();
  await until("it is given up", () => connections() === 0, GONE);
  const seconds = (Date.now() - from) / 1e3;

  const during = clients.map((got) => got.filter(({ at }) => at >= from));
  const all = new Set(during.flat().map(({ frame }) => frame));
  const times = [from, ...during.flat().map(({ at }) => at).sort((a, b) => a - b), Date.now()];
  const pause = Math.max(...times.slice(1).map((at, k) => at - times[k]));
  console.log(`given up after ${seconds.toFixed(1)} s; meanwhile the others got ${during.map((got) => got.length)} of ${all.size} frames, the longest pause ${pause} ms`);
  // A server that waits for it would stall all of them for as long.
  assert.ok(pause < 3000, `a pause of ${pause} ms`);
  for (const got of during) assert.ok(got.length > 0.9 * all.size, `${got.length} of ${all.size} frames`);
});
