/**
 * The trace: the signals of the last minutes in mm (or l for the volume), inhale up, on the camera's time axis.
 *
 * Two samples are joined only if they are consecutive, both measured, and against the same zero; everything else is a gap,
 * hatched if it is wide enough to see. Missing values are never interpolated or drawn as zero.
 */

import { BreathMarks } from "../drawing/breath_marks.js";
import { Chart } from "../drawing/chart.js";
import { byId, setText } from "../drawing/elements.js";
import * as layers from "../drawing/trace_layers.js";
import { conditionsOf, gatedUnit, hasEdges, hasSameSignal, signalName } from "../stream/gating_window.js";
import { KEPT_S, TraceSamples, words } from "../stream/trace_samples.js";
import { SPAN_S, TraceView } from "./trace_view.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

/** What the prediction of another window looks at [s]. */
const JUDGED_S = 60;
/** A long trace, and one that stands still, is drawn less often [s, ms]. */
const LONG_S = 90;
const LONG_MS = 200;
const TIME_STEPS = [1, 2, 5, 10, 15, 30, 60, 120];
const MOST_TIMES = 8;
const GATES = { disarmed: tr("trace.disarmed"), hold: tr("trace.hold"), dwell: tr("trace.dwell"), beam_on: tr("trace.beam_on"), fault: tr("trace.fault") };

export class Trace {
  constructor(host) {
    this.host = host;
    this.choice = "gated";
    this.range = null;
    /** A condition that is being edited: in mm or litres, drawn beside the window in use; null if none is. */
    this.proposal = null;
    /** Whether the scale stays: it must not move under a pointer that drags an edge. */
    this.keepsRange = false;
    /** Text of the reference, as confirmed; empty while it is not known. */
    this.referenceText = "";
    this.marks = new BreathMarks();
    this.kept = new TraceSamples();
    this.view = new TraceView();
    this.nowS = 0;
    this.chart = new Chart(host, [() => layers.COLORS.line], {
      below: (pen) => this.#drawBelow(pen),
      above: (pen) => this.#drawAbove(pen),
      times: (from, to) => this.#times(from, to),
      hasLabels: () => this.#hasLabels,
      isJoined: (i) => this.kept.all[i]?.isJoined === true,
      onPress: () => this.#press(),
      onSelect: (from, to) => this.view.hold(from, to, performance.now()),
      onRelease: () => this.#release(),
    });
    this.canvas = this.chart.canvas;
    this.canvas.id = "trace";
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", tr("trace.motion_over_time_in_millimetres_inhale_up"));
    this.#listen();
    this.reset(null);
  }

  /** The element that the pointer is on, over the plot. */
  get surface() {
    return this.chart.over;
  }

  get samples() {
    return this.kept.ofPresentZero(JUDGED_S);
  }

  reset(sessionId) {
    this.kept.reset(sessionId);
    this.window = null;
    this.range = null;
    this.referenceText = "";
    this.pressed = false;
    this.marks.reset();
    this.view.toLive();
    this.chart.clear();
    this.drawnMs = -Infinity;
  }

  add(message, arrivedMs) {
    const sessionId = this.kept.sessionId;
    const steps = this.kept.steps.length;
    const t = this.kept.add(message, arrivedMs);
    if (this.kept.sessionId !== sessionId || this.kept.all.length === 1) {
      this.marks.reset();
      this.view.toLive();
      this.range = null;
      this.chart.clear();
    }
    // What was confirmed before belongs to another zero.
    if (this.kept.steps.length !== steps) this.referenceText = "";
    this.window = message.window;
    this.marks.add(message.breath, t, t - KEPT_S);
  }

  /** Show recorded samples before the first one, unless another zero was set meanwhile. */
  putBefore(sessionId, messages) {
    if (this.kept.sessionId === sessionId && this.kept.steps.length === 0 && this.kept.all.length > 0) this.kept.putBefore(messages, this.window);
  }

  draw(nowMs) {
    this.canvas.dataset.session = this.kept.sessionId ?? "";
    const last = this.kept.all.at(-1);
    this.chart.show(last !== undefined);
    byId("trace-none").hidden = last !== undefined;
    this.view.tend(nowMs);
    this.#showView();
    if (last === undefined) return;
    this.nowS = last.t + (nowMs - last.arrivedMs) / 1000;
    const [from, to] = this.view.range(this.nowS);
    if ((to - from > LONG_S || !this.view.isLive) && nowMs - this.drawnMs < LONG_MS && !this.pressed) return;
    this.drawnMs = nowMs;
    this.#fitRange(from, to);
    const { times, values } = this.kept;
    this.chart.draw([times, values[this.choice]], [from, to], [this.range.low, this.range.high]);
    this.#readOut();
  }

  yOf(value) {
    return this.chart.yOf(value);
  }

  valueAt(y) {
    return this.chart.valueAt(y);
  }

  toLive() {
    this.view.toLive();
  }

  /** Stand still around a time of day [ms], as far as it is kept. */
  lookAt(atMs) {
    const sample = this.kept.all.findLast((one) => one.atMs <= atMs);
    if (sample !== undefined) this.view.hold(sample.t - SPAN_S / 2, sample.t + SPAN_S / 2, performance.now());
  }

  #listen() {
    this.surface.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.view.zoom(event.deltaY < 0, this.chart.timeAt(event.offsetX), performance.now());
    }, { passive: false });
    this.host.addEventListener("keydown", (event) => this.#key(event));
    byId("trace-live").addEventListener("click", () => this.toLive());
  }

  #key(event) {
    const nowMs = performance.now();
    const [from, to] = this.view.range(this.nowS);
    const oldestS = this.kept.times[0] ?? this.nowS;
    const act = {
      "+": () => this.view.zoom(true, (from + to) / 2, nowMs),
      "=": () => this.view.zoom(true, (from + to) / 2, nowMs),
      "-": () => this.view.zoom(false, (from + to) / 2, nowMs),
      ArrowLeft: () => this.view.move(-0.25, oldestS, this.nowS, nowMs),
      ArrowRight: () => this.view.move(0.25, oldestS, this.nowS, nowMs),
      l: () => this.toLive(),
      End: () => this.toLive(),
    }[event.key];
    if (act === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    act();
  }

  /** Stand still under a pressed pointer; not where an edge of the window is dragged. */
  #press() {
    if (this.keepsRange || this.kept.all.length === 0) return false;
    this.pressed = this.view.isLive;
    if (this.pressed) this.view.hold(...this.view.range(this.nowS), performance.now());
    this.stoodAt = this.view.held;
    return true;
  }

  /** A press without a selection changes nothing. */
  #release() {
    if (this.pressed && this.view.held === this.stoodAt) this.view.held = null;
    this.pressed = false;
  }

  #showsGated() {
    return this.window !== null && (this.choice === "gated" || this.choice === this.window.signal);
  }

  #unit() {
    return this.choice === "gated" ? gatedUnit(this.window) : "mm";
  }

  /** The conditions on the signal that is shown. */
  #shown() {
    const all = conditionsOf(this.window);
    if (this.choice !== "gated") return all.filter((one) => one.signal === this.choice);
    return all.filter((one) => hasSameSignal(one, all[0]));
  }

  #fitRange(from, to) {
    if (this.keepsRange && this.range?.choice === this.choice) return;
    const [first, end] = [this.kept.indexAt(from), this.kept.indexAt(to + 2)];
    let [least, most] = [0, 0];
    const stretch = (value) => {
      if (!Number.isFinite(value)) return;
      least = Math.min(least, value);
      most = Math.max(most, value);
    };
    const values = this.kept.values[this.choice];
    for (let i = first; i < end; i += 1) if (values[i] !== null) stretch(values[i]);
    const lines = this.#shown().filter(hasEdges);
    if (this.proposal !== null && this.choice === "gated") lines.push(this.proposal);
    for (const { lower, upper } of lines) [lower, upper].forEach(stretch);
    if (this.choice === "gated") this.marks.newestBaseline().forEach(stretch);
    const whole = this.#unit() === "l" ? 0.05 : 1;
    const low = Math.floor(least / whole - 0.6) * whole;
    const high = Math.ceil(most / whole + 0.6) * whole;
    const spare = this.range && this.range.high - this.range.low > 1.6 * (high - low);
    const fits = this.range && low >= this.range.low && high <= this.range.high;
    if (!fits || spare || this.range.choice !== this.choice) this.range = { low, high, choice: this.choice };
  }

  #drawBelow(pen) {
    if (this.window === null) return;
    const [from, to] = this.view.range(this.nowS);
    if (this.#hasLabels) layers.drawUnit(pen, this.#unit());
    layers.clip(pen);
    layers.drawBeam(pen, this.kept.runs(from, to, (sample) => sample.isOn));
    layers.drawGaps(pen, this.kept.gaps(this.choice, from, to, this.nowS));
    layers.drawReference(pen);
    for (const condition of this.#shown()) if (hasEdges(condition)) layers.drawWindow(pen, condition);
    if (this.proposal !== null && this.choice === "gated") {
      layers.drawProposal(pen, this.proposal);
      this.canvas.dataset.edges = `${pen.y(this.proposal.lower)} ${pen.y(this.proposal.upper)}`;
    }
    if (!this.#showsGated()) return;
    layers.drawPhase(pen, this.kept.runs(from, to, (sample) => sample.isInPhase));
    this.marks.draw(pen, from, to);
  }

  #drawAbove(pen) {
    const last = this.kept.all.at(-1);
    if (last === undefined || this.window === null) return;
    const [from, to] = this.view.range(this.nowS);
    const [steps, holds] = [this.kept.steps.filter(({ t }) => t >= from), this.kept.holds(from, to)];
    if (this.#hasLabels) layers.drawLane(pen, [...layers.labelsOf(holds, steps), ...(this.#showsGated() ? this.marks.labels(from) : [])]);
    layers.clip(pen);
    layers.drawSteps(pen, steps);
    layers.drawStates(pen, this.kept.states(from, to));
    layers.drawHolds(pen, holds);
    if (Number.isFinite(last[this.choice])) layers.drawNow(pen, last.t, last[this.choice]);
    if (this.#showsGated() || this.#shown().length > 0) return;
    layers.drawRemark(pen, tr("trace.not_the_gated_signal_the_window_is_on", { value: signalName(conditionsOf(this.window)[0]) }));
  }

  /** From a distance no label of the trace can be read: it has none there. */
  get #hasLabels() {
    return document.body.dataset.view !== "distance";
  }

  /** Seconds before now while live, and the time of day where the trace stands still. */
  #times(from, to) {
    if (this.kept.all.length === 0 || !this.#hasLabels) return [];
    const step = TIME_STEPS.find((one) => (to - from) / one <= MOST_TIMES) ?? TIME_STEPS.at(-1);
    if (this.view.isLive) {
      const count = Math.floor((to - from) / step + 1e-6);
      return Array.from({ length: count + 1 }, (_, i) => ({ at: to - i * step, text: i === 0 ? tr("trace.now") : ago(i * step) })).reverse();
    }
    const offset = this.#clockMs() / 1000;
    const first = Math.ceil((from + offset) / step) * step - offset;
    const count = Math.max(0, Math.floor((to - first) / step) + 1);
    return Array.from({ length: count }, (_, i) => ({ at: first + i * step, text: this.#clock(first + i * step) }));
  }

  /** Time of day of the camera's zero, from the newest sample [ms]. */
  #clockMs() {
    const last = this.kept.all.at(-1);
    return last.atMs - last.t * 1000;
  }

  #clock(t) {
    return new Date(Math.round(this.#clockMs() + t * 1000)).toLocaleTimeString("en-GB");
  }

  #showView() {
    const text = this.view.isLive ? "" : tr("trace.not_live");
    setText(byId("trace-held"), text);
    byId("trace-live").hidden = this.view.isDefault || this.pressed;
    this.host.dataset.live = this.view.isLive ? "yes" : "no";
  }

  /** The sample under the pointer: when, how much, and the gate. */
  #readOut() {
    const x = this.chart.pointerX;
    const found = x === null ? null : this.kept.nearest(this.chart.timeAt(x));
    const text = x === null ? "" : found === null ? tr("trace.no_sample") : this.#valuesOf(found);
    setText(byId("trace-readout"), text);
  }

  #valuesOf(sample) {
    const unit = this.#unit();
    const value = sample[this.choice];
    const shown = Number.isFinite(value) ? `${fixed(value, unit === "l" ? 2 : 1)} ${unit}` : tr("trace.not_measured");
    const cause = ["hold", "fault"].includes(sample.gate) && sample.reason ? `: ${words(sample.reason)}` : "";
    return [tr("trace.s_ago", { value: fixed(this.nowS - sample.t, 1), value2: this.#clock(sample.t) }), shown, `${GATES[sample.gate] ?? String(sample.gate)}${cause}`].join(" · ").replaceAll("-", "−");
  }
}

function ago(seconds) {
  if (seconds < 120) return `−${seconds} s`;
  return seconds % 60 === 0 ? `−${seconds / 60} min` : `−${Math.floor(seconds / 60)} min ${seconds % 60} s`;
}
