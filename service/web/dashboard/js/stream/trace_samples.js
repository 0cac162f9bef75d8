/** The last minutes of samples, in the page's memory: which belong together, and the intervals that are drawn. */

import { conditionsOf, gatedValue } from "./gating_window.js";
import { shortReason } from "../words/reasons.js";
import { tr } from "../words/words.js";

/** Longest time between two samples that are joined [s]; the stream may drop frames for a slow client. */
export const JOIN_S = 0.15;
/** What is kept [s]. */
export const KEPT_S = 600;
/** How many of the oldest samples are dropped at once. */
const CHUNK = 500;
export const SIGNALS = ["gated", "whole", "thorax", "abdomen"];

export class TraceSamples {
  constructor() {
    this.reset(null);
  }

  reset(sessionId) {
    this.sessionId = sessionId;
    /** Samples in the order of time; `times` and `values` are the same as lists of numbers, for the chart. */
    this.all = [];
    this.times = [];
    this.values = Object.fromEntries(SIGNALS.map((name) => [name, []]));
    this.steps = [];
    this.zero = undefined;
  }

  /** @returns {number} the time of the message on the camera's clock [s] */
  add(message, arrivedMs) {
    const t = message.timestamp_us / 1e6;
    const last = this.all.at(-1);
    if (message.session_id !== this.sessionId || (last && t < last.t)) this.reset(message.session_id);
    if (this.all.at(-1)?.t === t) return t;
    const isStep = this.#noteZero(message, t);
    const sample = sampleOf(message, t, arrivedMs);
    const before = this.all.at(-1);
    sample.isJoined = before !== undefined && !isStep && sample.missed === before.missed && t - before.t <= JOIN_S;
    this.all.push(sample);
    this.times.push(t);
    for (const name of SIGNALS) this.values[name].push(Number.isFinite(sample[name]) ? sample[name] : null);
    this.#drop(t - KEPT_S);
    return t;
  }

  /** Put recorded samples of the same zero before the first one; `window` is the present one, whose signal is drawn. */
  putBefore(messages, window) {
    const [first] = this.all;
    const older = messages.map((one) => sampleOf({ ...one, window }, one.timestamp_us / 1e6, first.arrivedMs)).filter(({ t }) => t < first.t && t > first.t - KEPT_S);
    for (const [i, one] of older.entries()) one.isJoined = i > 0 && one.t - older[i - 1].t <= JOIN_S;
    this.all.unshift(...older);
    this.times.unshift(...older.map(({ t }) => t));
    for (const name of SIGNALS) this.values[name].unshift(...older.map((one) => (Number.isFinite(one[name]) ? one[name] : null)));
  }

  /** Another reference is another zero: the samples before it are not joined with those after it. */
  #noteZero(message, t) {
    const zero = message.position_check?.reference_number ?? null;
    const before = this.zero;
    this.zero = zero;
    if (before === undefined || before === zero) return false;
    this.steps.push({ t, text: zero === null ? tr("trace_samples.no_reference") : tr("trace_samples.new_reference") });
    return true;
  }

  #drop(oldest) {
    if (this.times[CHUNK] >= oldest || this.times.length <= CHUNK) return;
    this.all.splice(0, CHUNK);
    this.times.splice(0, CHUNK);
    for (const name of SIGNALS) this.values[name].splice(0, CHUNK);
    this.steps = this.steps.filter(({ t }) => t >= this.times[0]);
  }

  /** Samples measured against the present zero, within this time before the newest [s]. */
  ofPresentZero(seconds) {
    const last = this.all.at(-1);
    if (last === undefined) return [];
    const since = Math.max(last.t - seconds, this.steps.at(-1)?.t ?? -Infinity);
    return this.all.slice(this.indexAt(since));
  }

  /** Index of the first sample at or after a time. */
  indexAt(t) {
    let [low, high] = [0, this.times.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.times[middle] < t) low = middle + 1;
      else high = middle;
    }
    return low;
  }

  /** The sample nearest to a time, null where none lies within half the time of two joined ones. */
  nearest(t) {
    const after = this.indexAt(t);
    const [one, other] = [this.all[after - 1], this.all[after]];
    const found = one && (!other || t - one.t < other.t - t) ? one : other;
    return found && Math.abs(found.t - t) <= JOIN_S / 2 ? found : null;
  }

  /** Intervals [s] between two times in which samples meet a condition, split where samples are missing. */
  runs(from, to, holds) {
    return this.#grouped(from, to, (sample) => (holds(sample) ? "yes" : null)).map((one) => [one.from, one.to]);
  }

  /** Intervals between two times with the gate's state. */
  states(from, to) {
    return this.#grouped(from, to, (sample) => sample.gate).map((one) => ({ from: one.from, to: one.to, gate: one.key }));
  }

  #grouped(from, to, keyOf) {
    const found = [];
    let open = null;
    for (const sample of this.#between(from, to)) {
      if (open !== null && sample.t - open.to > JOIN_S) open = null;
      if (open !== null) open.to = sample.t;
      const key = keyOf(sample);
      if (key === null) open = null;
      else if (open?.key !== key) found.push((open = { from: sample.t, to: sample.t, key }));
    }
    return found;
  }

  /** Where a hold or a fault began, or its cause changed, between two times; not where the signal left the window. */
  holds(from, to) {
    const found = [];
    let before = null;
    for (const { t, gate, reason } of this.#between(from, to)) {
      const key = gate === "hold" || gate === "fault" ? `${gate} ${reason}` : "";
      if (key !== before && before !== null && key !== "" && reason !== "outside_window") found.push({ t, gate, text: words(reason) });
      before = key;
    }
    return found;
  }

  /** Intervals [s] in which a signal was not measured, up to `nowS`. */
  gaps(signal, from, to, nowS) {
    const found = [];
    if (this.all.length === 0) return found;
    let before = null;
    for (const sample of this.#between(from - JOIN_S, to)) {
      if (!Number.isFinite(sample[signal])) continue;
      const since = before?.t ?? Math.max(from, this.times[0]);
      if (sample.t - since > JOIN_S) found.push([since, sample.t]);
      before = sample;
    }
    const since = before?.t ?? Math.max(from, this.times[0]);
    const end = Math.min(to, nowS);
    if (end - since > 2 * JOIN_S) found.push([since, end]);
    return found;
  }

  *#between(from, to) {
    for (let i = this.indexAt(from); i < this.all.length && this.times[i] <= to; i += 1) yield this.all[i];
  }
}

function sampleOf(message, t, arrivedMs) {
  return {
    t,
    arrivedMs,
    atMs: Date.parse(message.received_at ?? message.sent_at),
    missed: message.missed_frames,
    gated: gatedValue(message),
    whole: message.whole_mm,
    thorax: message.thorax_mm,
    abdomen: message.abdomen_mm,
    isOn: message.gate === "beam_on" && message.line_on === true,
    gate: message.gate,
    reason: message.hold_reason,
    isInPhase: conditionsOf(message.window).some((one) => one.kind === "phase" && one.is_inside),
  };
}

/** A cause of a hold in words, such as "marker lost". */
export function words(reason) {
  return shortReason(reason ?? "").slice(0, 60);
}
