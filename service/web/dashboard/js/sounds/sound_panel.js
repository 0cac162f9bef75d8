/** The state of the sound in the header, always to be seen, and the panel for volume, test and silence. */

import { byId, setText } from "../drawing/elements.js";
import { offerThemes } from "../drawing/theme.js";
import { offerLanguages } from "../words/document.js";
import { tr } from "../words/words.js";
import { AlarmSounds } from "./alarm_sounds.js";
import { PRIORITIES } from "./patterns.js";
import { Player } from "./player.js";
import { bounded, keepVolume, LEAST, MOST, readVolume } from "./settings.js";

export class SoundPanel {
  constructor() {
    this.player = new Player();
    this.sounds = new AlarmSounds(this.player, readVolume() / 100);
    this.panel = byId("sounds");
    this.button = byId("do-sound");
    this.quiet = byId("do-silence");
    const volume = byId("sound-volume");
    Object.assign(volume, { min: LEAST, max: MOST, step: 5, value: readVolume() });
    volume.addEventListener("input", () => {
      keepVolume(Number(volume.value));
      this.sounds.volume = bounded(Number(volume.value)) / 100;
    });
    for (const priority of PRIORITIES) byId(`sound-test-${priority}`).addEventListener("click", () => this.#test(priority));
    this.button.addEventListener("click", () => this.show(this.panel.hidden));
    byId("sounds-close").addEventListener("click", () => this.show(false));
    this.quiet.addEventListener("click", () => this.#silence(performance.now()));
    for (const one of document.querySelectorAll("select.language")) offerLanguages(one);
    for (const one of document.querySelectorAll("select.theme")) offerThemes(one);
  }

  show(isShown) {
    this.panel.hidden = !isShown;
    this.button.setAttribute("aria-expanded", String(isShown));
  }

  /** Close the panel. @returns {boolean} whether it was open */
  close() {
    const wasOpen = !this.panel.hidden;
    this.show(false);
    return wasOpen;
  }

  update(view, sample, alarms, nowMs) {
    this.sounds.update(view, sample, alarms, nowMs);
    const left = this.sounds.silenceMs(nowMs);
    const { state } = this.player;
    document.body.dataset.sound = state === "on" && left > 0 ? "silenced" : state;
    setText(this.button, textOf(state, left, this.sounds.volume));
    this.quiet.hidden = this.sounds.sounding === "" && left === 0;
    setText(this.quiet, tr(left > 0 ? "sound.resume" : "sound.silence"));
  }

  #test(priority) {
    this.player.stop();
    this.player.play(priority, this.sounds.volume);
  }

  #silence(nowMs) {
    if (this.sounds.silenceMs(nowMs) > 0) this.sounds.resume();
    else this.sounds.silence(nowMs);
  }
}

function textOf(state, leftMs, volume) {
  if (state !== "on") return tr(`sound.${state}`);
  if (leftMs === 0) return tr("sound.on", { percent: Math.round(100 * volume) });
  const seconds = Math.ceil(leftMs / 1000);
  return tr("sound.silenced", { left: `${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}` });
}
