// The words of the page: unknown values are said as unknown.
import assert from "node:assert/strict";
import { test } from "node:test";
import { partsOf } from "../../../src/dashboard/page/terms.js";
import { Warnings } from "../../../src/dashboard/page/warnings.js";
import { duration, facts, lag, number, percent, sentence, shareOfPeak, surrogateError, tracedShare, windowWords } from "../../../src/dashboard/page/words.js";

const record = {
  frame: 8120, slide: 812, time: 3.2, time_unit: "s", date: null, tau: 2, direction: "backward", live: { age: 0.3, step: 40600 }, seconds: { total: 0.1 },
  picture_error: { psnr: { value: 41, low: 40, high: 42 } }, traced_share: 0.12,
};
const following = { link: "open", status: "following", record };

test("a followed simulation is told in one sentence", () => {
  const expected = "Following, frame 8,120, slide 812, step 40,600, t = 3.2 s, 0.4 s behind the simulation, error 0.89 % (41 dB), 12 % traced.";
  assert.equal(sentence(following), expected);
});

test("null and missing values are unknown and never 0", () => {
  for (const none of [null, undefined]) {
    const poor = { ...record, time: none, picture_error: none, trusted_error: none, traced_share: none, live: { age: none }, queries: none };
    const expected = "Following, frame 8,120, slide 812, step –, t = –, lag unknown, error unknown, share traced unknown.";
    assert.equal(sentence({ ...following, record: poor }), expected);
    assert.equal(facts(poor).traced, "– of – queries");
    assert.equal(windowWords(poor), "–");
    assert.equal(lag(poor), null);
    assert.deepEqual([number(none), percent(none), duration(none), shareOfPeak(none)], ["–", "–", "–", null]);
  }
  assert.ok(Object.values(facts({})).every((text) => typeof text === "string" && !/undefined|null|NaN/.test(text)));
});

test("without a calendar or a simulation neither is mentioned", () => {
  const text = sentence({ ...following, record: { ...record, live: null, time_unit: "" } });
  assert.equal(text, "Following, frame 8,120, slide 812, t = 3.2, error 0.89 % (41 dB), 12 % traced.");
});

test("a surrogate that saves nothing is told so", () => {
  const gated = { ...record, method: "gated", traced_share: 0.954 };
  assert.match(sentence({ ...following, record: gated }), /the surrogate saved nothing: 95 % was traced\.$/);
  assert.match(sentence({ ...following, record: { ...gated, method: "reference", traced_share: 1 } }), /, 100 % traced\.$/);
});

test("where a surrogate draws the picture, it is told what the traced points are for", () => {
  const two = { ...record, method: "two_level", surrogate: "table", traced_share: 1, traced: 2552 };
  const corrected = "drawn by a table and corrected with 2,552 traced points";
  assert.ok(sentence({ ...following, record: two }).endsWith(`error 0.89 % (41 dB), ${corrected}.`));
  assert.equal(facts(two).traced, corrected);
  const marched = { ...two, method: "marched", surrogate: "residual" };
  assert.match(sentence({ ...following, record: marched }), /, drawn by a table with a network, uncorrected: 2,552 traced points only measure its error\.$/);
  assert.match(sentence({ ...following, record: { ...two, surrogate: null, traced: null } }), /, drawn by a surrogate and corrected with traced points\.$/);
  for (const method of ["map", "reference", "surrogate", "marched", "two_level"]) assert.equal(tracedShare({ method, traced_share: 1 }), null);
  assert.deepEqual([tracedShare({ method: "gated", traced_share: 0.25 }), tracedShare({ method: "gated", traced_share: null })], [0.25, null]);
});

test("the error of the surrogate is that of what it answered", () => {
  const trusted = { over_budget: 0, tolerance: 0.03, tolerance_excess: null, trusted_error: { optical_rms: 0.02 } };
  assert.equal(surrogateError(trusted), 0.02);
  assert.equal(surrogateError({ ...trusted, trusted_error: null }), null, "all is traced");
  // Also where it is not trusted, since the tracing budget was spent.
  const spent = { ...trusted, over_budget: 12, tolerance_excess: 0.01, trusted_error: null };
  assert.equal(surrogateError(spent), 0.04);
  assert.equal(surrogateError({ ...spent, tolerance_excess: 0 }), 0.03, "within the tolerance");
  assert.equal(surrogateError({ ...spent, trusted_error: { optical_rms: 0.05 } }), 0.05, "the larger one");
  assert.equal(surrogateError({ ...spent, tolerance_excess: null }), null);
  const told = sentence({ ...following, record: { ...record, ...spent, picture_error: null, method: "gated" } });
  assert.match(told, /, error where the surrogate answered 4 %, of the picture unknown, 12 % traced\.$/);
});

test("terms of messages are found where they are used first, and not in settings, names and paths", () => {
  const found = (text) => partsOf(text).filter((part) => part.term).map(({ term, text: words }) => `${term}: ${words}`);
  assert.deepEqual(found("Slide 3: the log-stretch (FTLE times tau) of slide 3 differs"), ["slide: Slide", "stretch: log-stretch", "ftle: FTLE", "tau: tau"]);
  assert.deepEqual(found("the tracing budget was spent in untrusted cells"), ["trace_budget: tracing budget", "trusted: untrusted"]);
  assert.deepEqual(found("`trust.tolerance`, time.tau = 2, run-slide-3.nc and /data/slide/tau.nc"), []);
  const text = "error of the colours (optical residual) <b>above</b> the tolerance";
  assert.equal(partsOf(text).map((part) => part.text ?? part).join(""), text);
  assert.deepEqual(partsOf("plain"), ["plain"]);
});

test("a lost connection, a silent publisher and looking back are said first", () => {
  assert.match(sentence({ ...following, link: "lost" }), /^Not connected; last seen: frame 8,120/);
  assert.match(sentence({ ...following, status: "silent", silence: 12.3 }), /^Silent for 12 s; last: frame 8,120/);
  assert.match(sentence({ ...following, back: { record, behind: 20 } }), /^Looking back, 20 frames before the newest: frame 8,120/);
  assert.equal(sentence({ link: "open", status: "waiting", endpoint: "ipc:///x" }), "Waiting for the first frame from ipc:///x.");
});

test("what a run is at for long is said as long as the page is connected", () => {
  const work = "tracing the table: 25 %, about 9 s left";
  assert.equal(sentence({ link: "open", status: "waiting", endpoint: "ipc:///x", work }), `Waiting for the first frame from ipc:///x; now ${work}.`);
  assert.equal(sentence({ ...following, work }), sentence(following).replace(/\.$/, `; now ${work}.`));
  assert.equal(sentence({ ...following, work: undefined }), sentence(following));
  for (const change of [{ link: "lost" }, { back: { record, behind: 20 } }]) assert.doesNotMatch(sentence({ ...following, ...change, work }), /tracing/);
});

test("the window lies on the side of t0 to which particles are followed", () => {
  assert.equal(windowWords(record), "3.2 to 1.2 s");
  assert.equal(windowWords({ ...record, direction: "forward" }), "3.2 to 5.2 s");
});

test("numbers keep three digits", () => {
  assert.deepEqual([0, 0.0123456, 1.23456, 123.456, 12345.6, -0.5, 1e-7].map((value) => number(value)), ["0", "0.0123", "1.23", "123", "12346", "−0.5", "1.00e−7"]);
});

const conditions = (warnings, view = { link: "open", status: "following" }) => warnings.conditions(view).map(({ id }) => id);

test("what a frame warns of is a condition and a message", () => {
  const warnings = new Warnings();
  warnings.read([{ ...record, tolerance_excess: 0.004, over_budget: 3, live: { missed_blocks: 2, steps_incomplete: 0, steps_skipped: 1, restarts: 1, step: 5 } }]);
  assert.deepEqual(conditions(warnings), ["tolerance", "budget", "drops", "coarse", "restart"]);
  assert.equal(warnings.log.entries.size, 5);
});

test("a slide that is too coarse in time is told in all its frames", () => {
  const warnings = new Warnings();
  const text = "coarse in time: without every second snapshot the FTLE changes by 40 % of its root mean square";
  warnings.read([{ ...record, live: null, warnings: [text] }]);
  for (let frame = 1; frame < 40; frame += 1) warnings.read([{ ...record, live: null, frame: record.frame + frame, warnings: [] }]);
  const told = warnings.conditions({ link: "open", status: "following" }).find(({ id }) => id === "time");
  assert.equal(told.text, `Too ${text}`);
  warnings.read([{ ...record, live: null, slide: record.slide + 1, warnings: [] }]);
  assert.ok(!conditions(warnings).includes("time"));
});

test("a gate that trusts nothing is told until it does, and logged once", () => {
  const warnings = new Warnings();
  const gated = { ...record, live: null, method: "gated", trusted_error: null, traced_share: 1 };
  for (const frame of [1, 2, 3]) warnings.read([{ ...gated, frame }]);
  const told = () => warnings.conditions({ link: "open", status: "following" }).find(({ id }) => id === "untrusted")?.text;
  assert.match(told(), /^The surrogate is trusted nowhere yet: .* within the tolerance, so that all is traced$/);
  assert.deepEqual(warnings.log.newestFirst().map(({ times, frame }) => [times, frame]), [[1, 1]]);
  warnings.read([{ ...gated, traced_share: 0.5 }]);
  assert.match(told(), /within the tolerance$/);
  warnings.read([{ ...gated, trusted_error: { optical_rms: 0.02 } }]);
  assert.equal(told(), undefined);
  // Other methods do not depend on it.
  warnings.read([{ ...gated, method: "two_level" }]);
  assert.equal(told(), undefined);
});

test("counts that do not rise are no news", () => {
  const warnings = new Warnings();
  const live = { missed_blocks: 2, steps_incomplete: 1, steps_skipped: 4, restarts: 0, step: 5 };
  warnings.read([{ ...record, live }]);
  const before = warnings.log.version;
  warnings.read([{ ...record, live: { ...live, step: 6 } }]);
  assert.equal(warnings.log.version, before);
});

test("a lost simulation is told until its next step", () => {
  const warnings = new Warnings();
  const gone = "the simulation is gone: its process ended without closing the ring, or its relay is gone (block 0)";
  warnings.read([{ ...record, live: { step: 7 }, warnings: [gone] }]);
  warnings.read([{ ...record, live: { step: 7 }, warnings: [] }]);
  assert.ok(conditions(warnings).includes("simulation"));
  warnings.read([{ ...record, live: { step: 8 }, warnings: [] }]);
  assert.ok(!conditions(warnings).includes("simulation"));
});

test("messages that differ in numbers are one, and the log is bounded", () => {
  const warnings = new Warnings();
  for (let time = 0; time < 500; time += 1) warnings.read([{ ...record, frame: time, warnings: [`snapshot repeats time ${time}.5`] }]);
  assert.deepEqual(warnings.log.newestFirst().map(({ text, times }) => [text, times]), [["snapshot repeats time 499.5", 500]]);
  const letters = (value) => String(value).replace(/\d/g, (digit) => "abcdefghij"[digit]);
  for (let index = 0; index < 500; index += 1) warnings.log.add(letters(index));
  assert.equal(warnings.log.entries.size, 100);
  assert.equal(warnings.log.newestFirst()[0].text, letters(499));
});

test("a map tells its seeds, and has no share traced", () => {
  const map = { ...record, live: null, method: "map", traced_share: 1, picture_error: { ...record.picture_error, samples_per_pixel: 24 }, size: [320, 160] };
  assert.match(sentence({ ...following, record: map }), /error 0\.89 % \(41 dB\), 24 seeds a pixel\.$/);
  assert.equal(facts(map).size, "320 × 160 pixels, 24 seeds a pixel");
  assert.match(sentence({ ...following, record: { ...map, picture_error: null } }), /error unknown\.$/);
});
