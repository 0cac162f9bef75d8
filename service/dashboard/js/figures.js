/** The numbers: always from the newest fresh sample, a dash for what was not measured. */

import { setText } from "./gate.js";
import { signed } from "./grid.js";

const NONE = "–";

const FIGURES = {
  "figure-whole": (s) => with_(s.whole_mm, (v) => signed(v, 2)),
  "figure-thorax": (s) => with_(s.thorax_mm, (v) => signed(v, 2)),
  "figure-abdomen": (s) => with_(s.abdomen_mm, (v) => signed(v, 2)),
  "figure-volume": (s) => with_(s.volume_l, (v) => signed(v, 2)),
  "figure-residual": (s) => with_(s.residual_mm, (v) => v.toFixed(2)),
  "figure-coverage": (s) => with_(s.valid_share, (v) => `${(100 * v).toFixed(0)} %`),
  "figure-fps": (s) => with_(s.fps, (v) => v.toFixed(1)),
  "figure-missed": (s) => with_(s.missed_frames, (v) => String(v)),
  "figure-latency": (s) => latency(s.latency_ms),
};

export function renderFigures(sample, isSimulatedBeam) {
  for (const [id, textOf] of Object.entries(FIGURES)) setText(document.getElementById(id), sample ? textOf(sample) : NONE);
  document.getElementById("figure-missed").dataset.bad = sample?.missed_frames > 0 ? "yes" : "no";
  document.getElementById("badge-simulated").hidden = !isSimulatedBeam;
}

/** A session on the camera's own registration says so all the time. */
export function renderCalibration(kind) {
  document.getElementById("badge-uncalibrated").hidden = kind !== "device registration";
}

function with_(value, textOf) {
  return Number.isFinite(value) ? textOf(value) : NONE;
}

function latency(times) {
  const part = (value) => with_(value, (v) => v.toFixed(1));
  return times ? `${part(times.last)} · ${part(times.p50)} · ${part(times.p99)}` : NONE;
}

/** Learning, measuring or lost, in words and with a bar. */
export function renderLearning(sample, isFresh) {
  const view = learning(sample, isFresh);
  document.getElementById("learning").dataset.phase = view.phase;
  setText(document.getElementById("learning-title"), view.title);
  setText(document.getElementById("learning-share"), view.share === null ? "" : `${Math.round(100 * view.share)} %`);
  setText(document.getElementById("learning-detail"), view.detail);
  const bar = document.getElementById("learning-bar");
  bar.value = view.share ?? 0;
  bar.hidden = view.share === null;
}

function learning(sample, isFresh) {
  if (!sample) return { phase: "none", title: isFresh ? "Not measuring" : "Not known", share: null, detail: "" };
  const progress = sample.training;
  const parts = progress ? [`${progress.frames} frames`, cycles(progress.cycles), `${progress.seconds.toFixed(0)} s`] : [];
  if (progress?.note) parts.push(progress.note);
  const detail = parts.join(" · ");
  if (sample.state === "training") return { phase: "training", title: "Learning the breathing", share: progress?.share ?? null, detail };
  if (sample.state === "lost") return { phase: "lost", title: "Patient not seen", share: null, detail: sample.lost?.detail ?? "" };
  if (progress) return { phase: "measuring", title: "Measuring, learning again", share: progress.share, detail };
  return { phase: "measuring", title: "Measuring", share: null, detail: sample.is_armed ? "Armed: the gate decides." : "The model is in use. Not armed." };
}

function cycles(count) {
  return count === 1 ? "1 breath" : `${count} breaths`;
}
