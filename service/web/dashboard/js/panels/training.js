/** The training panel: progress, model and reference, and the reasons that disable buttons. */

import { setText } from "../drawing/elements.js";

/** First words of the controller's notes, for stages that its numbers do not distinguish; tests compare them with the engine. */
const WAITS = "a new model is ready";
const COMPARES = "comparing the stored model";

/**
 * @param {?object} sample
 * @returns {"none"|"gathering"|"comparing"|"fitting"|"waiting"|"refused"} the background stage
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
 * Whether a person must set the reference before arming. The session is polled at intervals, so its value from before the
 * first measurement is ignored.
 */
export function needsReference(sample, session) {
  return sample?.state === "measuring" && session?.measurement_state === "measuring" && session.has_reference === false;
}

const TITLES = {
  none: "Measuring",
  gathering: "Measuring, training again",
  comparing: "Measuring, comparing",
  fitting: "Measuring, training again",
  waiting: "A new model is ready",
  refused: "Measuring, no new model",
};

/** Show the stage: training, measuring or lost. */
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
    return { phase: "training", title: "Training", share: sample.training?.share ?? null, detail: progressText(sample.training) };
  }
  const stage = stageOf(sample);
  const besides = stageText(stage, sample.training);
  if (sample.state === "lost") {
    return { phase: "lost", stage, title: "Patient not visible", share: null, detail: [sample.lost?.detail, besides].filter(Boolean).join(" · ") };
  }
  const hasBar = ["gathering", "comparing", "fitting"].includes(stage);
  const detail = besides || inUse(sample, session);
  return { phase: "measuring", stage, title: TITLES[stage], share: hasBar ? sample.training.share : null, detail };
}

function inUse(sample, session) {
  if (sample.is_armed) return "Armed: the gate decides.";
  return needsReference(sample, session) ? "No reference yet: set the reference." : "The model is in use. Not armed.";
}

function stageText(stage, progress) {
  if (stage === "none") return "";
  if (stage === "waiting") return "The new model is applied when the gate is disarmed. Applying it disarms.";
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
