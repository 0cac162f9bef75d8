/** What lies below and above the lines of the trace: beam on, gaps, windows, references, states of the gate, the newest value. */

import { font, hatch, INK } from "./canvas.js";
import { ink, palette } from "./theme.js";
import { fixed } from "./numbers.js";
import { tr } from "../words/words.js";

export const COLORS = palette({
  line: "--draw-gated", window: "--draw-window", inside: "--draw-inside",
  proposal: "--draw-proposal", now: "--draw-now", reference: "--draw-reference", zero: "--draw-zero", before: "--draw-before",
});
const VARIABLES = { disarmed: "--disarmed", hold: "--hold-text", dwell: "--dwell", beam_on: "--on", fault: "--fault" };
const STRIP_PX = 5;
const LEAST_APART_PX = 60;

/** The colour of a state of the gate, that of the page's own variable; an unknown state looks like a fault. */
function colorOf(gate) {
  return ink(VARIABLES[gate] ?? VARIABLES.fault);
}

/** Clip to the plot. */
export function clip({ context, box }) {
  context.beginPath();
  context.rect(box.x0, box.y0, box.x1 - box.x0, box.y1 - box.y0);
  context.clip();
}

export function drawUnit({ context, box }, unit) {
  context.save();
  context.fillStyle = INK.faint;
  context.font = font(12);
  context.textBaseline = "alphabetic";
  context.translate(11, (box.y0 + box.y1) / 2);
  context.rotate(-Math.PI / 2);
  context.textAlign = "center";
  context.fillText(tr("trace_layers.inhale_up", { unit }), 0, 0);
  context.restore();
}

/** The reference is zero of the axis. */
export function drawReference({ context, box, y }) {
  context.strokeStyle = COLORS.zero;
  context.lineWidth = 1;
  stroke(context, box.x0, y(0), box.x1, y(0));
}

export function drawBeam({ context, box, x }, intervals) {
  context.save();
  context.fillStyle = colorOf("beam_on");
  context.globalAlpha = 0.16;
  for (const [from, to] of intervals) context.fillRect(x(from), box.y0, x(to) - x(from), box.y1 - box.y0);
  context.restore();
}

/** A strip at the bottom with the gate's state, the beam on as high as the others; white where nothing was received. */
export function drawStates({ context, box, x }, intervals) {
  for (const { from, to, gate } of intervals) {
    context.fillStyle = colorOf(gate);
    context.fillRect(x(from), box.y1 - STRIP_PX, Math.max(1, x(to) - x(from)), STRIP_PX);
  }
}

/** Marks where a hold began that is not the window's; its cause stands in the lane. */
export function drawHolds({ context, box, x }, holds) {
  for (const { t, gate } of holds) {
    context.fillStyle = colorOf(gate);
    context.fillRect(x(t), box.y1 - STRIP_PX - 11, 1.5, 11);
  }
}

/**
 * The labels of what is marked, in a lane of their own below the plot: none lies on the curve or on another. One that has no
 * room is left out: the list of events has it.
 *
 * @param {{t: number, text: string, color: string}[]} labels
 */
export function drawLane({ context, box, x }, labels) {
  context.font = font(13, 600);
  context.textAlign = "left";
  context.textBaseline = "top";
  let free = -Infinity;
  for (const { t, text, color } of labels.toSorted((one, other) => one.t - other.t)) {
    const width = context.measureText(text).width;
    const at = Math.min(Math.max(x(t), box.x0), box.x1 - width);
    if (at < free || x(t) > box.x1) continue;
    context.fillStyle = color;
    context.fillText(text, at, box.y1 + 4);
    free = at + Math.max(width + 10, LEAST_APART_PX);
  }
}

/** What the lane says of holds, and of changes of the zero. */
export function labelsOf(holds, steps) {
  const ofHolds = holds.map(({ t, gate, text }) => ({ t, text, color: colorOf(gate) }));
  return [...ofHolds, ...steps.map(({ t, text }) => ({ t, text, color: COLORS.reference }))];
}

/** Draw a strip at the top where the phase was inside its window. */
export function drawPhase({ context, box, x }, intervals) {
  context.fillStyle = COLORS.window;
  for (const [from, to] of intervals) context.fillRect(x(from), box.y0, Math.max(2, x(to) - x(from)), 4);
}

export function drawGaps({ context, box, x }, intervals) {
  context.fillStyle = hatch(context);
  for (const [from, to] of intervals) context.fillRect(x(from), box.y0, x(to) - x(from), box.y1 - box.y0);
}

/** Mark where the zero changed; what lies before the last change was measured against another zero. */
export function drawSteps({ context, box, x }, steps) {
  if (steps.length === 0) return;
  const newest = Math.min(box.x1, x(steps.at(-1).t));
  context.fillStyle = COLORS.before;
  if (newest > box.x0) context.fillRect(box.x0, box.y0, newest - box.x0, box.y1 - box.y0);
  context.strokeStyle = COLORS.reference;
  context.lineWidth = 1.5;
  context.setLineDash([6, 3]);
  for (const { t } of steps) stroke(context, x(t), box.y0, x(t), box.y1);
  context.setLineDash([]);
}

export function drawWindow({ context, box, y }, condition) {
  const { lower, upper, hysteresis: inner } = condition;
  context.fillStyle = COLORS.inside;
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
}

/** Draw edges that are being edited, each with a grip. */
export function drawProposal({ context, box, y }, { lower, upper, unit }) {
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
    context.fillText(`${fixed(edge, digits)} ${unit}`, box.x1 - 40, y(edge) + shift);
  }
}

/** A moment that is looked at, by its own time. */
export function drawMoment({ context, box, x }, t) {
  context.strokeStyle = COLORS.now;
  context.lineWidth = 1;
  context.setLineDash([4, 3]);
  stroke(context, x(t), box.y0, x(t), box.y1);
  context.setLineDash([]);
}

export function drawNow({ context, x, y }, t, value) {
  context.fillStyle = COLORS.now;
  context.beginPath();
  context.arc(x(t), y(value), 4, 0, 2 * Math.PI);
  context.fill();
}

/** Say in the plot's corner why no window is drawn. */
export function drawRemark({ context, box }, text) {
  context.fillStyle = INK.faint;
  context.font = font(12);
  context.textAlign = "right";
  context.textBaseline = "top";
  context.fillText(text, box.x1 - 6, box.y0 + 4);
}

function stroke(context, x0, y0, x1, y1) {
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
}
