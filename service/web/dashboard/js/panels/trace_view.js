/**
 * Which part of the trace is shown: live, with the newest sample at the right edge, or a part of the last minutes that
 * stands still. What stands still is marked as not live, and goes back to live by itself.
 */

import { KEPT_S } from "../stream/trace_samples.js";

export const SPAN_S = 30;
const SHORTEST_S = 2;
const FACTOR = 1.5;
/** Time without a key or the pointer after which the trace is live again [ms]. */
const BACK_MS = 60_000;

export class TraceView {
  constructor() {
    this.toLive(0);
  }

  get isLive() {
    return this.held === null;
  }

  /** Whether the view is as at the beginning. */
  get isDefault() {
    return this.isLive && this.spanS === SPAN_S;
  }

  toLive() {
    Object.assign(this, { held: null, spanS: SPAN_S, touchedMs: 0 });
  }

  /** Return to the newest samples after a while without use. */
  tend(nowMs) {
    if (!this.isLive && nowMs - this.touchedMs > BACK_MS) this.toLive();
  }

  /** @returns {[number, number]} the times shown [s] */
  range(nowS) {
    return this.held ?? [nowS - this.spanS, nowS];
  }

  /** Zoom in or out: while live about the newest sample, which stays in view, otherwise about `at` [s]. */
  zoom(isIn, at, nowMs) {
    const factor = isIn ? 1 / FACTOR : FACTOR;
    this.touchedMs = nowMs;
    if (this.isLive) this.spanS = within(this.spanS * factor, SHORTEST_S, KEPT_S);
    else {
      const [from, to] = this.held;
      const span = within((to - from) * factor, SHORTEST_S, KEPT_S);
      const share = (at - from) / (to - from);
      this.held = [at - share * span, at + (1 - share) * span];
    }
  }

  /** Stand still at these times [s]. */
  hold(from, to, nowMs) {
    const middle = (from + to) / 2;
    const half = Math.max(to - from, SHORTEST_S) / 2;
    this.held = [middle - half, middle + half];
    this.touchedMs = nowMs;
  }

  /**
   * Move by a share of what is shown, back (negative) or forth: not beyond the oldest sample, and live again where the newest
   * is reached.
   */
  move(share, oldestS, nowS, nowMs) {
    const [from, to] = this.range(nowS);
    const by = Math.max(share * (to - from), Math.min(0, oldestS - from));
    if (by > 0 && this.isLive) return;
    if (to + by >= nowS) {
      this.held = null;
      return;
    }
    this.hold(from + by, to + by, nowMs);
  }
}

function within(value, low, high) {
  return Math.min(Math.max(value, low), high);
}
