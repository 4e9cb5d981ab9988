// The page: brings messages, picture, charts and words together.
import { Axes } from "./axes.js";
import { Charts, rowOf } from "./charts.js";
import { ColourBar } from "./colour_bar.js";
import { Connection } from "./connection.js";
import { Histogram } from "./histogram.js";
import { Records } from "./history.js";
import { Overlay } from "./overlay.js";
import { Picture, pictureBox } from "./picture.js";
import { followTheme, takeToken } from "./preferences.js";
import { Steering, steerBy, steeringKeys } from "./steering.js";
import { explainTerms, explained } from "./terms.js";
import { Values, address as fileAddress, asker, download, downloadField, fieldCommand, histogramAsker, pastAsker, pastLister, pictureAsker, pixelAt, planeAsker } from "./values.js";
import { Warnings } from "./warnings.js";
import { count, duration, facts, sentence } from "./words.js";

const REFRESH = 250;
// A sentence that is read aloud with every frame is of no use.
const ANNOUNCE = 30_000;
// What the run keeps is asked for again after so many milliseconds, when somebody looks back, or so many records that came and were dropped.
const PAST_AGE = 10_000;
const PAST_DROPPED = 1000;

const element = (id) => document.getElementById(id);
const setText = (node, text) => { if (node.textContent !== text) node.textContent = text; };

const records = new Records();
const warnings = new Warnings();
const token = takeToken();
const colourBar = new ColourBar(element("colour-bar"));
const picture = new Picture(element("frame"), pictureChanged, { ask: pastAsker(token), lost: pictureLost });
const charts = new Charts(element("charts"), (frame) => lookBack(picture.kept.nearest(frame)));

const steering = new Steering({
  say: (message) => connection.say(message),
  told: (text, frame, urgent) => (urgent ? warnings.hold("command", text, frame) : warnings.log.add(text, frame)),
  // A command is followed live.
  acted: () => { if (picture.held) picture.follow(); },
  // A newer range may wait.
  refused: (set) => { if (set.transfer && steering.waiting.transfer === undefined) histogram.forget(); },
});

const values = new Values({
  ask: asker(token),
  show: (text, hint = "") => { setText(element("values"), text); element("values").title = hint; },
});

const overlay = new Overlay({ ask: planeAsker(token), canvas: element("overlay"), root: element("overlaying") });
const axes = new Axes({ root: element("axes"), canvas: element("frame"), toggle: element("axes-on") });
const histogram = new Histogram({
  root: element("histogram"),
  ask: histogramAsker(token),
  change: (range) => steering.command({ transfer: range }),
});

const askPicture = pictureAsker(token);
const listPast = pastLister(token);

let connection;
let newest = null;
// The server, and the number of the record that it sends next.
let counted = { server: null, next: 0 };
let server = null;
let heard = null;
let chartsDue = false;
let logVersion = -1;
// The items of the log, by entry; what changes is another entry.
const logItems = new WeakMap();
let announced = { kind: null, at: 0 };
// When it was asked what the run keeps, and whether an answer is on its way.
let past = { at: null, busy: false };

// Messages

/** Records that were not received before. A server repeats what it keeps to a client that returns. */
function unseen(list) {
  if (newest === null) return list;
  const seen = list.findLastIndex((record) => record.frame === newest.frame && record.seconds?.elapsed === newest.seconds?.elapsed);
  return list.slice(seen + 1).filter((record) => !records.has(rowOf(record)));
}

/** Records behind those that this server has sent already, by their numbers there. */
function behind({ records: list, server, first }) {
  const next = server === counted.server ? counted.next : 0;
  counted = { server, next: Math.max(next, first + list.length) };
  return list.slice(Math.max(0, next - first));
}

function receiveRecords(message) {
  const isKnown = message.server === counted.server;
  const list = behind(message).filter((record) => Number.isFinite(record?.frame));
  const fresh = isKnown ? list : unseen(list);
  // What a server tells first is the past.
  const watched = newest !== null;
  for (const record of fresh) {
    const missing = records.missing;
    if (records.add(rowOf(record))) beginRun(record.frame, watched);
    else if (records.missing > missing) warnings.hold("gaps", `${count(records.missing - missing)} records did not arrive`, record.frame);
    newest = record;
  }
  warnings.read(fresh);
  steering.receiveRecords(fresh);
  chartsDue ||= fresh.length > 0;
}

/** Takes in what the run keeps, if that is known and not fresh. */
async function refreshPast() {
  if (server?.has_past !== true || past.busy || (past.at !== null && performance.now() - past.at < PAST_AGE)) return;
  past = { at: performance.now(), busy: true };
  try {
    const { frames, records: list } = await listPast();
    picture.kept.setPast(frames);
    records.setPast(list.filter((record) => Number.isFinite(record?.frame)).map(rowOf));
    chartsDue = true;
    showPosition();
  } catch {
    // The page has what it received; it is asked again when somebody looks back.
  }
  past.busy = false;
}

function pictureLost(lost, error) {
  // Of a server that is busy or away it may come later.
  if (error.isGone) picture.kept.lose(lost);
  warnings.hold("past", `The picture of frame ${count(lost.frame)} cannot be shown: ${error.message}`, lost.frame);
  showPosition();
}

function beginRun(frame, watched) {
  past.at = null;
  warnings.forget();
  warnings.hold("new", "A new run began", frame, watched);
}

async function receiveFrame({ sequence, header, payload }, reply) {
  try {
    await picture.receive(header, payload);
  } catch (error) {
    warnings.hold("picture", `The picture of frame ${count(header?.frame)} was skipped: ${error.message}`, header?.frame ?? null);
  }
  // Also for a skipped picture, or none would follow.
  reply(sequence);
}

/** The chart of speed against accuracy, which is fetched once it is opened. */
function showChart(exists) {
  const section = element("accuracy");
  section.hidden = !exists;
  const picture = section.querySelector("img");
  if (exists && !picture.hasAttribute("src")) {
    picture.loading = "lazy";
    picture.src = fileAddress("chart.svg", token, {});
  }
}

function receiveState(state) {
  server = state;
  steering.receiveState(state);
  values.receiveState(state);
  overlay.receiveState(state);
  histogram.receiveState(state);
  showChart(state.has_chart === true);
  heard = Number.isFinite(state.seconds_since_message) ? performance.now() - 1000 * state.seconds_since_message : null;
}

const RECEIVERS = {
  frame: receiveFrame,
  records: receiveRecords,
  state: receiveState,
  answer: (answer) => steering.receiveAnswer(answer),
};

// Showing

const silence = () => (heard === null ? null : (performance.now() - heard) / 1000);

function currentView() {
  const back = picture.held && picture.shown?.header.record;
  return {
    link: connection.status,
    retryAt: connection.retryAt,
    // A run that was told to pause is not lost.
    status: steering.paused && ["following", "silent"].includes(server?.status) ? "paused" : server?.status,
    endpoint: server?.endpoint,
    problem: server?.problem,
    silence: silence(),
    work: server?.work,
    record: newest,
    back: back ? { record: back, behind: newest === null ? null : newest.frame - back.frame } : null,
  };
}

function kindOf(view) {
  if (view.link !== "open") return view.link;
  if (["silent", "waiting", "paused"].includes(view.status)) return view.status;
  return view.back ? "back" : "following";
}

const STALE = ["lost", "refused", "displaced", "silent", "waiting"];

function pictureChanged(shown) {
  const { record } = shown.header;
  element("no-picture").hidden = true;
  element("frame").setAttribute("aria-label", `FTLE field of frame ${count(shown.frame)}`);
  colourBar.show(shown.header);
  if (record) showFacts(facts(record, shown.header));
  axes.show(record);
  element("scale-light").hidden = record?.method === "map";
  showPosition();
  charts.mark(picture.held ? shown.frame : null);
  [values.frame, values.shown] = [heldFrame(), shown.frame];
  values.changed();
  overlay.look(heldFrame(), newest?.frame ?? null);
}

/** Number of the frame that is looked back at; null while the newest is followed. */
const heldFrame = () => (picture.held ? picture.shown.frame : null);

function showFacts(values) {
  for (const node of document.querySelectorAll("[data-fact]")) setText(node, values[node.dataset.fact]);
}

function showPosition() {
  const [last, index] = [picture.kept.all.length - 1, picture.position()];
  const scrub = element("scrub");
  scrub.max = Math.max(last, 0);
  scrub.value = Math.max(index, 0);
  const text = picture.shown ? `frame ${count(picture.shown.frame)}` : "–";
  setText(element("position"), text);
  scrub.setAttribute("aria-valuetext", text);
  element("live").setAttribute("aria-pressed", String(!picture.held));
  setText(element("live"), picture.held ? "Back to live" : "Live");
  element("earlier").disabled = index <= 0;
  element("later").disabled = index >= last;
  for (const button of document.querySelectorAll("[data-save]")) button.disabled = picture.shown === null;
  element("field").disabled = picture.shown === null;
}

function conditionItem({ id, level, text, tick }) {
  const item = element(`warning-${id}`) ?? Object.assign(document.createElement("li"), { id: `warning-${id}` });
  if (item.childElementCount === 0) {
    item.append(document.createElement("strong"), document.createElement("span"));
    item.lastChild.ariaHidden = "true";
  }
  item.className = level;
  if (item.firstChild.textContent !== text) item.firstChild.replaceChildren(...explained(text));
  setText(item.lastChild, tick ?? "");
  return item;
}

/** Makes these the items of a list. Those that stay are left alone, and keep the focus. */
function arrange(list, items) {
  for (const old of [...list.children]) if (!items.includes(old)) old.remove();
  items.forEach((item, index) => { if (list.children[index] !== item) list.insertBefore(item, list.children[index] ?? null); });
}

function logItem(entry) {
  const { text, times, frame, at } = entry;
  if (logItems.has(entry)) return logItems.get(entry);
  const item = document.createElement("li");
  const when = document.createElement("time");
  when.dateTime = at.toISOString();
  when.textContent = at.toLocaleTimeString("en-GB");
  item.append(when, ` ${frame === null ? "" : `frame ${count(frame)}: `}`, ...explained(text), times > 1 ? ` (${count(times)} times)` : "");
  logItems.set(entry, item);
  return item;
}

function showLog() {
  if (warnings.log.version === logVersion) return;
  logVersion = warnings.log.version;
  const entries = warnings.log.newestFirst();
  setText(element("message-count"), String(entries.length));
  arrange(element("log"), entries.map(logItem));
}

function announce(kind, text) {
  const now = performance.now();
  if (kind === announced.kind && now - announced.at < ANNOUNCE) return;
  announced = { kind, at: now };
  setText(element("announcement"), text);
}

function showState() {
  const view = currentView();
  const kind = kindOf(view);
  const text = sentence(view);
  setText(element("state"), text);
  element("state").dataset.kind = kind;
  setText(element("source"), newest?.source ?? "");
  announce(kind, text);
  arrange(element("warnings"), warnings.conditions(view).map(conditionItem));
  const stale = STALE.includes(kind) && picture.shown !== null && !picture.held;
  element("stage").classList.toggle("stale", stale);
  element("age").hidden = !stale;
  if (stale) setText(element("age"), heard === null ? "old" : `${duration(silence())} old`);
  setText(element("about"), server ? `ridgewatch ${server.version ?? ""} at ${server.endpoint ?? "–"}, ${count(server.clients)} watching` : "");
}

function showSteering() {
  const { obstacle } = steering;
  const can = obstacle === null;
  element("frame").classList.toggle("steered", can);
  for (const node of document.querySelectorAll("#steering .steers")) node.hidden = !can;
  setText(element("obstacle"), obstacle ?? "");
  setText(element("pause"), steering.paused ? "Continue the run" : "Pause the run");
  element("pause").setAttribute("aria-pressed", String(steering.paused));
  if (can && !document.hidden) histogram.refresh(newest, picture.kept.list.at(-1)?.header.color_bar?.colors);
  const { method, budget, tau, direction, longest_tau: longest } = steering.ready ?? {};
  for (const [id, value] of Object.entries({ method, direction })) if (document.activeElement !== element(id)) element(id).value = value ?? "";
  element("tau").max = longest ?? "";
  element("budget").disabled = method !== "two_level";
  for (const id of ["tolerance", "extinction", "albedo"]) element(id).disabled = method === "map";
  element("method").options[0].disabled = steering.ready?.dimensions !== 2;
  const values = { budget, tau, tolerance: newest?.tolerance, extinction: newest?.transfer?.extinction, ...(histogram.range ?? { low: null, high: null }) };
  for (const [id, value] of Object.entries(values)) {
    // Not while it is typed.
    if (document.activeElement !== element(id)) element(id).value = Number.isFinite(value) ? Number(value.toPrecision(6)) : "";
  }
  setText(element("ways"), steering.flat ? "Drag moves, the wheel or two fingers zoom, a double click goes home." : "Drag turns, shift-drag or two fingers move, the wheel or two fingers zoom, a double click goes home.");
}

async function save(ending) {
  const told = await download(ending, { token, kept: values.kept, shown: picture.shown, held: picture.held });
  if (told !== null) warnings.hold("download", told, picture.shown.frame);
}

// Ends the tracing of a field.
let fieldEnd = null;

/** Saves the pixels of a map; of other frames the field of the slide, which is traced first, and shows the command for it. A second click ends both. */
async function showField() {
  const [told, { record }] = [element("field-told"), picture.shown.header];
  fieldEnd?.abort();
  if (record?.method === "map" && told.hidden) {
    const problem = await download("nc", { token, kept: values.kept, shown: picture.shown, held: picture.held });
    if (problem === null) return;
    warnings.hold("download", problem, picture.shown.frame);
  }
  told.hidden = !told.hidden || !record;
  element("field").setAttribute("aria-expanded", String(!told.hidden));
  if (told.hidden) return;
  const { words, command } = fieldCommand(values.kept?.ready ?? "run", server?.endpoint, record);
  setText(element("field-words"), words);
  setText(element("field-command"), command ?? "");
  fieldEnd = new AbortController();
  const { signal } = fieldEnd;
  const tell = (text) => { if (!signal.aborted) setText(element("field-state"), text); };
  tell("");
  if (record.method === "map" || values.kept?.ready === undefined) return;
  try {
    const name = await downloadField({ token, slide: picture.held ? record.slide : null, tell, signal });
    tell(`Saved: ${name}.`);
  } catch (error) {
    tell(`No field from the run: ${error.message}.`);
  }
}

async function share() {
  const address = new URL("./", location.href);
  address.searchParams.set("token", server?.token_to_share ?? "");
  const text = address.href;
  try {
    await navigator.clipboard.writeText(text);
    setText(element("share"), "Copied");
  } catch {
    prompt("Address for those who only watch:", text);
  }
}

function refresh() {
  if (values.kept?.ready !== undefined && connection.status === "open") picture.refine(askPicture);
  if (newest !== null && (past.at === null || records.dropped > PAST_DROPPED)) refreshPast();
  showState();
  showSteering();
  showLog();
  if (!chartsDue || document.hidden) return;
  chartsDue = false;
  element("no-charts").hidden = true;
  charts.update(records.all);
}

// Controls

function lookBack(index) {
  refreshPast();
  picture.lookBack(index);
}

const step = (by) => lookBack(picture.position() + by);
const toggleLive = () => (picture.held ? picture.follow() : picture.hold());

function toggleFullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else element("picture").requestFullscreen?.().catch(() => warnings.log.add("This browser refuses full screen"));
}

const switchTheme = followTheme(() => charts.restyle());

const KEYS = {
  " ": toggleLive,
  ArrowLeft: () => step(-1),
  ArrowRight: () => step(1),
  Home: () => lookBack(0),
  End: () => picture.follow(),
  o: () => overlay.cycle(element("overlay-of")),
  g: () => axes.toggle(),
  f: toggleFullScreen,
  t: switchTheme,
  "?": () => element("help").showModal(),
  ...steeringKeys(steering),
};

function pressKey(event) {
  const { key, target } = event;
  const types = target.matches("input[type=number], select");
  const used = types || event.ctrlKey || event.altKey || event.metaKey || element("help").open || (key === " " && target.closest("button, summary, input[type=checkbox]"));
  if (used || KEYS[key] === undefined) return;
  event.preventDefault();
  KEYS[key]();
}

element("live").addEventListener("click", toggleLive);
element("earlier").addEventListener("click", () => step(-1));
element("later").addEventListener("click", () => step(1));
element("scrub").addEventListener("input", (event) => lookBack(event.target.valueAsNumber));
element("full-screen").addEventListener("click", toggleFullScreen);
element("theme").addEventListener("click", switchTheme);
element("open-help").addEventListener("click", () => element("help").showModal());
document.addEventListener("keydown", pressKey);
steerBy(element("frame"), steering);
const point = (event) => values.point(pixelAt(event, pictureBox(element("frame")), [element("frame").width, element("frame").height]), heldFrame());
for (const type of ["pointermove", "pointerdown"]) element("frame").addEventListener(type, (event) => picture.shown && point(event));
// A finger that is lifted leaves the value of its pixel.
element("frame").addEventListener("pointerleave", (event) => event.pointerType === "touch" || values.point(null, null));
for (const button of document.querySelectorAll("[data-save]")) button.addEventListener("click", () => save(button.dataset.save));
element("field").addEventListener("click", showField);
element("pause").addEventListener("click", () => steering.togglePause());
element("home").addEventListener("click", () => steering.home());
element("share").addEventListener("click", share);
for (const [id, key] of [["tolerance", "trust.tolerance"], ["extinction", "transfer.extinction"], ["budget", "render.budget"], ["tau", "time.tau"]]) {
  element(id).addEventListener("change", ({ target }) => {
    if (Number.isFinite(target.valueAsNumber)) steering.command({ [key]: target.valueAsNumber });
  });
}
for (const [id, key] of [["method", "render.method"], ["direction", "time.direction"], ["albedo", "transfer.albedo"]]) {
  element(id).addEventListener("change", ({ target }) => {
    steering.command({ [key]: target.value });
    // The colours in effect are in the colour bar.
    if (id === "albedo") target.value = "";
    // Its keys are shortcuts again, and a value that is refused is not shown.
    target.blur();
  });
}
element("overlay-of").addEventListener("change", ({ target }) => {
  overlay.choose(target.value);
  // Its keys are shortcuts again.
  target.blur();
});
for (const id of ["low", "high"]) {
  element(id).addEventListener("change", ({ target }) => {
    // The other end may wait for its frame.
    if (Number.isFinite(target.valueAsNumber) && histogram.range) histogram.choose({ ...histogram.range, [id]: target.valueAsNumber });
  });
}

explainTerms(element("tip"), element("terms"));
showPosition();
connection = new Connection(token, {
  message: (message, reply) => RECEIVERS[message.kind]?.(message, reply),
  opened: () => { server = null; steering.abandon(); },
  broken: (error) => warnings.hold("message", `A message of the server was skipped: ${error.message}`),
});
setInterval(refresh, REFRESH);
