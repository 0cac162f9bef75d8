/** The gating window as the controller tells it: its conditions, what each looks at, and how to name it. */

/** @returns {object[]} the conditions, the first one's signal being the gated one; none where there is no window */
export function conditionsOf(window) {
  if (!window) return [];
  if (window.conditions?.length > 0) return window.conditions;
  const { signal, row, column, lower_mm: lower, upper_mm: upper, hysteresis_mm: hysteresis } = window;
  return [{ kind: "amplitude", signal, row, column, name: null, unit: "mm", lower, upper, hysteresis, is_inside: false }];
}

/** The gated signal of a sample, in the unit of `gatedUnit`; null where it was not measured. */
export function gatedValue(sample) {
  return gatedUnit(sample.window) === "l" ? sample.volume_l : sample.signal_mm;
}

export function gatedUnit(window) {
  return conditionsOf(window)[0]?.signal === "volume" ? "l" : "mm";
}

export function signalName(condition) {
  if (condition.signal === "region" || condition.signal === "point") return `${condition.signal} row ${condition.row}, column ${condition.column}`;
  return condition.name || condition.signal;
}

export function hasSameSignal(one, other) {
  return ["signal", "row", "column", "name"].every((key) => (one[key] ?? null) === (other[key] ?? null));
}

/** Whether a condition has edges that can be drawn: per cent cannot, until they are settled in mm or l. */
export function hasEdges(condition) {
  return condition.unit !== "percent" && Number.isFinite(condition.lower) && Number.isFinite(condition.upper);
}

/** What the conditions are, in a few words. */
export function describe(window) {
  const join = window?.join === "or" ? " or " : " and ";
  return conditionsOf(window).map((one) => `${signalName(one)}${KINDS[one.kind] ?? ""}`).join(join);
}

const KINDS = { amplitude: "", breath_hold: ", breath hold", phase: ", phase" };
