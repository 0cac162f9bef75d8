/** The breathing panel: phase, rate, amplitude, drift, events and breath hold; a dash for unknown values. */

import { said, setText } from "../drawing/elements.js";
import { fixed, signed } from "../drawing/numbers.js";
import { conditionsOf } from "../stream/gating_window.js";
import { tr } from "../words/words.js";

const NONE = "–";
const STAGES = {
  awaited: tr("breath.waiting_for_the_breath_hold"),
  settling: tr("breath.keep_still"),
  held: tr("breath.held"),
  drifted: tr("breath.drifted_breathe"),
  over: tr("breath.time_limit_reached_breathe"),
};
const EVENTS = {
  cough: tr("breath.cough"),
  sigh: tr("breath.sigh"),
  apnoea: tr("breath.no_breath"),
  talking: tr("breath.talking"),
  irregular: tr("breath.irregular_breathing"),
  drift: tr("breath.the_baseline_drifts"),
};
const RING = { center: 30, radius: 25 };
const byId = (id) => document.getElementById(id);

/** @param {?object} sample the newest sample if it is current */
export function renderBreath(sample) {
  const breath = sample?.breath ?? null;
  setText(byId("breath-signal"), breath ? `${breath.signal}, ${breath.unit}` : "");
  renderPhase(sample, breath);
  const length = (value, hasSign) => (Number.isFinite(value) ? (hasSign ? signed : plain)(value, digits(breath)) : NONE);
  setText(byId("figure-rate"), Number.isFinite(breath?.rate_per_min) ? fixed(breath.rate_per_min, 1) : NONE);
  setText(byId("figure-amplitude"), length(breath?.amplitude, false));
  setText(byId("figure-baseline"), length(breath?.baseline, true));
  setText(byId("figure-drift"), length(breath?.drift, true));
  setText(byId("figure-drift-rate"), length(breath?.drift_per_s, true));
  setText(byId("figure-regularity"), Number.isFinite(breath?.regularity) ? `${Math.round(100 * breath.regularity)} %` : NONE);
  const isDrifting = breath?.events.some((event) => event.kind === "drift") ?? false;
  byId("figure-drift").dataset.bad = isDrifting ? "yes" : "no";
  renderEvents(breath);
  renderHold(sample?.breath_hold ?? null, sample !== null);
}

function digits(breath) {
  return breath.unit === "l" ? 2 : 1;
}

function plain(value, places) {
  return fixed(value, places);
}

function renderPhase(sample, breath) {
  const phase = breath?.phase_percent;
  const isKnown = Number.isFinite(phase);
  const dot = byId("phase-dot");
  dot.setAttribute("visibility", isKnown ? "visible" : "hidden");
  if (isKnown) {
    const [x, y] = place(phase);
    dot.setAttribute("cx", x.toFixed(2));
    dot.setAttribute("cy", y.toFixed(2));
  }
  const phases = conditionsOf(sample?.window).filter((one) => one.kind === "phase");
  // Where no phase gates, none is shown.
  if (sample !== null) byId("phase").hidden = phases.length === 0;
  byId("phase-window").setAttribute("d", phases.map(arc).join(" "));
  setText(byId("phase-value"), isKnown ? `${Math.round(phase)} %` : NONE);
  setText(byId("phase-note"), isKnown ? tr("breath.phase_confidence", { value: fixed(breath.phase_confidence, 2) }) : unknown(sample, breath));
}

function unknown(sample, breath) {
  if (sample === null) return tr("breath.phase_unknown");
  if (breath === null) return sample.state === "measuring" ? tr("breath.phase_unknown_this_signal_has_no_breathing_a") : tr("breath.phase_unknown_not_measured");
  return tr("breath.phase_unknown_2", { value: said(breath.note) || tr("breath.no_reason_given") });
}

/** Return a point of the ring: 0 % at the top, clockwise. */
function place(percent) {
  const angle = (2 * Math.PI * percent) / 100;
  return [RING.center + RING.radius * Math.sin(angle), RING.center - RING.radius * Math.cos(angle)];
}

function arc({ from_percent: from, to_percent: to }) {
  if (!Number.isFinite(from) || !Number.isFinite(to)) return "";
  const [[x0, y0], [x1, y1]] = [place(from), place(to)];
  const isLarge = (to - from + 100) % 100 > 50 ? 1 : 0;
  return `M${x0.toFixed(2)} ${y0.toFixed(2)}A${RING.radius} ${RING.radius} 0 ${isLarge} 1 ${x1.toFixed(2)} ${y1.toFixed(2)}`;
}

function renderEvents(breath) {
  const lines = breath === null ? [] : breath.events.map((event) => [event.kind, eventText(event)]);
  if (breath !== null && lines.length === 0) lines.push(["none", tr("breath.no_events")]);
  const list = byId("breath-events");
  while (list.children.length > lines.length) list.lastChild.remove();
  while (list.children.length < lines.length) list.append(document.createElement("li"));
  for (const [place_, [kind, text]] of lines.entries()) {
    list.children[place_].dataset.kind = kind;
    setText(list.children[place_], text);
  }
}

function eventText(event) {
  const name = EVENTS[event.kind] ?? String(event.kind);
  return [`${name}, ${Math.round(event.since_s)} s`, tr("breath.sure", { value: Math.round(100 * event.confidence) }), event.detail].filter(Boolean).join(" · ");
}

function renderHold(hold, isCurrent) {
  const root = byId("breath-hold");
  // The space stays reserved while the value is unknown, so the layout does not move.
  if (hold !== null) root.hidden = false;
  else if (isCurrent) root.hidden = true;
  root.dataset.stage = hold?.stage ?? "unknown";
  setText(byId("hold-stage"), hold ? (STAGES[hold.stage] ?? String(hold.stage)) : NONE);
  setText(byId("hold-seconds"), Number.isFinite(hold?.seconds) ? fixed(hold.seconds, 1) : NONE);
  setText(byId("hold-count"), hold ? String(hold.count) : NONE);
  const whole = hold?.stage === "settling" ? hold.settle_s : hold?.timeout_s;
  const runs = hold?.stage === "settling" || hold?.stage === "held";
  byId("hold-bar").value = runs && Number.isFinite(hold.seconds) ? Math.min(1, hold.seconds / whole) : 0;
}
