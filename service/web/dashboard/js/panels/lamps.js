/** Two lamps side by side: whether the gate permits the beam, and whether the accelerator reports one. For people to compare. */

import { byId, setText } from "../drawing/elements.js";
import { tr } from "../words/words.js";

/** @param {?object} sample the newest sample while the gate's state is known, else null */
export function renderLamps(sample) {
  show(byId("lamp-gate"), sample === null ? "unknown" : sample.gate === "beam_on" ? "on" : "off");
  show(byId("lamp-beam"), beamOf(sample));
}

function beamOf(sample) {
  if (sample === null) return "unknown";
  const beam = sample.accelerator_beam ?? null;
  if (beam === null) return "none";
  return beam === "on" || beam === "off" ? beam : "unknown";
}

function show(lamp, state) {
  lamp.dataset.state = state;
  setText(lamp.querySelector("strong"), tr(`lamp.${state}`));
}
