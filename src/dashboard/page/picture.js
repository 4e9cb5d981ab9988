// The picture: decoding, drawing, and looking back over the pictures that are kept.
import { Pictures } from "./history.js";
import { mediaType } from "./protocol.js";

// A picture that has stood for so many milliseconds is worth its details.
const IDLE = 1000;
// From here on a picture looks better with visible pixels than smeared.
const ENLARGED = 2;

/** Rectangle of the picture in the window, which may be smaller than the element around it. */
export function pictureBox(canvas) {
  const box = canvas.getBoundingClientRect();
  const fit = Math.min(box.width / canvas.width, box.height / canvas.height);
  const [width, height] = [canvas.width * fit, canvas.height * fit];
  return { width, height, left: box.left + (box.width - width) / 2, top: box.top + (box.height - height) / 2 };
}

export class Picture {
  /**
   * `changed(picture)` is called with the picture that is now shown; null if there is none. `ask(frame)` resolves to the header and payload of a picture that
   * the run keeps; `lost(picture, error)` is called if it cannot.
   */
  constructor(canvas, changed, { ask, lost }) {
    Object.assign(this, { canvas, changed, ask, lost });
    this.kept = new Pictures();
    this.shown = null;
    this.held = false;
    this.wanted = null;
    this.fetching = false;
    new ResizeObserver(() => this.sharpen()).observe(canvas);
  }

  /** Takes in a frame. Throws if it cannot be decoded. Returns whether a new run began with it. */
  async receive(header, payload) {
    const type = mediaType(header.encoding);
    if (type === undefined) throw new Error(`its encoding is ${header.encoding}; this page shows jpeg and png`);
    const blob = new Blob([payload], { type });
    const bitmap = await createImageBitmap(blob);
    const picture = { frame: header.frame, elapsed: header.record?.seconds?.elapsed ?? null, header, blob, since: performance.now(), asked: type !== "image/jpeg" };
    const restarted = this.kept.add(picture);
    if (restarted) this.held = false;
    if (this.held && this.shown !== null) this.changed(this.shown);
    else this.draw(picture, bitmap);
    bitmap.close();
    return restarted;
  }

  /** Draws the newest picture without the losses of JPEG, once it has stood for a while. `ask(frame)` resolves to its PNG. */
  async refine(ask) {
    const picture = this.shown;
    if (picture === null || this.held || picture.asked || document.hidden || performance.now() - picture.since < IDLE) return;
    picture.asked = true;
    try {
      const blob = await ask(picture.frame);
      const bitmap = await createImageBitmap(blob);
      Object.assign(picture, { blob, header: { ...picture.header, encoding: "png" } });
      if (this.shown === picture) this.draw(picture, bitmap);
      bitmap.close();
    } catch {
      // A newer one is there, or the server is lost: this one stays as it came.
    }
  }

  draw(picture, bitmap) {
    this.wanted = picture;
    this.shown = picture;
    if (this.canvas.width !== bitmap.width || this.canvas.height !== bitmap.height) {
      this.canvas.width = bitmap.width;
      this.canvas.height = bitmap.height;
      this.sharpen();
    }
    // Without the compositing of alpha that a picture may have, an older one would shine through.
    this.canvas.getContext("2d").clearRect(0, 0, bitmap.width, bitmap.height);
    this.canvas.getContext("2d").drawImage(bitmap, 0, 0);
    this.changed(picture);
  }

  sharpen() {
    const enlargement = (this.canvas.clientWidth * devicePixelRatio) / this.canvas.width;
    this.canvas.classList.toggle("pixels", enlargement >= ENLARGED);
  }

  /** Position of the picture among all: of the one that is looked back at also while it is fetched. */
  position() {
    const picture = (this.held && this.wanted) || this.shown;
    const index = this.kept.all.indexOf(picture);
    return index >= 0 || picture === null ? index : this.kept.nearest(picture.frame);
  }

  /** Stops at the picture that is shown. */
  hold() {
    if (this.shown === null) return;
    this.held = true;
    this.changed(this.shown);
  }

  /** Shows the newest picture, and each new one from now on. */
  async follow() {
    this.held = false;
    await this.load(this.kept.list.at(-1));
  }

  /** Shows a kept picture and stays there. */
  async lookBack(index) {
    const { all } = this.kept;
    if (all.length === 0) return;
    this.held = true;
    await this.load(all[Math.min(Math.max(index, 0), all.length - 1)]);
  }

  async load(picture) {
    if (picture === undefined) return;
    this.wanted = picture;
    if (picture.blob === null) { await this.fetch(); return; }
    const bitmap = await createImageBitmap(picture.blob);
    // Meanwhile another one may have been asked for.
    if (this.wanted === picture) this.draw(picture, bitmap);
    bitmap.close();
  }

  /** Fetches the picture that is wanted, one at a time: of those that were wanted meanwhile the newest. */
  async fetch() {
    if (this.fetching) return;
    this.fetching = true;
    while (this.wanted?.blob === null) {
      const picture = this.wanted;
      try {
        const { payload, ...header } = await this.ask(picture.frame);
        const blob = new Blob([payload], { type: mediaType(header.encoding) });
        const bitmap = await createImageBitmap(blob);
        Object.assign(picture, { header, blob, elapsed: header.record.seconds?.elapsed ?? null });
        if (this.wanted === picture) this.draw(picture, bitmap);
        bitmap.close();
        // Of the others the run has the pictures.
        for (const other of this.kept.past) if (other !== this.shown && other !== picture) other.blob = null;
      } catch (error) {
        this.lost(picture, error);
        if (this.wanted === picture) this.wanted = this.shown === picture ? null : this.shown;
        if (this.shown === null) this.held = false;
      }
    }
    this.fetching = false;
  }
}
