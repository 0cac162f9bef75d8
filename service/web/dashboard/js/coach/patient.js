/** The patient's page: the form for the pairing code, then the guidance, full screen and without a control. */

import { pairScreen, readWatcher } from "../api.js";
import { ClosingCover } from "../drawing/closing_cover.js";
import { byId, say, setText } from "../drawing/elements.js";
import { STALE_MS } from "../stream/live_stream.js";
import { browserLanguage, word } from "../words/words.js";
import { Guidance } from "./guidance.js";
import { GuidePicture } from "./guide_picture.js";
import { Tones } from "./tones.js";

const TICK_MS = 50;
/** Period of asking whether the screen is paired, while the controller cannot be reached [ms]. */
const ASK_MS = 2000;

const form = byId("pair");
const input = byId("pair-code");
const outcome = byId("pair-outcome");
const guidance = new Guidance(() => ask());
const picture = new GuidePicture(byId("guide"));
const cover = new ClosingCover(byId("cover"), STALE_MS);
const tones = new Tones();
let askAtMs = 0;
let spoken = "";

/** Ask whether this browser is a paired screen; without an answer the guidance tries on by itself. */
async function ask() {
  askAtMs = Infinity;
  try {
    const watcher = await readWatcher();
    if (watcher.is_screen) begin();
    else unpair();
  } catch (error) {
    if (error.status === 401 || error.status === 403) unpair();
    else askAtMs = performance.now() + ASK_MS;
  }
}

function begin() {
  document.body.dataset.state = "paired";
  form.hidden = true;
  guidance.start();
  // Without it a tablet goes dark in the middle of a fraction.
  navigator.wakeLock?.request("screen").catch(() => {});
}

function unpair() {
  guidance.stop();
  render(); // before the form is seen: nothing of the patient is beside it
  document.body.dataset.state = "unpaired";
  if (form.hidden) {
    form.hidden = false;
    input.value = "";
    input.focus();
  }
}

async function pair(event) {
  event.preventDefault();
  tones.unlock();
  document.documentElement.requestFullscreen?.().catch(() => {});
  try {
    await pairScreen(input.value.replace(/\s/g, ""));
    say(outcome, "", "");
    begin();
  } catch (error) {
    say(outcome, "failed", refusal(error));
    input.select();
  }
}

function refusal(error) {
  const language = browserLanguage();
  if (error.status === 0 || error.status >= 500) return word(language, "pair.unreachable");
  return error.status === 429 ? word(language, "pair.locked", { seconds: error.retryAfterS ?? "?" }) : word(language, "pair.refused");
}

function render() {
  const nowMs = performance.now();
  cover.keepOpen(nowMs);
  if (nowMs >= askAtMs) ask();
  const view = guidance.view(nowMs);
  const language = guidance.language ?? browserLanguage();
  picture.draw(view, language, nowMs);
  tones.follow(view);
  speak(view, language);
}

/** Say the instruction to a screen reader, once. */
function speak(view, language) {
  document.documentElement.lang = language;
  const instruction = view.guide?.instruction ?? "none";
  if (instruction === spoken) return;
  spoken = instruction;
  setText(byId("say"), instruction === "none" ? "" : word(language, `patient.${instruction}`));
}

function draw() {
  render();
  requestAnimationFrame(draw);
}

for (const element of document.querySelectorAll("[data-word]")) setText(element, word(browserLanguage(), element.dataset.word));
form.addEventListener("submit", pair);
window.addEventListener("pointerdown", () => tones.unlock());
document.addEventListener("visibilitychange", () => {
  if (!document.hidden && document.body.dataset.state === "paired") navigator.wakeLock?.request("screen").catch(() => {});
});
ask();
setInterval(render, TICK_MS);
requestAnimationFrame(draw);
