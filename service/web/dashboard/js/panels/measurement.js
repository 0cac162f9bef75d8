/** The measurement panel: values of the newest fresh sample, a dash for values that were not measured. */

import { capitalized, part, said, setText } from "../drawing/elements.js";
import { fixed, signed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

const NONE = "–";

const FIGURES = {
  "figure-whole": (s) => with_(s.whole_mm, (v) => signed(v, 2)),
  "figure-thorax": (s) => with_(s.thorax_mm, (v) => signed(v, 2)),
  "figure-abdomen": (s) => with_(s.abdomen_mm, (v) => signed(v, 2)),
  "figure-volume": (s) => with_(s.volume_l, (v) => signed(v, 2)),
  "figure-residual": (s) => with_(s.residual_mm, (v) => fixed(v, 2)),
  "figure-coverage": (s) => with_(s.valid_share, (v) => `${fixed(100 * v, 0)} %`),
  "figure-seen": (s) => seenCells(s),
  "figure-travel": (s) => with_(s.position?.travel_mm, (v) => fixed(v, 1)),
  "figure-fps": (s) => with_(s.fps, (v) => fixed(v, 1)),
  "figure-missed": (s) => with_(s.missed_frames, (v) => String(v)),
  "figure-latency": (s) => latency(s.latency_ms),
};

export function renderFigures(sample, isSimulatedBeam) {
  for (const [id, textOf] of Object.entries(FIGURES)) setText(document.getElementById(id), sample ? textOf(sample) : NONE);
  if (sample !== null || document.body.dataset.fresh === "yes") renderChecks(sample?.checks ?? []);
  document.getElementById("figure-latency").dataset.bad = sample?.latency_ms?.warned === true ? "yes" : "no";
  document.getElementById("figure-missed").dataset.bad = sample?.missed_frames > 0 ? "yes" : "no";
  // What is marked inside is marked outside, too: the figures may be folded away.
  const isBad = sample?.latency_ms?.warned === true || sample?.missed_frames > 0;
  document.getElementById("technical").dataset.bad = isBad ? "yes" : "no";
  document.getElementById("badge-simulated").hidden = !isSimulatedBeam;
}

/** Show what the gate rests on: each check of the measurement, and one that cannot work with the time of that. */
function renderChecks(checks) {
  const strip = document.getElementById("checks");
  const key = JSON.stringify(checks.map((one) => [one.name, one.state, one.state === "on" ? 0 : Math.floor(one.seconds ?? 0), one.text]));
  if (strip.dataset.key === key) return;
  strip.dataset.key = key;
  strip.replaceChildren(...(checks.length === 0 ? [NONE] : checks.map(check)));
}

function check({ name, state, seconds, text }) {
  const time = state === "off" && seconds !== null ? ` ${Math.floor(seconds)} s` : "";
  const label = tr(`checks.${name}`);
  const item = part("span", state === "on" ? `✓ ${label}` : `✕ ${label} ${tr(`checks.${state}`)}${time}`);
  Object.assign(item.dataset, { check: name, state });
  item.title = state === "on" ? "" : text;
  return item;
}

/** Show how far the zero of the trace lies from the fraction's first reference; marked beyond the site's budget. */
export function renderReference(reference) {
  const line = document.getElementById("reference-distance");
  setText(line, reference ? `${capitalized(said(reference.text))}${parts(reference)}` : "");
  line.dataset.bad = reference?.is_beyond ? "yes" : "no";
  line.title = reference?.distance_mm ? rotation(reference) : "";
}

function parts(reference) {
  if (reference.distance_mm === null) return `: ${said(reference.unknown)}`;
  return tr("measurement.height_shift", { value: signed(reference.height_mm, 1), value2: fixed(reference.shift_mm, 1) });
}

function rotation({ turn_deg: turn, tilt_deg: tilt, shape_mm: shape }) {
  return tr("measurement.turn_tilt_shape_mm", { value: fixed(turn, 1), value2: fixed(tilt, 1), value3: fixed(shape, 1) });
}

/** Show permanently that a session uses what the camera brings itself: its registration, or its maker's calibration. */
export function renderCalibration(kind) {
  document.getElementById("badge-uncalibrated").hidden = !kind || kind === "uploaded";
}

/** Show permanently that a recording gates a real beam line. */
export function renderSource(warning) {
  document.getElementById("badge-played").hidden = !warning;
}

/** Show a camera that is not, or may not be, the calibrated one. */
export function renderCamera(camera) {
  const badge = document.getElementById("badge-camera");
  badge.hidden = !camera?.warning;
  setText(badge, camera?.code === "camera_mismatch" ? tr("measurement.another_camera_than_calibrated") : tr("measurement.camera_not_compared"));
  badge.title = camera?.warning ?? "";
}

/** Show that the body differs from that of the patient's earlier session. */
export function renderBody(warning) {
  const badge = document.getElementById("badge-body");
  badge.hidden = !warning;
  badge.title = warning ?? "";
}

/** Show the comparison of today's patient with the stored model; hidden without one. */
export function renderLikeness(sample, likeness) {
  const row = document.getElementById("likeness");
  row.hidden = !likeness;
  if (!likeness) return;
  setText(document.getElementById("likeness-name"), tr("measurement.model_shift_tilt_shape", { value: likeness.is_accepted ? tr("measurement.stored") : tr("measurement.refused") }));
  const figure = document.getElementById("figure-likeness");
  setText(figure, sample ? distance(likeness) : NONE);
  figure.dataset.bad = likeness.is_accepted ? "no" : "yes";
  row.title = likeness.refusal ?? "";
}

function distance({ shift_mm: shift, tilt_deg: tilt, shape_mm: shape }) {
  const millimetres = (value) => with_(value, (v) => `${fixed(v, 1)} mm`);
  return `${millimetres(Math.hypot(...shift))} · ${with_(tilt, (v) => `${fixed(v, 1)}°`)} · ${millimetres(shape)}`;
}

function seenCells(sample) {
  const cells = (sample.regions_mm ?? []).flat().length;
  return cells === 0 || !sample.unseen_cells ? NONE : tr("count.of", { n: cells - sample.unseen_cells.length, all: cells });
}

function with_(value, textOf) {
  return Number.isFinite(value) ? textOf(value) : NONE;
}

function latency(times) {
  const part = (value) => with_(value, (v) => fixed(v, 1));
  return times ? `${part(times.last)} · ${part(times.p50)} · ${part(times.p99)} · ${part(times.max)}` : NONE;
}
