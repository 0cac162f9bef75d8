/**
 * The trace: the last 30 s of one signal in mm (or l for the volume), inhale up, on the camera's time axis.
 *
 * Two samples are joined only if they are consecutive and both measured; everything else is a gap, hatched if it is wide
 * enough to see. Missing values are never interpolated or drawn as zero.
 */

import { font, hatch, INK, note, prepare } from "../drawing/canvas.js";
import { BreathMarks } from "../drawing/breath_marks.js";
import { conditionsOf, gatedUnit, gatedValue, hasEdges, hasSameSignal, signalName } from "../stream/gating_window.js";

const SPAN_S = 30;
/** What is kept, for the prediction of another window [s]. */
const KEPT_S = 60;
/** Longest time between two samples that are joined [s]; the stream may drop frames for a slow client. */
const JOIN_S = 0.15;
const MARGIN = { left: 58, right: 14, top: 12, bottom: 24 };
const COLORS = { line: "#8fd3ff", on: "46, 214, 140", window: "#e8d27a", proposal: "#ff9de1", now: "#ffffff" };

export class Trace {
  constructor(canvas) {
    this.canvas = canvas;
    this.choice = "gated";
    this.range = null;
    /** A condition that is being edited: in mm or litres, drawn beside the window in use; null if none is. */
    this.proposal = null;
    this.scale = null;
    /** Whether the scale stays: it must not move under a pointer that drags an edge. */
    this.keepsRange = false;
    this.marks = new BreathMarks();
    this.reset(null);
  }

  reset(sessionId) {
    this.sessionId = sessionId;
    this.samples = [];
    this.window = null;
    this.marks.reset();
  }

  add(sample, arrivedMs) {
    const t = sample.timestamp_us / 1e6;
    const last = this.samples.at(-1);
    if (sample.session_id !== this.sessionId || (last && t < last.t)) this.reset(sample.session_id);
    if (last && t === last.t) return;
    this.window = sample.window;
    this.samples.push({
      t,
      arrivedMs,
      missed: sample.missed_frames,
      gated: gatedValue(sample),
      whole: sample.whole_mm,
      thorax: sample.thorax_mm,
      abdomen: sample.abdomen_mm,
      isOn: sample.gate === "beam_on" && sample.line_on === true,
      state: sample.state,
      isInPhase: conditionsOf(sample.window).some((one) => one.kind === "phase" && one.is_inside),
    });
    this.marks.add(sample.breath, t, t - SPAN_S - 2);
    while (this.samples.length > 0 && this.samples[0].t < t - KEPT_S - 2) this.samples.shift();
  }

  draw(nowMs) {
    this.canvas.dataset.session = this.sessionId ?? "";
    const { context, width, height } = prepare(this.canvas);
    const last = this.samples.at(-1);
    if (!last) {
      note(context, width, height, "No trace: no measurement yet.");
      return;
    }
    const nowS = last.t + (nowMs - last.arrivedMs) / 1000;
    this.#fitRange();
    const box = { x0: MARGIN.left, x1: width - MARGIN.right, y0: MARGIN.top, y1: height - MARGIN.bottom };
    const x = (t) => box.x1 - ((nowS - t) / SPAN_S) * (box.x1 - box.x0);
    const y = (value) => box.y1 - ((value - this.range.low) / (this.range.high - this.range.low)) * (box.y1 - box.y0);
    this.scale = { box, range: this.range };
    drawAxes(context, box, this.range, y, this.#unit());
    context.save();
    context.beginPath();
    context.rect(box.x0, box.y0, box.x1 - box.x0, box.y1 - box.y0);
    context.clip();
    this.#drawBeam(context, box, x);
    this.#drawGaps(context, box, x, nowS);
    for (const condition of this.#shown()) if (hasEdges(condition)) drawWindow(context, box, y, condition);
    if (this.proposal !== null && this.choice === "gated") {
      drawProposal(context, box, y, this.proposal);
      this.canvas.dataset.edges = `${y(this.proposal.lower)} ${y(this.proposal.upper)}`;
    }
    if (this.#showsGated()) {
      this.#drawPhase(context, box, x);
      this.marks.draw(context, box, x, y);
    }
    this.#drawLine(context, x, y);
    context.restore();
    this.#labelGated(context, box);
  }

  /** Height of a value on the canvas, as last drawn [px]. */
  yOf(value) {
    const { box, range } = this.scale;
    return box.y1 - ((value - range.low) / (range.high - range.low)) * (box.y1 - box.y0);
  }

  /** Value at a height of the canvas, as last drawn. */
  valueAt(y) {
    const { box, range } = this.scale;
    return range.low + ((box.y1 - y) / (box.y1 - box.y0)) * (range.high - range.low);
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

  #fitRange() {
    if (this.keepsRange && this.range?.choice === this.choice) return;
    const since = this.samples.at(-1).t - SPAN_S - 2;
    const values = this.samples.filter((s) => s.t >= since).map((s) => s[this.choice]).filter(Number.isFinite);
    if (this.proposal !== null && this.choice === "gated") values.push(this.proposal.lower, this.proposal.upper);
    for (const condition of this.#shown()) if (hasEdges(condition)) values.push(condition.lower, condition.upper);
    if (this.choice === "gated") values.push(...this.marks.newestBaseline());
    values.push(0);
    const whole = this.#unit() === "l" ? 0.05 : 1;
    const low = Math.floor(Math.min(...values) / whole - 0.6) * whole;
    const high = Math.ceil(Math.max(...values) / whole + 0.6) * whole;
    const spare = this.range && this.range.high - this.range.low > 1.6 * (high - low);
    const fits = this.range && low >= this.range.low && high <= this.range.high;
    if (!fits || spare || this.range.choice !== this.choice) this.range = { low, high, choice: this.choice };
  }

  #drawBeam(context, box, x) {
    for (const [from, to] of runs(this.samples, (s) => s.isOn)) {
      context.fillStyle = `rgba(${COLORS.on}, 0.16)`;
      context.fillRect(x(from), box.y0, x(to) - x(from), box.y1 - box.y0);
      context.fillStyle = `rgba(${COLORS.on}, 0.95)`;
      context.fillRect(x(from), box.y1 - 5, x(to) - x(from), 5);
    }
  }

  /** Draw a strip at the top where the phase was inside its window. */
  #drawPhase(context, box, x) {
    context.fillStyle = COLORS.window;
    for (const [from, to] of runs(this.samples, (s) => s.isInPhase)) context.fillRect(x(from), box.y0, Math.max(2, x(to) - x(from)), 4);
  }

  #drawGaps(context, box, x, nowS) {
    context.fillStyle = hatch(context, "rgba(150, 165, 180, 0.34)");
    let before = null;
    for (const sample of this.samples) {
      if (!Number.isFinite(sample[this.choice])) continue;
      const since = before?.t ?? this.samples[0].t;
      const isOpen = before === null || !joins(before, sample, this.choice);
      if (isOpen && sample.t - since > JOIN_S) context.fillRect(x(since), box.y0, x(sample.t) - x(since), box.y1 - box.y0);
      before = sample;
    }
    const since = before?.t ?? this.samples[0].t;
    if (nowS - since > 2 * JOIN_S) context.fillRect(x(since), box.y0, box.x1 - x(since), box.y1 - box.y0);
  }

  #drawLine(context, x, y) {
    context.strokeStyle = COLORS.line;
    context.fillStyle = COLORS.line;
    context.lineWidth = 2;
    context.lineJoin = "round";
    context.beginPath();
    for (const [i, sample] of this.samples.entries()) {
      const value = sample[this.choice];
      if (!Number.isFinite(value)) continue;
      if (i > 0 && joins(this.samples[i - 1], sample, this.choice)) context.lineTo(x(sample.t), y(value));
      else {
        context.moveTo(x(sample.t) - 0.5, y(value));
        context.lineTo(x(sample.t) + 0.5, y(value));
      }
    }
    context.stroke();
    const last = this.samples.at(-1);
    if (!Number.isFinite(last[this.choice])) return;
    context.fillStyle = COLORS.now;
    context.beginPath();
    context.arc(x(last.t), y(last[this.choice]), 4, 0, 2 * Math.PI);
    context.fill();
  }

  #labelGated(context, box) {
    if (this.window === null || this.#showsGated() || this.#shown().length > 0) return;
    context.fillStyle = INK.faint;
    context.font = font(12);
    context.textAlign = "right";
    context.textBaseline = "top";
    context.fillText(`not the gated signal: the window is on ${signalName(conditionsOf(this.window)[0])}`, box.x1 - 6, box.y0 + 4);
  }
}

function joins(before, after, choice) {
  if (!Number.isFinite(before[choice]) || !Number.isFinite(after[choice])) return false;
  return after.missed === before.missed && after.t - before.t <= JOIN_S;
}

/** Return the intervals [s] in which a condition holds, split where samples are missing. */
function runs(samples, holds) {
  const found = [];
  let open = null;
  for (const sample of samples) {
    if (open !== null && sample.t - open[1] > JOIN_S) open = null;
    if (open !== null) open[1] = sample.t;
    if (!holds(sample)) open = null;
    else if (open === null) found.push((open = [sample.t, sample.t]));
  }
  return found;
}

function drawAxes(context, box, range, y, unit) {
  const step = [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50].find((s) => ((box.y1 - box.y0) * s) / (range.high - range.low) >= 32) ?? 100;
  context.font = font(12);
  context.lineWidth = 1;
  context.textAlign = "right";
  context.textBaseline = "middle";
  const digits = step < 0.1 ? 2 : step < 1 ? 1 : 0;
  for (let i = Math.ceil(range.low / step - 1e-6); i * step <= range.high + 1e-9; i += 1) {
    const value = i * step;
    context.strokeStyle = i === 0 ? "#4a5865" : INK.line;
    stroke(context, box.x0, y(value), box.x1, y(value));
    context.fillStyle = INK.text;
    context.fillText(value.toFixed(digits).replace("-", "−"), box.x0 - 7, y(value));
  }
  context.textBaseline = "alphabetic";
  context.fillStyle = INK.faint;
  for (let s = 0; s <= SPAN_S; s += 5) {
    const x = box.x1 - (s / SPAN_S) * (box.x1 - box.x0);
    context.strokeStyle = INK.line;
    stroke(context, x, box.y1, x, box.y1 + 4);
    context.textAlign = s === 0 ? "right" : "center";
    context.fillText(s === 0 ? "now" : `−${s} s`, s === 0 ? box.x1 + 8 : x, box.y1 + 17);
  }
  context.save();
  context.translate(11, (box.y0 + box.y1) / 2);
  context.rotate(-Math.PI / 2);
  context.textAlign = "center";
  context.fillText(`${unit} · inhale up`, 0, 0);
  context.restore();
}

function drawWindow(context, box, y, condition) {
  const { lower, upper, hysteresis: inner, unit } = condition;
  context.fillStyle = "rgba(232, 210, 122, 0.07)";
  context.fillRect(box.x0, y(upper), box.x1 - box.x0, y(lower) - y(upper));
  context.strokeStyle = COLORS.window;
  context.lineWidth = 1.5;
  for (const edge of [lower, upper]) stroke(context, box.x0, y(edge), box.x1, y(edge));
  if (inner > 0) {
    context.lineWidth = 1;
    context.setLineDash([3, 5]);
    for (const edge of [lower + inner, upper - inner]) stroke(context, box.x0, y(edge), box.x1, y(edge));
    context.setLineDash([]);
  }
  context.fillStyle = COLORS.window;
  context.font = font(11);
  context.textAlign = "left";
  context.textBaseline = "bottom";
  const digits = unit === "l" ? 2 : 1;
  const name = condition.kind === "breath_hold" ? "breath hold" : "window";
  context.fillText(`${name} ${lower.toFixed(digits)} to ${upper.toFixed(digits)} ${unit}`.replaceAll("-", "−"), box.x0 + 6, y(upper) - 3);
}

/** Draw edges that are being edited, each with a grip. */
function drawProposal(context, box, y, { lower, upper, unit }) {
  context.strokeStyle = COLORS.proposal;
  context.fillStyle = COLORS.proposal;
  context.lineWidth = 2;
  context.font = font(12);
  context.textAlign = "right";
  const digits = unit === "l" ? 2 : 1;
  for (const [edge, baseline, shift] of [[upper, "bottom", -4], [lower, "top", 4]]) {
    context.setLineDash([8, 4]);
    stroke(context, box.x0, y(edge), box.x1, y(edge));
    context.setLineDash([]);
    context.fillRect(box.x1 - 34, y(edge) - 3, 28, 6);
    context.textBaseline = baseline;
    context.fillText(`${edge.toFixed(digits)} ${unit}`.replace("-", "−"), box.x1 - 40, y(edge) + shift);
  }
}

function stroke(context, x0, y0, x1, y1) {
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
}
