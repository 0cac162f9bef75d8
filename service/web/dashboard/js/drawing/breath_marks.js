/** Marks of the breathing on the trace: baseline, events, and when the phase was inside its window. */

import { palette } from "./theme.js";
import { tr } from "../words/words.js";

const COLORS = palette({ baseline: "--draw-baseline", event: "--draw-event", span: "--draw-event-span" });
/** Tolerance for recognising the same event by its start [s]. */
const SAME_S = 0.6;
export const EVENT_WORDS = {
  cough: tr("breath_marks.cough"),
  sigh: tr("breath_marks.sigh"),
  apnoea: tr("breath_marks.no_breath"),
  talking: tr("breath_marks.talking"),
  irregular: tr("breath_marks.irregular"),
  no_cycle: tr("breath_marks.breaths_not_recognised"),
  drift: tr("breath_marks.drift"),
};

export class BreathMarks {
  constructor() {
    this.reset();
  }

  reset() {
    this.baselines = [];
    this.events = [];
  }

  /** @param {number} t time of the sample [s]; marks before `oldest` are dropped */
  add(breath, t, oldest) {
    this.baselines.push({ t, value: breath?.baseline ?? null });
    for (const event of breath?.events ?? []) this.#note(event, t);
    while (this.baselines.length > 0 && this.baselines[0].t < oldest) this.baselines.shift();
    this.events = this.events.filter((event) => event.to >= oldest);
  }

  /** The newest baseline, if known, for the range of the axis. */
  newestBaseline() {
    const value = this.baselines.at(-1)?.value;
    return Number.isFinite(value) ? [value] : [];
  }

  /** Draw the marks between two times [s], in the unit of the gated signal. */
  draw({ context, box, x, y }, from, to) {
    this.#drawEvents(context, box, x, from);
    context.strokeStyle = COLORS.baseline;
    context.lineWidth = 2;
    context.setLineDash([7, 4]);
    context.beginPath();
    let isOpen = false;
    for (const { t, value } of this.#baselinesIn(from, to)) {
      if (!Number.isFinite(value)) isOpen = false;
      else {
        if (isOpen) context.lineTo(x(t), y(value));
        else context.moveTo(x(t), y(value));
        isOpen = true;
      }
    }
    context.stroke();
    context.setLineDash([]);
  }

  #note(event, t) {
    const from = t - event.since_s;
    const known = this.events.find((one) => one.kind === event.kind && (Math.abs(one.from - from) < SAME_S || (one.from <= from && from <= one.to)));
    if (known === undefined) this.events.push({ kind: event.kind, from, to: t });
    else known.to = t;
  }

  #baselinesIn(from, to) {
    let [first, end] = [this.baselines.length, this.baselines.length];
    while (first > 0 && this.baselines[first - 1].t >= from) first -= 1;
    while (end > first && this.baselines[end - 1].t > to) end -= 1;
    return this.baselines.slice(first, end);
  }

  #drawEvents(context, box, x, since) {
    for (const event of this.events.filter((one) => one.to >= since)) {
      const [from, to] = [Math.max(x(event.from), box.x0), Math.max(x(event.to), x(event.from) + 2)];
      context.fillStyle = COLORS.span;
      context.fillRect(from, box.y0, to - from, box.y1 - box.y0);
      context.fillStyle = COLORS.event;
      context.fillRect(from, box.y0, 2, box.y1 - box.y0);
    }
  }

  /** What the lane below the plot says of the events from a time on [s]. */
  labels(since) {
    return this.events.filter((one) => one.to >= since).map((one) => ({ t: one.from, text: EVENT_WORDS[one.kind] ?? String(one.kind), color: COLORS.event }));
  }
}
