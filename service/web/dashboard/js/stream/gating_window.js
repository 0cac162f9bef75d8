/** The gating window of a sample: its conditions, their signals and names. */

import { fixed } from "../drawing/numbers.js";
import { has, tr } from "../words/words.js";

/** @returns {object[]} the conditions; the first one's signal is the gated one; empty without a window */
export function conditionsOf(window) {
  if (!window) return [];
  if (window.conditions?.length > 0) return window.conditions;
  const { signal, row, column, lower_mm: lower, upper_mm: upper, hysteresis_mm: hysteresis } = window;
  return [{ kind: "amplitude", signal, row, column, name: null, unit: "mm", lower, upper, hysteresis, is_inside: false }];
}

/** The gated signal of a sample, in the unit of `gatedUnit`; null if it was not measured. */
export function gatedValue(sample) {
  return gatedUnit(sample.window) === "l" ? sample.volume_l : sample.signal_mm;
}

export function gatedUnit(window) {
  return conditionsOf(window)[0]?.signal === "volume" ? "l" : "mm";
}

export function signalName(condition) {
  if (condition.signal === "region" || condition.signal === "point") return tr("gating_window.row_column", { signal: kindOf(condition.signal), row: condition.row, column: condition.column });
  return condition.name || kindOf(condition.signal);
}

function kindOf(signal) {
  return has(`signal.${signal}`) ? tr(`signal.${signal}`) : String(signal);
}

export function hasSameSignal(one, other) {
  return ["signal", "row", "column", "name"].every((key) => (one[key] ?? null) === (other[key] ?? null));
}

/** Whether the edges can be drawn; edges in percent cannot before they are converted to mm or l. */
export function hasEdges(condition) {
  return condition.unit !== "percent" && Number.isFinite(condition.lower) && Number.isFinite(condition.upper);
}

/** Whether a breath hold waits for the level of a breath that was held. */
export function awaitsLevel(window) {
  return conditionsOf(window).some((one) => one.kind === "breath_hold" && !Number.isFinite(one.lower));
}

/** Short description of the conditions, with their edges if they are wanted and known. */
export function describe(window, hasEdgesToo = false) {
  const join = window?.join === "or" ? tr("signal.or") : tr("signal.and");
  return conditionsOf(window).map((one) => `${signalName(one)}${KINDS[one.kind] ?? ""}${hasEdgesToo && hasEdges(one) ? `, ${edgesText(one)}` : ""}`).join(join);
}

function edgesText({ lower, upper, unit }) {
  const digits = unit === "l" ? 2 : 1;
  return tr("gating_window.edges", { lower: fixed(lower, digits), upper: fixed(upper, digits), unit });
}

const KINDS = { amplitude: "", breath_hold: tr("gating_window.breath_hold"), phase: tr("gating_window.phase") };
