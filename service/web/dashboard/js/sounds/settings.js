/** The volume of this workstation, in per cent; never below what can be heard. */

const STORED = "tidegate.volume";
export const LEAST = 40;
export const MOST = 100;
const USUAL = 80;

export function readVolume() {
  const stored = Number(localStorage.getItem(STORED) ?? NaN);
  return Number.isFinite(stored) ? bounded(stored) : USUAL;
}

export function keepVolume(percent) {
  localStorage.setItem(STORED, String(bounded(percent)));
}

export function bounded(percent) {
  return Math.min(MOST, Math.max(LEAST, Math.round(percent)));
}
