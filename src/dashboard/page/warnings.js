// What the viewer must not overlook: conditions that hold now, and a log of what happened, each in bounds.
import { count, duration, number, percent } from "./words.js";

// A condition that only a single frame shows stays this long.
const HOLD = 15_000;
const MOST_ENTRIES = 100;
// Of many records that arrive together, only these are news.
const FRESH = 5;
// Said with the first frame of each slide of which it is true.
const COARSE_IN_TIME = /\bcoarse in time\b/;
const LOST_SIMULATION = /\bsimulation (is gone|has ended)\b/;
const UNTRUSTED = "The surrogate is trusted nowhere yet: in no part of the domain is its measured error within the tolerance";

/** Messages, newest first; those that differ in numbers only are one entry with a count. */
export class Log {
  constructor() {
    this.entries = new Map();
    this.version = 0;
  }

  add(text, frame = null) {
    const key = text.replace(/\d+(\.\d+)?(e[+-]?\d+)?/g, "#");
    const times = (this.entries.get(key)?.times ?? 0) + 1;
    this.entries.delete(key);
    this.entries.set(key, { text, times, frame, at: new Date() });
    if (this.entries.size > MOST_ENTRIES) this.entries.delete(this.entries.keys().next().value);
    this.version += 1;
  }

  newestFirst() {
    return [...this.entries.values()].reverse();
  }
}

const lostSteps = (live) => (live?.missed_blocks ?? 0) + (live?.steps_incomplete ?? 0);

export class Warnings {
  constructor() {
    this.log = new Log();
    this.forget();
  }

  /** Starts anew with another run. The log stays. */
  forget() {
    this.held = new Map();
    this.live = null;
    this.lostAtStep = null;
    this.coarse = null;
    this.untrusted = null;
  }

  /** Tells of something now, and logs it. `id` is one of a few. */
  hold(id, text, frame = null, fresh = true) {
    this.log.add(text, frame);
    if (fresh) this.held.set(id, { text, until: performance.now() + HOLD });
  }

  /** Takes in records that arrived together. */
  read(records) {
    records.forEach((record, index) => this.readOne(record, index >= records.length - FRESH));
  }

  readOne(record, fresh) {
    const { frame, tolerance_excess: excess, over_budget: overBudget, checkpoint } = record;
    if (excess > 0) this.hold("tolerance", `Error of the colours (optical residual) above the tolerance by ${number(excess)}, rms`, frame, fresh);
    if (overBudget > 0) {
      this.hold("budget", `Tracing budget spent: ${count(overBudget)} queries in untrusted cells were answered by the surrogate`, frame, fresh);
    }
    if (checkpoint?.failed) this.hold("checkpoint", `A checkpoint could not be written: ${checkpoint.failed}`, frame, fresh);
    const warnings = Array.isArray(record.warnings) ? record.warnings.map(String) : [];
    this.readWarnings(warnings, frame, fresh);
    this.readCoarse(record.slide, warnings.find((text) => COARSE_IN_TIME.test(text)));
    this.readTrust(record);
    if (record.live) this.readLive(record, fresh);
  }

  readWarnings(texts, frame, fresh) {
    for (const text of texts) this.hold("run", text, frame, fresh);
    if (fresh && texts.length > 1) this.held.get("run").text += ` (and ${texts.length - 1} more: see the messages)`;
  }

  /** Holds for all frames of a slide. */
  readCoarse(slide, text) {
    if (text !== undefined) this.coarse = { slide, text };
    else if (this.coarse !== null && slide !== this.coarse.slide) this.coarse = null;
  }

  /** Of the method that traces where the surrogate is not trusted. Holds until something is trusted, and is logged once. */
  readTrust({ frame, method, trusted_error: trusted, traced_share: share }) {
    if (method !== "gated" || trusted !== null) { this.untrusted = null; return; }
    if (this.untrusted === null) this.log.add(UNTRUSTED, frame);
    this.untrusted = share === 1 ? `${UNTRUSTED}, so that all is traced` : UNTRUSTED;
  }

  readLive({ live, frame, warnings }, fresh) {
    const before = this.live;
    if (lostSteps(live) > lostSteps(before)) {
      const words = `${count(live.missed_blocks)} blocks overwritten or ignored, ${count(live.steps_incomplete)} steps incomplete`;
      this.hold("drops", `Data of the simulation were lost: so far ${words}`, frame, fresh);
    }
    if (live.steps_skipped > (before?.steps_skipped ?? 0)) {
      const error = live.interpolation_error == null ? "" : `; between the others the velocity is off by ${percent(live.interpolation_error)}`;
      this.hold("coarse", `Coarse in time: so far ${count(live.steps_skipped)} steps were left out for lack of memory${error}`, frame, fresh);
    }
    if (live.restarts > (before?.restarts ?? 0)) this.hold("restart", `The simulation restarted: so far ${count(live.restarts)} times`, frame, fresh);
    if (Array.isArray(warnings) && warnings.some((text) => LOST_SIMULATION.test(text))) this.lostAtStep = live.step;
    else if (live.step !== this.lostAtStep) this.lostAtStep = null;
    this.live = live;
  }

  /** Conditions that hold now, most urgent first: `{ id, level, text, tick }`. `tick` changes all the time and is not announced. */
  conditions(view) {
    const now = performance.now();
    const found = connectionConditions(view, now);
    if (this.lostAtStep !== null) {
      found.push({ id: "simulation", level: "critical", text: "The simulation has ended or is gone. The picture shows its last steps." });
    }
    if (this.coarse !== null) found.push({ id: "time", level: "warning", text: `Too ${this.coarse.text}` });
    if (this.untrusted !== null) found.push({ id: "untrusted", level: "warning", text: this.untrusted });
    for (const [id, { text, until }] of this.held) {
      if (until > now) found.push({ id, level: id === "tolerance" ? "critical" : "warning", text });
      else this.held.delete(id);
    }
    return found;
  }
}

function connectionConditions(view, now) {
  const silence = duration(view.silence);
  if (view.link === "refused") {
    const text = "Not admitted: the token is missing or no longer valid. Open the address that ridgewatch printed.";
    return [{ id: "link", level: "critical", text }];
  }
  if (view.link === "displaced") {
    return [{ id: "link", level: "critical", text: "Too many pages are open, and this one gave way. Reload it to come back." }];
  }
  if (view.link === "lost") {
    const tick = view.retryAt === null ? "trying again" : `trying again in ${Math.max(0, Math.ceil((view.retryAt - now) / 1000))} s`;
    return [{ id: "link", level: "critical", text: "Connection to the dashboard's server lost.", tick }];
  }
  if (view.link !== "open") return [];
  const found = [];
  if (view.problem) found.push({ id: "problem", level: "critical", text: view.problem });
  if (view.status === "waiting" && view.record) {
    found.push({ id: "silent", level: "critical", text: "Nothing has arrived since this server started. The picture is of an earlier time." });
  }
  if (view.status === "silent") {
    found.push({ id: "silent", level: "critical", text: "Nothing new arrives: the run has ended, pauses, or is lost.", tick: `silent for ${silence}` });
  }
  return found;
}
