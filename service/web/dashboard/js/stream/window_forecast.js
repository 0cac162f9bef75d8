/** What a window would have done in the last minute: the share of the time inside, and the pulses after the dwell. */

/** Longest time between two samples that belong together [s]. */
const JOIN_S = 0.15;

/**
 * Judge samples by an amplitude window as the gate does: the signal enters inside the hysteresis, leaves at the edges, and
 * the beam comes on after the dwell. The gate's other checks are left out.
 *
 * @param {{t: number, value: ?number}[]} samples in the order of time; `t` in s, `value` in the unit of the edges
 * @param {{lower: number, upper: number, hysteresis: number}} window
 * @param {number} dwellS
 * @returns {?{seconds: number, percent: number, pulsesPerMin: number, shortestS: ?number}} null with less than 10 s of
 *   measured samples; `shortestS` is that of the complete pulses, null without one
 */
export function forecast(samples, window, dwellS) {
  const minute = { measuredS: 0, onS: 0, pulses: 0, shortestS: null };
  let insideSince = null;
  let onSince = null;
  let isWhole = false;
  let before = null;
  const end = (t) => {
    if (onSince !== null && isWhole) minute.shortestS = Math.min(minute.shortestS ?? Infinity, t - onSince);
    [insideSince, onSince] = [null, null];
  };
  for (const sample of samples) {
    const isJoined = before !== null && Number.isFinite(sample.value) && sample.t - before.t <= JOIN_S;
    if (isJoined) minute.measuredS += sample.t - before.t;
    if (isJoined && onSince !== null) minute.onS += sample.t - before.t;
    if (!isJoined) end(before?.t ?? sample.t);
    const margin = insideSince === null ? window.hysteresis : 0;
    const isInside = Number.isFinite(sample.value) && sample.value >= window.lower + margin && sample.value <= window.upper - margin;
    if (!isInside) end(sample.t);
    else {
      // A pulse whose beginning was not seen is no measure of the shortest one.
      if (insideSince === null) [insideSince, isWhole] = [sample.t, isJoined];
      if (onSince === null && sample.t - insideSince >= dwellS - 1e-9) {
        onSince = sample.t;
        minute.pulses += 1;
      }
    }
    before = Number.isFinite(sample.value) ? sample : null;
  }
  if (minute.measuredS < 10) return null;
  return {
    seconds: minute.measuredS,
    percent: (100 * minute.onS) / minute.measuredS,
    pulsesPerMin: (60 * minute.pulses) / minute.measuredS,
    shortestS: minute.shortestS,
  };
}
