/**
 * Which alarm sounds now, and whether it is silenced. The sounds repeat what the page shows; they replace none of it.
 *
 * An alarm sounds until it ends or a person acknowledges it. Silence lasts for two minutes, ends by itself, and ends before
 * with a new alarm that is as urgent as the most urgent one silenced, or more. Where the page has lost the state of an
 * armed gate, that is an alarm of medium priority of the page's own.
 */

import { PATTERNS, PRIORITIES, rankOf } from "./patterns.js";

export const SILENCE_MS = 120_000;
/** Kinds of the gate's panel in which the page does not know the state. */
const BLIND = new Set(["stale", "offline", "connecting"]);
/** The page's own alarm while it is blind. */
const LOST = { number: "page", priority: "medium" };

export class AlarmSounds {
  /** @param {{play: (priority: string, volume: number) => void, stop: () => void}} player */
  constructor(player, volume) {
    this.player = player;
    this.volume = volume;
    this.wasArmed = false;
    this.silencedUntilMs = -Infinity;
    this.silencedRank = -1;
    this.known = new Set();
    this.nextMs = -Infinity;
    this.sounding = "";
  }

  /** Time for which silence lasts on [ms]; 0 where nothing is silenced. */
  silenceMs(nowMs) {
    return Math.max(0, this.silencedUntilMs - nowMs);
  }

  silence(nowMs) {
    this.silencedUntilMs = nowMs + SILENCE_MS;
    this.silencedRank = PRIORITIES.indexOf(this.sounding);
    this.player.stop();
  }

  resume() {
    this.silencedUntilMs = -Infinity;
  }

  /**
   * @param {{kind: string}} view
   * @param {?{is_armed: boolean}} sample of the running session, while the state is known
   * @param {?{active: object[]}} alarms null where they are not known
   */
  update(view, sample, alarms, nowMs) {
    const open = this.#open(view, sample, alarms);
    const rank = Math.max(-1, ...open.map((one) => rankOf(one.priority)));
    if (open.some((one) => !this.known.has(one.number) && rankOf(one.priority) >= this.silencedRank)) this.resume();
    this.known = new Set(open.map((one) => one.number));
    const wanted = rank === -1 ? "" : PRIORITIES[rank];
    if (wanted !== this.sounding) {
      // One that is less urgent waits for its turn; a more urgent one sounds at once.
      if (rank > PRIORITIES.indexOf(this.sounding)) this.nextMs = nowMs;
      this.sounding = wanted;
      this.player.stop();
    }
    if (wanted === "" || this.silenceMs(nowMs) > 0 || nowMs < this.nextMs) return;
    this.nextMs = nowMs + 1000 * PATTERNS[wanted].repeatS;
    this.player.play(wanted, this.volume);
  }

  /** The alarms that nobody has acknowledged. */
  #open(view, sample, alarms) {
    if (sample !== null) this.wasArmed = sample.is_armed === true;
    else if (!BLIND.has(view.kind)) this.wasArmed = false;
    const open = (alarms?.active ?? []).filter((one) => one.acknowledged_by === null);
    return BLIND.has(view.kind) && this.wasArmed ? [...open, LOST] : open;
  }
}
