/** The training panel: progress, model and reference, and the reasons that disable buttons. */

import { said, setText } from "../drawing/elements.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

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
 * first measurement is ignored, and a reference that the stream has already is set.
 */
export function needsReference(sample, session) {
  return sample?.state === "measuring" && session?.measurement_state === "measuring" && session.has_reference === false && !sample.reference;
}

const TITLES = {
  none: tr("training.measuring"),
  gathering: tr("training.measuring_training_again"),
  comparing: tr("training.measuring_comparing"),
  fitting: tr("training.measuring_training_again"),
  waiting: tr("training.a_new_model_is_ready"),
  refused: tr("training.measuring_no_new_model"),
};

/** Show the stage: training, measuring or lost. */
export function renderLearning(sample, session, isFresh) {
  const view = learning(sample, session, isFresh);
  const root = document.getElementById("learning");
  root.dataset.phase = view.phase;
  root.dataset.stage = view.stage ?? "none";
  setText(document.getElementById("learning-title"), isFresh ? view.title : tr("training.not_known"));
  setText(document.getElementById("learning-share"), view.share === null ? "" : `${Math.round(100 * view.share)} %`);
  setText(document.getElementById("learning-detail"), view.detail);
  const bar = document.getElementById("learning-bar");
  bar.value = view.share ?? 0;
  bar.hidden = view.share === null;
}

function learning(sample, session, isFresh) {
  if (!sample) return { phase: "none", title: isFresh ? tr("training.not_measuring") : tr("training.not_known"), share: null, detail: "" };
  if (sample.state === "training") {
    return { phase: "training", title: tr("training.training"), share: sample.training?.share ?? null, detail: progressText(sample.training) };
  }
  const stage = stageOf(sample);
  const besides = stageText(stage, sample.training);
  if (sample.state === "lost") {
    return { phase: "lost", stage, title: tr("training.patient_not_visible"), share: null, detail: [said(sample.lost?.detail), besides].filter(Boolean).join(" · ") };
  }
  const hasBar = ["gathering", "comparing", "fitting"].includes(stage);
  const detail = besides || inUse(sample, session);
  return { phase: "measuring", stage, title: TITLES[stage], share: hasBar ? sample.training.share : null, detail };
}

function inUse(sample, session) {
  if (sample.is_armed) return tr("training.armed_the_gate_decides");
  return needsReference(sample, session) ? tr("training.no_reference_yet_set_the_reference") : tr("training.the_model_is_in_use_not_armed");
}

function stageText(stage, progress) {
  if (stage === "none") return "";
  if (stage === "waiting") return tr("training.the_new_model_is_applied_when_the_gate_is_di");
  if (stage === "refused") return tr("training.refused", { note: said(progress.note) });
  return stage === "fitting" ? said(progress.note) : progressText(progress);
}

function progressText(progress) {
  if (!progress) return "";
  const parts = [tr("count.frames", { n: progress.frames }), cycles(progress.cycles), `${fixed(progress.seconds, 0)} s`];
  return [...parts, said(progress.note)].filter(Boolean).join(" · ");
}

function cycles(count) {
  return count === 1 ? tr("training.1_breath") : tr("count.breaths", { n: count });
}
