/** Colours of motion: blue for exhale, dark for the reference, amber for inhale; distinguishable with colour blindness. */

const STEPS_MM = [2, 5, 10, 15, 20, 30, 50];
const SHRINK_AFTER_MS = 30000;
const ENDS = { negative: [64, 156, 255], zero: [30, 36, 43], positive: [255, 176, 46] };

/** The smallest range of the colours that holds a value [mm]. */
export function stepFor(mostMm) {
  return STEPS_MM.find((step) => step >= mostMm) ?? STEPS_MM.at(-1);
}

/** Range of the colours: grows at once and shrinks after 30 s, so that the picture does not flicker. */
export class Range {
  constructor() {
    this.mm = 5;
    this.neededMs = 0;
  }

  update(regionsMm, nowMs) {
    const most = Math.max(0, ...regionsMm.flat().filter(Number.isFinite).map(Math.abs));
    const needed = stepFor(most);
    if (needed >= this.mm || nowMs - this.neededMs > SHRINK_AFTER_MS) {
      this.mm = needed;
      this.neededMs = nowMs;
    }
    return this.mm;
  }
}

export function colorOf(valueMm, rangeMm, alpha = 1) {
  const share = Math.max(-1, Math.min(1, valueMm / rangeMm));
  const end = share < 0 ? ENDS.negative : ENDS.positive;
  const weight = Math.abs(share);
  const mixed = ENDS.zero.map((from, i) => Math.round(from + (end[i] - from) * weight));
  return `rgba(${mixed.join(", ")}, ${alpha})`;
}
