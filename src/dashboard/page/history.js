// What the page keeps, in bounds: records, as the few numbers that charts need, and the newest pictures.

const MOST_RECORDS = 2000;
const MOST_PICTURES = 300;
const MOST_BYTES = 128 * 1024 * 1024;

/** True if `next` belongs to another run than `last`. The clock of a run tells two runs apart if the first frames of the second were missed. */
function otherRun(last, next) {
  if (next.frame < last.frame) return true;
  const [before, after] = [last.elapsed, next.elapsed];
  return next.frame > last.frame && before != null && after != null && after < before;
}

/** Rows in the order of their frames. A row has `frame` and `elapsed`; the rest is for the charts. */
export class Records {
  constructor() {
    this.rows = [];
    this.missing = 0;
    // Rows over all of the run, of which few are told, and those that were dropped since.
    this.past = [];
    this.dropped = 0;
  }

  /** Takes in rows over all of the run, in order. */
  setPast(rows) {
    this.past = rows;
    this.dropped = 0;
  }

  /** All rows in order: those before the first one that came, then all that came. */
  get all() {
    const first = this.rows[0]?.frame ?? Infinity;
    return [...this.past.filter(({ frame }) => frame < first), ...this.rows];
  }

  /** Adds a row. Returns whether a new run began with it. */
  add(row) {
    const last = this.rows.at(-1);
    const restarted = last !== undefined && otherRun(last, row);
    if (restarted) this.clear();
    else if (last?.frame === row.frame) this.rows.pop();
    else if (last !== undefined) this.missing += row.frame - last.frame - 1;
    this.rows.push(row);
    if (this.rows.length > MOST_RECORDS) {
      this.rows.shift();
      this.dropped += 1;
    }
    return restarted;
  }

  /** Whether a row of this frame and time of the run is kept. */
  has({ frame, elapsed }) {
    let [low, high] = [0, this.rows.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.rows[middle].frame < frame) low = middle + 1;
      else high = middle;
    }
    return this.rows[low]?.frame === frame && this.rows[low].elapsed === elapsed;
  }

  clear() {
    this.rows = [];
    this.missing = 0;
    this.setPast([]);
  }
}

/** Pictures in the order of their frames: `{ frame, elapsed, header, blob }`. Those that came are in `list`. */
export class Pictures {
  constructor() {
    this.list = [];
    this.bytes = 0;
    // Those that the run keeps, which are fetched when they are looked at: `blob` is null until then.
    this.past = [];
  }

  /** Takes in the numbers of the frames that the run keeps, in order. */
  setPast(frames) {
    const known = new Map(this.past.map((picture) => [picture.frame, picture]));
    this.past = frames.map((frame) => known.get(frame) ?? { frame, elapsed: null, header: null, blob: null, asked: true });
  }

  /** A picture that the run no longer keeps. */
  lose(picture) { this.past = this.past.filter((kept) => kept !== picture); }

  /** All pictures in order: those of the run before the first one that came, then all that came. */
  get all() {
    const first = this.list[0]?.frame ?? Infinity;
    return [...this.past.filter(({ frame }) => frame < first), ...this.list];
  }

  /** Adds a picture. Returns whether a new run began with it. */
  add(picture) {
    const last = this.list.at(-1);
    const restarted = last !== undefined && otherRun(last, picture);
    if (restarted) this.clear();
    else if (last?.frame === picture.frame) this.bytes -= this.list.pop().blob.size;
    this.list.push(picture);
    this.bytes += picture.blob.size;
    while (this.list.length > 1 && (this.list.length > MOST_PICTURES || this.bytes > MOST_BYTES)) {
      this.bytes -= this.list.shift().blob.size;
    }
    return restarted;
  }

  clear() {
    this.list = [];
    this.bytes = 0;
    this.past = [];
  }

  /** Index of the picture whose frame is nearest to `frame`; -1 without pictures. */
  nearest(frame) {
    const { all } = this;
    const distance = (index) => Math.abs(all[index].frame - frame);
    return all.reduce((best, _, index) => (best < 0 || distance(index) < distance(best) ? index : best), -1);
  }
}
