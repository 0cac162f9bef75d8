/**
 * What a patient screen shows now: the guidance of the newest measured frame, "wait", or nothing.
 *
 * Nothing is shown without the connection, and 300 ms after the newest measured frame, whatever the reason: silence, a lag of
 * the connection, an old frame, or frames that could not be measured.
 */

import { LiveStream, STALE_MS } from "../stream/live_stream.js";

export const SCHEMA = "tidegate.coach/1";
const NEWS = new Set(["guide", "wait"]);
/** Length of the displayed curve [ms]. */
export const CURVE_MS = 12_000;
const BLANK = { show: "blank", guide: null, curve: [] };

/** @returns {URL} the WebSocket of the coaching stream */
export function streamUrl() {
  const url = new URL("/api/v1/coach/live", window.location.href);
  url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
  return url;
}

export class Guidance {
  /** @param {() => void} onEnd called when a connection ended, perhaps because the pairing ended */
  constructor(onEnd) {
    this.stream = new LiveStream(streamUrl(), (message, nowMs) => this.#receive(message, nowMs), () => this.#end(onEnd), SCHEMA, NEWS);
    this.#forget();
  }

  start() {
    if (!this.stream.isWanted) this.stream.connect();
  }

  stop() {
    this.stream.stop();
    this.#forget();
  }

  /** The language chosen at the console, as last received; null before a message. */
  get language() {
    return this.stream.message?.language ?? null;
  }

  /** @returns {{show: "guide"|"wait"|"blank", guide: ?object, curve: {atMs: number, level: number}[]}} */
  view(nowMs) {
    this.stream.tend(nowMs);
    const { message } = this.stream;
    if (message === null || this.stream.problem !== "" || this.stream.silenceMs(nowMs) > STALE_MS) return BLANK;
    if (message.type === "wait") return { show: "wait", guide: null, curve: [] };
    // A frame that could not be measured does not wipe the screen for a thirtieth of a second: the last one stays, 300 ms at most.
    if (this.guide === null || nowMs - this.measuredMs > STALE_MS) return BLANK;
    return { show: "guide", guide: this.guide, curve: this.curve };
  }

  #receive(message, nowMs) {
    if (message.type === "wait") {
      this.#forget();
    } else if (message.level !== null) {
      this.guide = message;
      this.measuredMs = nowMs - this.stream.ageMs(nowMs);
      this.curve = this.curve.filter((point) => point.atMs > nowMs - CURVE_MS);
      this.curve.push({ atMs: this.measuredMs, level: message.level });
    }
  }

  #end(onEnd) {
    this.#forget();
    onEnd();
  }

  #forget() {
    this.guide = null;
    this.measuredMs = -Infinity;
    this.curve = [];
  }
}
