/** Plays bursts of pulses with the browser's audio, and says whether it can: browsers play nothing before a click. */

import { EDGE, HARMONICS, PATTERNS } from "./patterns.js";

/** Loudness at 100 % [full scale]. */
const FULL_GAIN = 0.5;
/** A burst begins so much after it is scheduled [s]. */
const AHEAD_S = 0.02;

export class Player {
  constructor() {
    this.context = typeof AudioContext === "undefined" ? null : new AudioContext();
    this.wave = this.context?.createPeriodicWave(new Float32Array(HARMONICS.length), new Float32Array(HARMONICS)) ?? null;
    this.sounding = [];
    for (const name of ["pointerdown", "keydown"]) window.addEventListener(name, () => this.unlock(), { capture: true });
  }

  /** @returns {"missing"|"blocked"|"on"} */
  get state() {
    if (this.context === null || this.context.state === "closed") return "missing";
    return this.context.state === "running" ? "on" : "blocked";
  }

  unlock() {
    if (this.context !== null && this.context.state !== "running") this.context.resume().catch(() => {});
  }

  /** @param {number} volume 0 to 1 */
  play(priority, volume) {
    if (this.state !== "on") return;
    const { hz, pulseS, starts } = PATTERNS[priority];
    const beginS = this.context.currentTime + AHEAD_S;
    for (const startS of starts) this.#pulse(hz, beginS + startS, pulseS, volume * FULL_GAIN);
  }

  /** End what is sounding now. */
  stop() {
    for (const tone of this.sounding) tone.stop();
    this.sounding = [];
  }

  #pulse(hz, fromS, lengthS, gain) {
    const tone = this.context.createOscillator();
    const level = this.context.createGain();
    tone.setPeriodicWave(this.wave);
    tone.frequency.value = hz;
    level.gain.setValueAtTime(0, fromS);
    level.gain.linearRampToValueAtTime(gain, fromS + EDGE * lengthS);
    level.gain.setValueAtTime(gain, fromS + (1 - EDGE) * lengthS);
    level.gain.linearRampToValueAtTime(0, fromS + lengthS);
    tone.connect(level);
    level.connect(this.context.destination);
    tone.start(fromS);
    tone.stop(fromS + lengthS);
    this.sounding.push(tone);
    tone.addEventListener("ended", () => { this.sounding = this.sounding.filter((one) => one !== tone); });
  }
}
