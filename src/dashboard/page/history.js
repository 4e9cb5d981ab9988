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
  }

  /** Adds a row. Returns whether a new run began with it. */
  add(row) {
    const last = this.rows.at(-1);
    const restarted = last !== undefined && otherRun(last, row);
    if (restarted) this.clear();
    else if (last?.frame === row.frame) this.rows.pop();
    else if (last !== undefined) this.missing += row.frame - last.frame - 1;
    this.rows.push(row);
    if (this.rows.length > MOST_RECORDS) this.rows.shift();
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
  }
}

/** Pictures in the order of their frames: `{ frame, elapsed, header, blob }`. */
export class Pictures {
  constructor() {
    this.list = [];
    this.bytes = 0;
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
  }

  /** Index of the picture whose frame is nearest to `frame`; -1 without pictures. */
  nearest(frame) {
    const distance = (index) => Math.abs(this.list[index].frame - frame);
    return this.list.reduce((best, _, index) => (best < 0 || distance(index) < distance(best) ? index : best), -1);
  }
}
