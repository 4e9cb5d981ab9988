// Tries a run's own page in Chromium behind real proxies: `node proxies.js`. What is not installed is named as NOT RUN.
// - jupyter-server-proxy: PYTHON names a Python with jupyter-server and jupyter-server-proxy.
// - Open OnDemand: ONDEMAND names its sources, whose Lua runs in Apache (Debian: apache2, lua-posix) on the way to this machine under its own name.
import assert from "node:assert/strict";
import { execFileSync, spawn } from "node:child_process";
import { createHash } from "node:crypto";
import { lookup } from "node:dns/promises";
import { once } from "node:events";
import { chmodSync, existsSync, mkdirSync, writeFileSync } from "node:fs";
import net from "node:net";
import { hostname, userInfo } from "node:os";
import path from "node:path";
import { launch, readExr, startPublisher, stop, temporary, until } from "./kit.js";

// Name of the proxy in the browser, which alone knows its address.
const PORTAL = "portal.example.org";
const SECRET = "the-proxys-own-0123456789";
const MODULES = ["mpm_event", "authn_core", "authn_file", "authz_core", "authz_user", "auth_basic", "env", "proxy", "proxy_http", "proxy_wstunnel", "lua"];
// Of few nodes, so that its field is traced within seconds.
const SCENE = { "source.nodes": "[48, 24, 24]", "time.slides": null, "time.frames_per_slide": 100_000, "time.warmup_frames": 0 };
const PYTHON = process.env.PYTHON ?? "python3";

const folder = temporary();
let proxy;
process.on("exit", (code) => {
  proxy?.kill("SIGKILL");
  if (code) console.error(proxy?.log.slice(-4000));
});

async function freePort() {
  const server = net.createServer().listen(0, "127.0.0.1");
  await once(server, "listening");
  const { port } = server.address();
  server.close();
  return port;
}

/** Starts a proxy that does not go to the background, and waits until it accepts connections. */
async function startProxy(command, args, port, env = {}) {
  const child = spawn(command, args, { env: { ...process.env, ...env }, stdio: ["ignore", "pipe", "pipe"] });
  proxy = Object.assign(child, { log: "" });
  for (const stream of [child.stdout, child.stderr]) stream.on("data", (text) => { child.log += text; });
  child.once("error", (error) => { child.log += error; });
  await until(`${command} listens`, () => new Promise((resolve, reject) => {
    if (child.exitCode !== null) reject(new Error(child.log));
    const socket = net.connect(port, "127.0.0.1", () => { socket.destroy(); resolve(true); });
    socket.once("error", () => resolve(false));
  }), 60_000);
  return child;
}

/** What a command prints, or null if it fails. */
function printed(command, args) {
  try { return execFileSync(command, args, { encoding: "utf8", stdio: ["ignore", "pipe", "ignore"] }).trim(); } catch { return null; }
}

const frame = async (page) => Number((await page.textContent("#position")).replace(/\D/g, ""));

/** Frames advance, values, planes and files are those of the run, and a command is in effect on a later frame. */
async function checkPage(page, address) {
  const complaints = [];
  page.on("pageerror", (error) => complaints.push(String(error)));
  await page.goto(address);
  const first = await until("a picture", () => frame(page));
  await until("later frames", async () => (await frame(page)) > first + 5);
  assert.ok(!page.url().includes("token="), "the token leaves the address");
  await page.reload();
  await until("a picture after a reload", () => frame(page));
  const token = new URL(address).searchParams.get("token");
  const ask = (name, query = {}) => page.evaluate(async ([name, query]) => {
    const answer = await fetch(`${name}?${new URLSearchParams(query)}`);
    return { status: answer.status, bytes: [...new Uint8Array(await answer.arrayBuffer())] };
  }, [name, { token, ...query }]).then(({ status, bytes }) => ({ status, bytes: Buffer.from(bytes) }));
  const get = async (name, query) => {
    const { status, bytes } = await ask(name, query);
    assert.equal(status, 200, `${name}: ${bytes.toString().slice(0, 300)}`);
    return bytes;
  };
  const values = JSON.parse(await get("values", { x: 40, y: 20 }));
  assert.ok(values.size[0] === 96 && Number.isFinite(values.channels.R));
  assert.ok(JSON.parse(await get("histogram")).counts.length === 64);
  const plane = await get("plane", { of: "ftle" });
  assert.equal(plane.length, 4 + plane.readUInt32LE(0) + 2 * 96 * 48);
  assert.ok("ftle.mean" in readExr(await get("frame.exr")).channels);
  assert.equal((await get("frame.png")).toString("latin1", 1, 4), "PNG");
  assert.ok("tolerance" in JSON.parse(await get("frame.json")));
  assert.match(await get("metrics").then(String), /^ridgewatch_publisher_connected 1$/m);
  let slide = {};
  const field = await until("the field", async () => {
    const { status, bytes } = await ask("field.nc", slide);
    assert.ok(status === 200 || status === 202, bytes.toString());
    if (status === 200) return bytes;
    const told = JSON.parse(bytes).slide;
    slide = told === null ? {} : { slide: told };
    return null;
  }, 120_000);
  assert.match(field.toString("latin1", 0, 4), /^(CDF|.HDF)/);
  assert.equal((await ask("values", { x: 40, y: 20, token: "wrong" })).status, 403);
  await until("the controls", () => page.isVisible("#pause"));
  await page.fill("#tolerance", "0.125");
  await page.press("#tolerance", "Enter");
  await until("the command is in effect", async () => /Command \d+ is in effect: trust.tolerance/.test(await page.textContent("#log")));
  assert.deepEqual(complaints, []);
}

/** Checks the page of a run with the options `reach`. `addresses` are those of the page behind the proxy, by kind; `enter` answers what is asked of a visitor. */
async function tryProxy(name, { reach, addresses, context: options = {}, enter = () => {} }) {
  const where = path.join(folder, name);
  mkdirSync(where);
  const more = ["--dashboard=0", "--json", `--steer=ipc://${where}/commands`, ...reach];
  const run = startPublisher(`ipc://${where}/frames`, where, { scene: "configs/turbulence_easy.toml", changes: SCENE, more });
  const url = await until("the page's address", () => /"url":\s*"([^"]+)"/.exec(run.text)?.[1]);
  const { port, searchParams } = new URL(url);
  const browser = await launch(`--host-resolver-rules=MAP ${PORTAL} 127.0.0.1`);
  for (const [kind, address] of Object.entries(addresses(port, searchParams.get("token")))) {
    const context = await browser.newContext({ viewport: { width: 1280, height: 800 }, ...options });
    const page = await context.newPage();
    await enter(page, address);
    await checkPage(page, address);
    await context.close();
    console.log(`the page works behind ${name}, ${kind}`);
  }
  await browser.close();
  await stop(run, "SIGKILL");
}

async function jupyter() {
  const versions = printed(PYTHON, ["-c", "import jupyter_server, jupyter_server_proxy as proxy, tornado; print(f'jupyter-server-proxy {proxy.__version__}, jupyter-server {jupyter_server.__version__}, tornado {tornado.version}')"]);
  if (versions === null) { console.log(`NOT RUN: jupyter-server-proxy, since it is not installed for ${PYTHON}`); return; }
  console.log(versions);
  const [port, home] = [await freePort(), path.join(folder, "home")];
  mkdirSync(home);
  const places = Object.fromEntries(["HOME", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR"].map((variable) => [variable, home]));
  const settings = [
    "ip=127.0.0.1", `port=${port}`, "port_retries=0", "base_url=/user/me/", `root_dir=${home}`, "open_browser=False", "allow_root=True",
    `local_hostnames=['${PORTAL}']`, "jpserver_extensions={'jupyter_server_proxy': True}",
  ].map((setting) => `--ServerApp.${setting}`);
  const server = await startProxy(PYTHON, ["-m", "jupyter_server", ...settings, `--IdentityProvider.token=${SECRET}`], port, places);
  // A visitor who is not known yet: the page's address leads to Jupyter's login, and from there to the page.
  const enter = async (page, address) => {
    await page.goto(address);
    await page.fill("input[name=password]", SECRET);
    await Promise.all([page.waitForURL((url) => url.pathname.includes("/proxy/")), page.click("#login_submit")]);
  };
  const addresses = (page, token) => ({ "/proxy/PORT/": `http://${PORTAL}:${port}/user/me/proxy/${page}/?token=${token}` });
  await tryProxy("jupyter-server-proxy", { reach: ["--allow-host", PORTAL], addresses, enter });
  await stop(server);
}

/** Apache with the lines of Open OnDemand's ood-portal.conf that concern nodes, and basic authentication; its second port passes on the browser's host name. */
const portalSettings = ({ ports: [port, preserving], lua, users }) => `
ServerRoot ${folder}
PidFile ${folder}/apache.pid
ErrorLog "|/bin/cat"
ServerName ${PORTAL}
Listen 127.0.0.1:${port}
Listen 127.0.0.1:${preserving}
${MODULES.map((name) => `LoadModule ${name}_module /usr/lib/apache2/modules/mod_${name}.so`).join("\n")}
${userInfo().uid === 0 ? "User www-data\nGroup www-data" : ""}
LuaRoot ${lua}
SetEnv OOD_USER_MAP_MATCH .*
${[["node", ""], ["rnode", "(?<uri>/.*|)"]].map(([name, rest]) => `<LocationMatch "^/${name}/(?<host>[^/]+)/(?<port>\\d+)${rest}">
  AuthType Basic
  AuthName portal
  AuthUserFile ${users}
  Require valid-user
  LuaHookFixups node_proxy.lua node_proxy_handler
</LocationMatch>`).join("\n")}
<VirtualHost 127.0.0.1:${preserving}>
  ProxyPreserveHost On
</VirtualHost>
`;

async function onDemand() {
  const version = printed("apache2", ["-v"]);
  const lua = path.resolve(process.env.ONDEMAND ?? "", "mod_ood_proxy/lib");
  const missing = [[version, "apache2 is not installed"], [existsSync("/usr/share/lua/5.3/posix"), "lua-posix is not installed"], [existsSync(lua), "ONDEMAND does not name its sources"]];
  const why = missing.find(([found]) => !found)?.[1];
  if (why) { console.log(`NOT RUN: Open OnDemand, since ${why}`); return; }
  console.log(`Open OnDemand's Lua in ${version.split("\n")[0]}`);
  const [ports, users, settings] = [[await freePort(), await freePort()], path.join(folder, "users"), path.join(folder, "apache.conf")];
  const username = userInfo().username;
  // Apache may run as another user, who must reach the file.
  chmodSync(folder, 0o711);
  writeFileSync(users, `${username}:{SHA}${createHash("sha1").update(SECRET).digest("base64")}\n`);
  writeFileSync(settings, portalSettings({ ports, lua, users }));
  const server = await startProxy("apache2", ["-DFOREGROUND", "-f", settings], ports[0]);
  const node = hostname();
  const { address } = await lookup(node);
  const reach = ["--bind", address, "--allow-host", PORTAL, "--allow-host", node];
  const addresses = (page, token) => Object.fromEntries(["node", "rnode"].flatMap((name) => ports.map((port, preserving) => [
    `/${name}/, ${preserving ? "name of the portal" : "name of the node"}`, `http://${PORTAL}:${port}/${name}/${node}/${page}/?token=${token}`,
  ])));
  await tryProxy("Open OnDemand", { reach, addresses, context: { httpCredentials: { username, password: SECRET } } });
  await stop(server);
}

await jupyter();
await onDemand();
