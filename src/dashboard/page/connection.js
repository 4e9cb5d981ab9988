// The WebSocket: reconnects with back-off, and notices a connection that is open in name only.
import { parseMessage } from "./protocol.js";

const FIRST_DELAY = 500;
const LONGEST_DELAY = 15_000;
// The server sends its state every second, but for the time that a picture takes.
const LONGEST_SILENCE = 12_000;
const LONGEST_HANDSHAKE = 10_000;
// The server closed this page in favour of others.
const DISPLACED = 4001;

const page = () => new URL("./", location.href);

function socketAddress(token) {
  const address = new URL("socket", page());
  address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
  if (token) address.searchParams.set("token", token);
  return address;
}

function acknowledge(socket, sequence) {
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ ack: sequence }));
}

/** `status` is `connecting`, `open`, `lost`, `refused` or `displaced`; `retryAt` (milliseconds of `performance.now`) is set while the next attempt is due. */
export class Connection {
  constructor(token, { message, opened, broken }) {
    Object.assign(this, { token, message, opened, broken });
    this.status = "connecting";
    this.retryAt = null;
    this.delay = FIRST_DELAY;
    this.open();
    this.timer = setInterval(() => this.check(), 1000);
  }

  open() {
    this.heard = performance.now();
    const socket = new WebSocket(socketAddress(this.token));
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onmessage = (event) => this.receive(socket, event.data);
    socket.onclose = ({ code }) => (code === DISPLACED ? this.stop() : this.lose());
  }

  /** Sends a message, if the connection is open. Returns whether it did. */
  say(message) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  receive(socket, data) {
    this.heard = performance.now();
    this.delay = FIRST_DELAY;
    // Not when the socket opens: some proxies accept before they ask the server.
    if (this.status !== "open") this.admit();
    let message;
    try { message = parseMessage(data); } catch (error) { this.broken(error); return; }
    this.message(message, (sequence) => acknowledge(socket, sequence));
  }

  admit() {
    this.status = "open";
    this.opened();
  }

  check() {
    const limit = this.status === "open" ? LONGEST_SILENCE : LONGEST_HANDSHAKE;
    if (this.retryAt === null && performance.now() - this.heard > limit) this.lose();
  }

  lose() {
    const neverOpened = this.status !== "open";
    const socket = this.socket;
    socket.onmessage = socket.onclose = null;
    socket.close();
    if (this.status !== "refused") this.status = "lost";
    const wait = this.delay * (0.75 + 0.5 * Math.random());
    this.delay = Math.min(2 * this.delay, LONGEST_DELAY);
    this.retryAt = performance.now() + wait;
    setTimeout(() => this.retry(), wait);
    if (neverOpened) this.askWhy();
  }

  stop() {
    clearInterval(this.timer);
    this.status = "displaced";
  }

  retry() {
    this.retryAt = null;
    this.open();
  }

  // A browser does not tell the page why a handshake failed.
  async askWhy() {
    if (!this.token) { this.status = "refused"; return; }
    const address = page();
    address.searchParams.set("token", this.token);
    try {
      const answer = await fetch(address, { method: "HEAD", signal: AbortSignal.timeout(5000) });
      if (this.status === "open") return;
      this.status = answer.status === 403 ? "refused" : "lost";
    } catch {
      if (this.status !== "open") this.status = "lost";
    }
  }
}
