/** What lies below and above the lines of the trace: beam on, gaps, windows, references, states of the gate, the newest value. */

import { font, hatch, INK } from "./canvas.js";
import { tr } from "../words/words.js";

export const COLORS = {
  line: "#8fd3ff", thorax: "#f0b7ff", abdomen: "#b9e07a", window: "#e8d27a", proposal: "#ff9de1", now: "#ffffff",
  reference: "#cfd8e0",
};
const VARIABLES = { disarmed: "--disarmed", hold: "--hold", dwell: "--dwell", beam_on: "--on", fault: "--fault" };
const STRIP_PX = 5;
const colors = new Map();

/** The colour of a state of the gate, that of the page's own variable; an unknown state looks like a fault. */
function colorOf(gate) {
  const name = VARIABLES[gate] ?? VARIABLES.fault;
  if (!colors.has(name)) colors.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return colors.get(name);
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
export function drawReference({ context, box, y }, text) {
  context.strokeStyle = "#4a5865";
  context.lineWidth = 1;
  stroke(context, box.x0, y(0), box.x1, y(0));
  if (text === "") return;
  context.fillStyle = COLORS.reference;
  context.font = font(11);
  context.textAlign = "right";
  context.textBaseline = "top";
  context.fillText(text, box.x1 - 8, y(0) + 3);
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

/** Marks where a hold began that is not the window's, with its cause. */
export function drawHolds({ context, box, x }, holds) {
  context.font = font(11, 600);
  context.textAlign = "left";
  context.textBaseline = "bottom";
  let end = -Infinity;
  for (const { t, gate, text } of holds) {
    const at = x(t);
    context.fillStyle = colorOf(gate);
    context.fillRect(at, box.y1 - STRIP_PX - 11, 1.5, 11);
    if (at < end) continue;
    context.fillText(text, at + 4, box.y1 - STRIP_PX - 1);
    end = at + context.measureText(text).width + 12;
  }
}

/** Draw a strip at the top where the phase was inside its window. */
export function drawPhase({ context, box, x }, intervals) {
  context.fillStyle = COLORS.window;
  for (const [from, to] of intervals) context.fillRect(x(from), box.y0, Math.max(2, x(to) - x(from)), 4);
}

export function drawGaps({ context, box, x }, intervals) {
  context.fillStyle = hatch(context, "rgba(150, 165, 180, 0.34)");
  for (const [from, to] of intervals) context.fillRect(x(from), box.y0, x(to) - x(from), box.y1 - box.y0);
}

/** Mark where the zero changed; what lies before the last change was measured against another zero. */
export function drawSteps({ context, box, x }, steps) {
  if (steps.length === 0) return;
  const newest = Math.min(box.x1, x(steps.at(-1).t));
  context.fillStyle = "rgba(13, 19, 25, 0.55)";
  if (newest > box.x0) context.fillRect(box.x0, box.y0, newest - box.x0, box.y1 - box.y0);
  context.strokeStyle = COLORS.reference;
  context.fillStyle = COLORS.reference;
  context.lineWidth = 1.5;
  context.font = font(12, 600);
  context.textAlign = "right";
  context.textBaseline = "top";
  for (const { t, text } of steps) {
    context.setLineDash([6, 3]);
    stroke(context, x(t), box.y0, x(t), box.y1);
    context.setLineDash([]);
    context.fillText(text, x(t) - 5, box.y0 + 4);
  }
}

export function drawWindow({ context, box, y }, condition) {
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
  const name = condition.kind === "breath_hold" ? tr("trace_layers.breath_hold") : tr("trace_layers.window");
  context.fillText(tr("trace_layers.edges", { name, lower: lower.toFixed(digits), upper: upper.toFixed(digits), unit }).replaceAll("-", "−"), box.x0 + 6, y(upper) - 3);
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
    context.fillText(`${edge.toFixed(digits)} ${unit}`.replace("-", "−"), box.x1 - 40, y(edge) + shift);
  }
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
