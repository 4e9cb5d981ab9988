// What the run knows of the pixel under the pointer, and its newest frame as a file.
import { parseMessage } from "./protocol.js";
import { count, duration, number, percent, withUnit } from "./words.js";

// Between two questions, so that a pointer on its way asks little.
const SPACING = 50;
// Until the next one, where the layers of a later frame are on their way.
export const LATER = 1_000;
const LIMIT = 5_000;
const PLANE_LIMIT = 30_000;
const DOWNLOAD_LIMIT = 600_000;
// Between two questions how far a field is.
const FIELD_SPACING = 500;

/** The pixel of a picture at a place of the window; null outside. `box` is the rectangle in which the picture is drawn. */
export function pixelAt({ clientX, clientY }, box, [width, height]) {
  const [x, y] = [Math.floor(((clientX - box.left) / box.width) * width), Math.floor(((clientY - box.top) / box.height) * height)];
  return x >= 0 && y >= 0 && x < width && y < height ? [x, y] : null;
}

/** A channel, in which a thousandth of the light is not seen. */
const level = (value) => (Number.isFinite(value) && Math.abs(value) < 10 ? value.toFixed(3) : number(value));

/** One line about a pixel. */
export function valueWords({ frame, x, y, channels, unit, method, no_error: noError }) {
  const { R, G, B, A, error, "ftle.mean": ftle, "missing.share": missing } = channels;
  const where = `frame ${count(frame)} at ${x}, ${y}:`;
  if (missing === 1) return `${where} no data (land, or outside of the grid)`;
  if (method === "map") {
    const stated = Number.isFinite(error) ? `± ${number(error, 2)}` : "± unknown";
    return Number.isFinite(ftle) ? `${where} FTLE ${number(ftle)} ${stated}${unit ? ` ${unit}` : ""}` : `${where} no value`;
  }
  // Alpha is the share of rays that met a structure; without one there is no FTLE.
  const value = Number.isFinite(ftle) ? `FTLE ${withUnit(ftle, unit)}` : "no FTLE shown";
  const colour = `colour ${[R, G, B].map(level).join(" ")}`;
  const stated = noError ? "± unknown" : `± ${number(error, 2)}`;
  return `${where} ${value}, ${colour} ${stated}, alpha ${level(A)}`;
}

/** Asks the server for a pixel at a time; of those that wait the newest counts. */
export class Values {
  /** `ask(query)` returns a promise of `{ values }` or `{ problem }`; `show(text, hint)` is called with what is known. */
  constructor({ ask, show }) {
    Object.assign(this, { ask, show });
    this.kept = null;
    this.pixel = null;
    this.frame = null;
    // Number of the picture that is shown.
    this.shown = null;
    this.busy = false;
    this.due = false;
    this.later = null;
  }

  receiveState({ values }) {
    this.kept = values ?? null;
    if (this.pixel === null) this.idle();
  }

  /** Why no value can be told; null if it can. */
  get obstacle() {
    if (this.kept === null) return "";
    return this.kept.ready === undefined ? `No values here: ${this.kept.none}.` : null;
  }

  idle() { this.show(this.obstacle ?? "Point at the picture for the value and error of a pixel."); }

  /** The pointer is at this pixel (null: nowhere). `frame` is the number of the picture that is looked back at; null: the newest. */
  point(pixel, frame) {
    this.pixel = pixel;
    this.frame = frame;
    this.changed();
  }

  /** Another picture may be there. */
  changed() {
    if (this.pixel === null || this.obstacle !== null) return this.idle();
    this.due = true;
    return this.next();
  }

  async next() {
    if (this.busy || !this.due) return;
    [this.busy, this.due] = [true, false];
    const [x, y] = this.pixel;
    const answer = await this.ask({ x, y, ...(this.frame === null ? {} : { frame: this.frame }) });
    // The pointer may have left meanwhile.
    if (this.pixel !== null) {
      if (answer.values) this.show(valueWords(answer.values), answer.values.no_error);
      else this.show(`No value: ${answer.problem}`);
    }
    // A server apart from the run gets its values about once a second.
    clearTimeout(this.later);
    if (this.frame === null && answer.values?.frame < this.shown) this.later = setTimeout(() => this.changed(), LATER);
    setTimeout(() => { this.busy = false; if (this.pixel !== null) this.next(); }, SPACING);
  }
}

/** Address of what this server keeps. */
export function address(path, token, query) {
  const url = new URL(path, new URL("./", location.href));
  for (const [name, value] of Object.entries({ token, ...query })) if (value !== null) url.searchParams.set(name, value);
  return url;
}

/** Fetches from this server. Throws an error with the server's words; `isGone` if there is nothing at the address, or no more. */
async function get(url, limit, signal) {
  let answer;
  try {
    const timeout = AbortSignal.timeout(limit);
    answer = await fetch(url, { signal: signal ? AbortSignal.any([timeout, signal]) : timeout });
  } catch (error) {
    throw new Error(error.name === "TimeoutError" ? "the server did not answer in time" : "the server is not reached", { cause: error });
  }
  if (answer.ok) return answer;
  // A proxy that fails answers with a page of its own.
  const words = answer.headers.get("content-type")?.startsWith("text/plain") ? (await answer.text()).trim() : "";
  throw Object.assign(new Error(words || `the server answers ${answer.status}`), { isGone: answer.status === 404 || answer.status === 410 });
}

/** A function that asks for a plane: resolves to its bytes, and rejects with the server's words. */
export const planeAsker = (token) => async (query) => (await get(address("plane", token, query), PLANE_LIMIT)).arrayBuffer();

/** A function that asks for the picture of a frame without loss, which is empty if the frame has moved on. */
export const pictureAsker = (token) => async (frame) => (await get(address("frame.png", token, { frame, if: "newest" }), PLANE_LIMIT)).blob();

/** A function that asks for a picture that the run keeps: resolves to its header and `payload`. */
export const pastAsker = (token) => async (frame) => parseMessage(await (await get(address("past", token, { frame }), PLANE_LIMIT)).arrayBuffer());

/** A function that asks what the run keeps: `frames`, the numbers of its pictures, and `records` over all of it. */
export const pastLister = (token) => async () => (await get(address("past.json", token, {}), PLANE_LIMIT)).json();

/** A function that asks for the counts of the FTLE. */
export const histogramAsker = (token) => async () => (await get(address("histogram", token, {}), LIMIT)).json();

/** A function for `ask`. */
export const asker = (token) => async (query) => {
  try {
    return { values: await (await get(address("values", token, query), LIMIT)).json() };
  } catch (error) {
    return { problem: error.message };
  }
};

/** Name of a file of a frame, as the server gives. */
export function fileName(run, { frame, slide }, ending) {
  return `${run}-frame-${String(frame).padStart(6, "0")}-slide-${String(slide).padStart(4, "0")}.${ending}`;
}

/** How far the field of a slide is; without a slide the run reads its next one. */
export function fieldWords({ slide, share, seconds_left: left }) {
  if (slide === null) return "The run reads its next slide, whose FTLE is traced then.";
  return `Tracing the FTLE of slide ${count(slide)} beside the run: ${percent(share)}${left === null ? "" : `, about ${duration(left)} left`}.`;
}

/** Saves the FTLE field of a slide (null: the newest), which the server traces first; `tell` gets words meanwhile. Returns the name of the file. */
export async function downloadField({ token, slide, tell, signal }) {
  for (let wanted = slide; !signal.aborted; await new Promise((resolve) => { setTimeout(resolve, FIELD_SPACING); })) {
    const answer = await get(address("field.nc", token, { slide: wanted }), DOWNLOAD_LIMIT, signal);
    if (answer.status !== 202) {
      const name = namedBy(answer) ?? "field.nc";
      save(await answer.blob(), name);
      return name;
    }
    const underway = await answer.json();
    wanted = underway.slide;
    if (!signal.aborted) tell(fieldWords(underway));
  }
  return null;
}

/** The command that writes the FTLE of a frame's slide as NetCDF, and what is to be said about it; `command` is null where none can. */
export function fieldCommand(run, endpoint, { slide, time, date, tau, direction, live, time_unit: unit }) {
  if (live) return { words: "No command writes the field of a running simulation, whose steps are gone; ridgewatch ftle reads archives and closed forms.", command: null };
  // What a run publishes at a path of its own is refused of a scene file, whoever wrote it, and has no meaning here.
  const published = endpoint?.startsWith("ipc://") ? "--set publish.endpoint=private " : "";
  const options = `--slide ${slide} --set time.tau=${tau} --set time.direction=${direction}`;
  return {
    words: `The FTLE of slide ${count(slide)}, t0 = ${date ?? withUnit(time, unit)}, on a grid of your own (--grid sets it), in the folder that holds the folder ${run} of the run:`,
    command: `ridgewatch ftle ${run}/scene.toml ${options} ${published}--out ${run}-slide-${String(slide).padStart(4, "0")}.nc`,
  };
}

const namedBy = (answer) => /filename="([^"]+)"/.exec(answer.headers.get("content-disposition") ?? "")?.[1];

function save(blob, name) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
  link.click();
  // The browser has begun to read it by then.
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

/** Saves a frame as `exr`, `nc`, `png` or `json`: as the server has it, or else what this page has (not of `exr` and `nc`). Returns what is to be told; null if nothing. */
export async function download(ending, { token, kept, shown, held }) {
  const { header, blob } = shown;
  const run = kept?.ready ?? "run";
  let problem = kept?.none ?? "the server has not said what it keeps";
  if (kept?.ready !== undefined) {
    try {
      const answer = await get(address(`frame.${ending}`, token, { frame: held ? shown.frame : null }), DOWNLOAD_LIMIT);
      save(await answer.blob(), namedBy(answer) ?? fileName(run, header.record, ending));
      return null;
    } catch (error) {
      problem = error.message;
    }
  }
  if (ending === "exr") return `No EXR: ${problem}`;
  if (ending === "nc") return `No NetCDF of this frame: ${problem}`;
  if (ending === "json") {
    save(new Blob([JSON.stringify(header.record, null, 2)], { type: "application/json" }), fileName(run, header.record, ending));
    return null;
  }
  save(blob, fileName(run, header.record, header.encoding === "jpeg" ? "jpg" : header.encoding));
  return header.encoding === "png" ? null : `The picture was saved as this page shows it (${header.encoding}): ${problem}`;
}
