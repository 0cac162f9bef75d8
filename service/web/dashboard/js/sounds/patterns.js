/**
 * The sounds of alarms by priority, after IEC 60601-1-8, table 3 and 4: pulses of a tone with harmonics, in bursts.
 *
 * High: ten pulses in two groups of five (three and two); medium: three; low: two. A higher priority is higher, faster and
 * comes again sooner.
 */

/** Order of the priorities, the least urgent first. */
export const PRIORITIES = ["low", "medium", "high"];

/** Spacing of the five pulses of a group of a high alarm, in pulse spacings from the first. */
const GROUP = [0, 1, 2, 4, 5];

/**
 * @typedef {{hz: number, pulseS: number, starts: number[], repeatS: number}} Pattern pitch [Hz], length of a pulse [s], begin of
 *   each pulse from that of the burst [s], time from burst to burst [s]
 */

/** @type {Record<string, Pattern>} */
export const PATTERNS = {
  high: { hz: 660, pulseS: 0.15, starts: [0, 1.6].flatMap((from) => GROUP.map((place) => from + 0.25 * place)), repeatS: 6 },
  medium: { hz: 440, pulseS: 0.2, starts: [0, 0.4, 0.8], repeatS: 9 },
  low: { hz: 330, pulseS: 0.2, starts: [0, 0.4], repeatS: 20 },
};

/** Amplitudes of the harmonics: five within 15 dB of the first, so that a tone is heard where one frequency is not. */
export const HARMONICS = [0, 1, 0.7, 0.5, 0.4, 0.3];

/** Edges of a pulse, as a part of its length. */
export const EDGE = 0.2;

/** @returns {number} rank of a priority; an unknown one counts as high */
export function rankOf(priority) {
  const rank = PRIORITIES.indexOf(priority);
  return rank === -1 ? PRIORITIES.length - 1 : rank;
}
