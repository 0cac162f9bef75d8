/**
 * The treatment's figures below the trace: all from the service, so that a page that is loaded again shows the same. Times
 * between two readings are not counted here; only the age of the gate's state goes on, on the service's clock.
 */

import { byId, setText } from "../drawing/elements.js";
import { shortReason, whatIs } from "../words/reasons.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

const NONE = "–";
const SHOWN_CAUSES = 3;
const STATES = { disarmed: tr("treatment.disarmed"), hold: tr("treatment.hold"), dwell: tr("treatment.dwell"), beam_on: tr("treatment.beam_on"), fault: tr("treatment.fault") };

/**
 * @param {?object} sample the newest sample if it is current
 * @param {?object} session as last read from the service
 * @param {number} serverMs the service's time of day now [ms]
 */
export function renderTreatment(sample, session, serverMs) {
  const summary = sample !== null && session?.id === sample.session_id ? (session.summary ?? null) : null;
  setText(byId("treatment-on"), summary === null ? NONE : onText(summary, session));
  setText(byId("treatment-duty"), summary === null ? NONE : dutyText(summary));
  setText(byId("treatment-elapsed"), duration(summary?.elapsed_s));
  const since = summary === null ? null : sinceOf(sample, session.gate);
  setText(byId("treatment-state-name"), since === null ? tr("treatment.in_this_state") : tr("treatment.for", { state: STATES[sample.gate] ?? sample.gate }));
  setText(byId("treatment-state"), since === null ? NONE : duration(Math.max(0, (serverMs - since) / 1000)));
  const holds = summary?.holds ?? [];
  setText(byId("treatment-holds"), summary === null ? NONE : countText(holds));
  byId("treatment-holds").title = holds.map((one) => `${whatIs(one.reason, one.text)}: ${one.count}`).join("\n");
}

/**
 * How long the gate has been in the state that is shown; empty while that is not known.
 *
 * @param {?number} seenMs for how long this page has seen it, if it saw it begin: the service records it a moment later [ms]
 */
export function timeText(sample, session, serverMs, seenMs) {
  if (sample === null) return "";
  const since = session?.id === sample.session_id ? sinceOf(sample, session.gate) : null;
  const forMs = since === null ? seenMs : serverMs - since;
  return forMs === null ? "" : tr("distance.for", { time: duration(Math.max(0, forMs / 1000)) });
}

/** When the gate came to the state that is shown; null while the service has not recorded it. */
function sinceOf(sample, gate) {
  const isSame = gate?.state === sample.gate && (gate.hold_reason ?? null) === (sample.hold_reason ?? null);
  const since = isSame && gate.state_since ? Date.parse(gate.state_since) : NaN;
  return Number.isFinite(since) ? since : null;
}

/** Beam-on time of this session, and that of the sessions which it continues. */
export function onText(summary, session) {
  const own = duration(summary.beam_on_s);
  if (!session.continues) return own;
  const before = session.delivered_before_s;
  return tr("treatment.before", { own, value: Number.isFinite(before) ? duration(before) : tr("treatment.unknown") });
}

export function dutyText(summary) {
  return Number.isFinite(summary.duty_cycle) ? `${Math.round(100 * summary.duty_cycle)} %` : NONE;
}

function countText(holds) {
  if (holds.length === 0) return tr("treatment.none");
  const shown = holds.slice(0, SHOWN_CAUSES).map((one) => `${shortReason(one.reason)} ${one.count}`);
  return [...shown, ...(holds.length > SHOWN_CAUSES ? [tr("count.more", { n: holds.length - SHOWN_CAUSES })] : [])].join(" · ");
}

/** A time as "41.2 s", "3:07 min" or "1:02:07 h". */
export function duration(seconds) {
  if (!Number.isFinite(seconds)) return NONE;
  if (seconds < 100) return `${fixed(seconds, 1)} s`;
  const whole = Math.floor(seconds);
  const two = (value) => String(value).padStart(2, "0");
  const [hours, minutes, rest] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
  return hours > 0 ? `${hours}:${two(minutes)}:${two(rest)} h` : `${minutes}:${two(rest)} min`;
}
