/** What is learned, and the model and the zero it comes to: in words, with a bar, and as reasons for the buttons. */

import { setText } from "./gate.js";

/** How the controller's notes begin where its figures alone do not tell the stage; tests hold them against the engine. */
const WAITS = "a new model is ready";
const COMPARES = "comparing the stored model";

/**
 * @param {?object} sample
 * @returns {"none"|"gathering"|"comparing"|"fitting"|"waiting"|"refused"} what is on its way beside the measuring
 */
export function stageOf(sample) {
  const progress = sample?.training;
  if (!progress) return "none";
  if (progress.note.startsWith(WAITS)) return "waiting";
  if (progress.note.startsWith(COMPARES)) return "comparing";
  if (progress.frames > 0 || progress.note === "") return "gathering";
  return progress.share >= 1 ? "fitting" : "refused";
}

/**
 * Whether a person has to set the zero before anybody may arm. The session is read now and then only: what it said before
 * the measuring began is not held against the first zero, which sets itself.
 */
export function needsZero(sample, session) {
  return sample?.state === "measuring" && session?.measurement_state === "measuring" && session.has_reference === false;
}

const TITLES = {
  none: "Measuring",
  gathering: "Measuring, learning again",
  comparing: "Measuring, comparing",
  fitting: "Measuring, learning again",
  waiting: "A new model waits",
  refused: "Measuring, nothing new learned",
};

/** Learning, measuring or lost. */
export function renderLearning(sample, session, isFresh) {
  const view = learning(sample, session, isFresh);
  const root = document.getElementById("learning");
  root.dataset.phase = view.phase;
  root.dataset.stage = view.stage ?? "none";
  setText(document.getElementById("learning-title"), view.title);
  setText(document.getElementById("learning-share"), view.share === null ? "" : `${Math.round(100 * view.share)} %`);
  setText(document.getElementById("learning-detail"), view.detail);
  const bar = document.getElementById("learning-bar");
  bar.value = view.share ?? 0;
  bar.hidden = view.share === null;
}

function learning(sample, session, isFresh) {
  if (!sample) return { phase: "none", title: isFresh ? "Not measuring" : "Not known", share: null, detail: "" };
  if (sample.state === "training") {
    return { phase: "training", title: "Learning the breathing", share: sample.training?.share ?? null, detail: progressText(sample.training) };
  }
  const stage = stageOf(sample);
  const besides = stageText(stage, sample.training);
  if (sample.state === "lost") {
    return { phase: "lost", stage, title: "Patient not seen", share: null, detail: [sample.lost?.detail, besides].filter(Boolean).join(" · ") };
  }
  const hasBar = ["gathering", "comparing", "fitting"].includes(stage);
  const detail = besides || inUse(sample, session);
  return { phase: "measuring", stage, title: TITLES[stage], share: hasBar ? sample.training.share : null, detail };
}

function inUse(sample, session) {
  if (sample.is_armed) return "Armed: the gate decides.";
  return needsZero(sample, session) ? "The model is in use, without a zero: set the reference." : "The model is in use. Not armed.";
}

function stageText(stage, progress) {
  if (stage === "none") return "";
  if (stage === "waiting") return "The new model takes over when the gate is disarmed. Applying it disarms.";
  if (stage === "refused") return `Refused: ${progress.note}`;
  return stage === "fitting" ? progress.note : progressText(progress);
}

function progressText(progress) {
  if (!progress) return "";
  const parts = [`${progress.frames} frames`, cycles(progress.cycles), `${progress.seconds.toFixed(0)} s`];
  return [...parts, progress.note].filter(Boolean).join(" · ");
}

function cycles(count) {
  return count === 1 ? "1 breath" : `${count} breaths`;
}
