// Records in words and numbers. Unknown values are a dash or "unknown", never 0.

export const DASH = "–";

const known = (value) => typeof value === "number" && Number.isFinite(value);
const whole = new Intl.NumberFormat("en-GB", { maximumFractionDigits: 0 });

export const count = (value) => (known(value) ? whole.format(value) : DASH);

/** Three significant digits, without an exponent where that is readable. */
export function number(value, digits = 3) {
  if (!known(value)) return DASH;
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e6)) return value.toExponential(digits - 1).replace("-", "−").replace("e-", "e−").replace("e+", "e");
  const decimals = size === 0 ? 0 : Math.max(0, digits - 1 - Math.floor(Math.log10(size)));
  return String(Number(value.toFixed(decimals))).replace("-", "−");
}

export const withUnit = (value, unit) => (known(value) && unit ? `${number(value)} ${unit}` : number(value));
export const percent = (share, digits = 2) => (known(share) ? `${number(100 * share, digits)} %` : DASH);

/** A time of the source, with enough digits to keep neighbouring slides apart. */
export const time = (value, unit, digits = 6) => (known(value) ? number(value, digits) + (unit ? ` ${unit}` : "") : DASH);

/** Duration in seconds, as one reads it on a watch. */
export function duration(seconds) {
  if (!known(seconds)) return DASH;
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${Math.floor(seconds)} s`;
  if (seconds < 7200) return `${Math.floor(seconds / 60)} min`;
  return `${Math.floor(seconds / 3600)} h`;
}

/** Root mean square error as a share of full brightness, from a PSNR in decibels. */
export const shareOfPeak = (psnr) => (known(psnr) ? 10 ** (-psnr / 20) : null);

/** Seconds between the publication of a simulation step and the finished frame; null for other sources. */
export function lag(record) {
  const age = record?.live?.age;
  return known(age) ? age + (record.seconds?.total ?? 0) : null;
}

const overBudget = (record) => record.over_budget > 0;

/**
 * Root mean square of the optical residual where the surrogate answered; null if unknown. Where it also answered untrusted queries, since the tracing budget was
 * spent, the record tells by how much their error is above the tolerance: an error within it counts as large as that.
 */
export function surrogateError(record) {
  const { tolerance, tolerance_excess: excess, trusted_error: trusted } = record;
  const untrusted = overBudget(record) && known(tolerance) && known(excess) ? tolerance + excess : null;
  const errors = [trusted?.optical_rms, untrusted].filter(known);
  return errors.length > 0 ? Math.max(...errors) : null;
}

function errorWords(record) {
  const psnr = record.picture_error?.psnr?.value;
  if (known(psnr)) return `error ${percent(shareOfPeak(psnr))} (${number(psnr, 2)} dB)`;
  const error = surrogateError(record);
  const where = overBudget(record) ? "where the surrogate answered" : "where trusted";
  return known(error) ? `error ${where} ${percent(error)}, of the picture unknown` : "error unknown";
}

function lagWords(record) {
  if (!record.live) return null;
  const behind = lag(record);
  return known(behind) ? `${duration(behind)} behind the simulation` : "lag unknown";
}

// Share traced from which the surrogate saves next to nothing.
const NOTHING_SAVED = 0.9;

/** Seeds of a map since it began anew; null if unknown. */
function seedWords({ picture_error: error }) {
  return known(error?.samples_per_pixel) ? `${count(error.samples_per_pixel)} seeds a pixel` : null;
}

const SURROGATES = { table: "a table", network: "a network", residual: "a table with a network" };

/** What drew the picture, and what was traced for it, of methods whose picture is the surrogate's; null of others. Of what they trace a share tells nothing: it is all of it. */
function drawnWords({ method, surrogate, traced }) {
  const drawn = `drawn by ${SURROGATES[surrogate] ?? "a surrogate"}`;
  const points = known(traced) ? `${count(traced)} traced points` : "traced points";
  if (method === "two_level") return `${drawn} and corrected with ${points}`;
  return method === "marched" ? `${drawn}, uncorrected: ${points} only measure its error` : null;
}

// Methods that trace all queries of their picture, or none.
const SHARE_IS_FIXED = new Set(["map", "reference", "surrogate", "marched", "two_level"]);

/** Share of the queries that was traced; null if it is unknown, and of methods of which it tells nothing. */
export const tracedShare = ({ method, traced_share: share }) => (known(share) && !SHARE_IS_FIXED.has(method) ? share : null);

function tracedWords(record) {
  if (record.method === "map") return seedWords(record);
  const drawn = drawnWords(record);
  if (drawn !== null) return drawn;
  const share = record.traced_share;
  if (!known(share)) return "share traced unknown";
  const saved = record.method === "gated" && share >= NOTHING_SAVED;
  return saved ? `the surrogate saved nothing: ${percent(share)} was traced` : `${percent(share)} traced`;
}

const stepWords = (record) => (record.live ? `step ${count(record.live.step)}` : null);

/** Frame, slide, step of the simulation, time, lag, error and what was traced of a record. */
export function frameWords(record) {
  const when = record.date ? `t = ${record.date}` : `t = ${time(record.time, record.time_unit)}`;
  const state = [lagWords(record), errorWords(record), tracedWords(record)];
  return [`frame ${count(record.frame)}`, `slide ${count(record.slide)}`, stepWords(record), when, ...state].filter(Boolean).join(", ");
}

/** The sentence of state. `view` has `link`, `status`, `endpoint`, `silence` (seconds), `work` (what the run is at for long, in words), `record` (newest) and `back` (`{ record, behind }` while looking back). */
export function sentence(view) {
  const state = stateWords(view);
  const isNow = view.link === "open" && !view.back;
  return isNow && view.work ? `${state}; now ${view.work}.` : `${state}.`;
}

function stateWords(view) {
  const words = view.record ? frameWords(view.record) : null;
  if (view.back) return `Looking back, ${count(view.back.behind)} frames before the newest: ${frameWords(view.back.record)}`;
  if (view.link !== "open") {
    const state = { connecting: "Connecting", refused: "Not admitted" }[view.link] ?? "Not connected";
    return words ? `${state}; last seen: ${words}` : state;
  }
  if (view.status === "silent") return words ? `Silent for ${duration(view.silence)}; last: ${words}` : `Silent for ${duration(view.silence)}`;
  if (view.status === "paused" && words) return `The window is paused, ${words}`;
  if (view.status === "waiting" && words) return `Waiting for the publisher; last seen: ${words}`;
  if (words) return `Following, ${words}`;
  return view.endpoint ? `Waiting for the first frame from ${view.endpoint}` : "Waiting for the first frame";
}

/** Time span of the flow map: from t0 by tau, in the direction. */
export function windowWords(record) {
  if (!known(record.time) || !known(record.tau)) return DASH;
  const end = record.direction === "backward" ? record.time - record.tau : record.time + record.tau;
  return `${time(record.time)} to ${time(end, record.time_unit)}`;
}

/** What of the picture rests on a network that is not trusted there. */
const untracedWords = (record) => (record.untraced_share > 0 ? `; ${percent(record.untraced_share)} of the nodes, about what is not trusted, still show the network` : "");

/** Rows of the table beside the picture: term, text. */
export function facts(record, header) {
  const estimate = record.picture_error?.psnr;
  const interval = estimate ? `${number(estimate.value)} dB, 95 % between ${number(estimate.low)} and ${number(estimate.high)}` : DASH;
  return {
    time: record.date ? `${record.date} (${time(record.time, record.time_unit)})` : time(record.time, record.time_unit),
    tau: `${time(record.tau, record.time_unit)}, ${record.direction || "direction unknown"}`,
    window: windowWords(record),
    source: record.source || DASH,
    method: [record.method, record.surrogate].filter(Boolean).join(", ") || DASH,
    device: record.device || DASH,
    size: `${record.size?.join(" × ") ?? DASH} pixels, ${(record.method === "map" && seedWords(record)) || `${number(record.samples_per_pixel)} samples a pixel`}`,
    psnr: interval,
    traced: drawnWords(record) ?? `${percent(record.traced_share)} of ${count(known(record.queries) ? record.queries - (record.missing ?? 0) : null)} queries`,
    trusted: `${percent(record.trusted_volume)} of the domain${untracedWords(record)}`,
    seconds: `${number(record.seconds?.total)} s`,
    slide: count(record.slide),
    step: record.live ? `step ${count(record.live.step)}, ${count(record.live.snapshots)} in the window` : DASH,
    picture: header ? `frame ${count(header.frame)}, ${header.encoding}` : DASH,
  };
}
