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
  document.getElementById("figure-latency").dataset.bad = sample?.latency_ms?.warned === true ? "yes" : "no";
  document.getElementById("figure-missed").dataset.bad = sample?.missed_frames > 0 ? "yes" : "no";
  document.getElementById("badge-simulated").hidden = !isSimulatedBeam;
}

/** A session on the camera's own registration says so all the time. */
export function renderCalibration(kind) {
  document.getElementById("badge-uncalibrated").hidden = kind !== "device registration";
}

/** A recording that gates a real line says so all the time. */
export function renderSource(warning) {
  document.getElementById("badge-played").hidden = !warning;
}

/** How far today's patient is from the stored model the session began with; nothing where there is none. */
export function renderLikeness(sample, likeness) {
  const row = document.getElementById("likeness");
  row.hidden = !likeness;
  if (!likeness) return;
  setText(document.getElementById("likeness-name"), `${likeness.is_accepted ? "Stored" : "Refused"} model: shift · tilt · shape`);
  const figure = document.getElementById("figure-likeness");
  setText(figure, sample ? distance(likeness) : NONE);
  figure.dataset.bad = likeness.is_accepted ? "no" : "yes";
  row.title = likeness.refusal ?? "";
}

function distance({ shift_mm: shift, tilt_deg: tilt, shape_mm: shape }) {
  const millimetres = (value) => with_(value, (v) => `${v.toFixed(1)} mm`);
  return `${millimetres(Math.hypot(...shift))} · ${with_(tilt, (v) => `${v.toFixed(1)}°`)} · ${millimetres(shape)}`;
}

function with_(value, textOf) {
  return Number.isFinite(value) ? textOf(value) : NONE;
}

function latency(times) {
  const part = (value) => with_(value, (v) => v.toFixed(1));
  return times ? `${part(times.last)} · ${part(times.p50)} · ${part(times.p99)} · ${part(times.max)}` : NONE;
}
