/**
 * The displayed gate state: one pure function from the stream and the time to word, shape and reason.
 *
 * An unknown, stale or contradictory state is never shown as a beam state.
 */

import { rolesText } from "../people/permissions.js";
import { said } from "../drawing/elements.js";
import { FAULT_MS, IDLE_STALE_MS, STALE_MS } from "./live_stream.js";
import { adviceFor, whatIs } from "../words/reasons.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

const INTERLOCK = "beam_without_permit";

const WORDS = { disarmed: tr("gate_state.disarmed"), hold: tr("gate_state.hold"), dwell: tr("gate_state.dwell"), beam_on: tr("gate_state.beam_on"), fault: tr("gate_state.fault") };

const REASONS = {
  disarmed: tr("gate_state.the_gate_is_not_armed_the_beam_is_held"),
  hold: tr("gate_state.the_beam_is_held"),
  dwell: tr("gate_state.inside_the_window_dwell_time_is_running"),
  beam_on: tr("gate_state.inside_the_window_the_beam_is_permitted"),
  fault: tr("gate_state.the_beam_is_held_until_a_named_person_acknow"),
};

const UNKNOWN = tr("gate_state.the_state_of_the_gate_is_not_known_here");

const UNSEEN = { toDo: tr("state.stale.do"), call: tr("state.stale.call") };
/** What to do in states without a reason. */
const STAND_IN = { stale: UNSEEN, offline: UNSEEN, connecting: { toDo: "", call: "" }, out: { toDo: "", call: "" }, idle: { toDo: tr("state.idle.do"), call: "" }, fault: adviceFor("unknown") };

/** Time that the line may read on without a permit before a warning [ms]; one frame is normal. */
const MISMATCH_MS = 250;

/**
 * @returns {{kind: string, word: string, reason: string, detail: string, ageMs: ?number, isFresh: boolean, isCurrent: boolean,
 *   warning: string}} `isFresh`: the state of the gate is known; `isCurrent`: so is what the camera sees
 */
export function present(stream, nowMs) {
  const { message } = stream;
  if (stream.problem !== "") return stopped("offline", tr("gate_state.no_connection"), stream.problem, null);
  if (message === null) return unconnected(stream, nowMs);
  const ageMs = stream.ageMs(nowMs);
  if (message.type === "idle") {
    if (ageMs > IDLE_STALE_MS) return stale(ageMs);
    return { ...stopped("idle", tr("gate_state.no_session"), tr("gate_state.the_beam_is_held"), null), isFresh: true, isCurrent: true };
  }
  // A latched fault stays valid without new frames, so it is shown as long as the controller sends messages; and beyond a
  // short silence, in which the engine is replaced: a fault that gives way to "stale" would look as if it were over.
  const isFault = message.gate === "fault";
  if (isFault ? stream.silenceMs(nowMs) > FAULT_MS : ageMs > STALE_MS) return stale(ageMs, stream.silenceMs(nowMs) > STALE_MS ? UNKNOWN : tr("gate_state.the_camera_s_newest_frame_is_too_old"));
  return gate(message, ageMs);
}

/**
 * The display without a log-in that permits watching: no gate state.
 *
 * @param {import("../people/access.js").Access} access
 */
export function presentLocked(access) {
  if (access.state === "asking") return stopped("connecting", tr("gate_state.connecting"), access.reason || tr("gate_state.waiting_for_the_controller"), null);
  if (access.state === "change") return stopped("out", tr("gate_state.locked"), tr("gate_state.change_your_password_first"), null);
  if (access.state === "out") return stopped("out", tr("gate_state.logged_out"), access.reason || tr("gate_state.log_in_to_see_it", { UNKNOWN }), null);
  return stopped("out", tr("gate_state.not_shown"), tr("gate_state.your_roles_do_not_permit_watching_sessions", { value: rolesText(access.person.roles) || tr("roles.none") }), null);
}

function gate(message, ageMs) {
  const kind = message.gate;
  if (message.session_status !== "running" && kind !== "beam_on") {
    return fresh("idle", tr("gate_state.ended"), tr("gate_state.the_session_has_ended", { session_status: tr(`status.${message.session_status}`), value: message.hold_reason ? whatIs(message.hold_reason, message.hold_text) : tr("gate_state.the_beam_is_held") }), null);
  }
  if (!(kind in WORDS)) {
    return stopped("fault", tr("gate_state.unknown"), tr("gate_state.the_controller_reports_a_state_this_page_doe", { value: String(kind).slice(0, 40) }), ageMs);
  }
  if (kind === "beam_on" && message.line_on !== true) {
    return { ...fresh("hold", tr("gate_state.line_off"), tr("gate_state.the_gate_permits_the_beam_but_the_beam_line"), ageMs), toDo: tr("state.line_off.do"), call: tr("hold.permit_without_beam.call") };
  }
  return { ...fresh(kind, wordOf(message), reasonOf(message), ageMs), ...adviceOf(message), detail: detailOf(message) };
}

/** "Beam on" is what the accelerator says, a permit is what the gate gives; beam without a permit is for the room's interlock. */
function wordOf({ gate, hold_reason: code, accelerator_beam: beam }) {
  if (gate === "fault" && code === INTERLOCK) return tr("gate_state.interlock");
  return gate === "beam_on" && beam !== "on" ? tr("gate_state.permitted") : WORDS[gate];
}

/** Why the gate is in its state, from its code. */
function reasonOf({ gate, hold_reason: code, hold_text: sentence }) {
  if (code !== null && code !== undefined && gate !== "beam_on") return whatIs(code, sentence);
  return REASONS[gate];
}

/** How couch or camera have moved since the reference, which the next one has to confirm; null where neither has. */
export function roomMoveOf(sample) {
  return sample?.lost?.moved ? { what: sample.lost.moved, mm: fixed(sample.lost.moved_mm, 1) } : null;
}

function adviceOf(message) {
  const { gate, hold_reason: code } = message;
  const move = gate === "disarmed" ? roomMoveOf(message) : null;
  if (move !== null) return { toDo: tr(`moved.${move.what}.what`, move), call: "" };
  if (gate === "beam_on" || (gate === "dwell" && !code)) return { toDo: tr("state.beam_on.do"), call: "" };
  return adviceFor(code);
}

/** Details of the hold reason, and the operator who holds in addition to it. */
function detailOf(message) {
  const unnamed = message.hold_reason === "operator_hold" ? message.operator_holds.slice(1) : message.operator_holds;
  const holder = unnamed.length > 0 ? tr("gate_state.also_held_by", { operator_hold: unnamed.join(", ") }) : "";
  return [said(message.hold_detail), holder].filter(Boolean).join(" · ");
}

/** Detects a beam line that reads on without a permit. */
export class MismatchWatch {
  constructor() {
    this.sinceMs = null;
  }

  /** @returns {string} the warning, or an empty string */
  check(message, nowMs) {
    const isWrong = message !== null && message.type === "sample" && message.line_on === true && message.gate !== "beam_on";
    if (!isWrong) this.sinceMs = null;
    else this.sinceMs ??= nowMs;
    return isWrong && nowMs - this.sinceMs >= MISMATCH_MS ? tr("gate_state.the_beam_line_reads_on_or_does_not_answer_al") : "";
  }
}

function unconnected(stream, nowMs) {
  const sinceMs = stream.lastNewsMs === null ? null : nowMs - stream.lastNewsMs;
  if (!stream.hasConnectedOnce && stream.retryAtMs === null) return stopped("connecting", tr("gate_state.connecting"), tr("gate_state.waiting_for_the_controller"), null);
  const waitS = stream.retryAtMs === null ? 0 : Math.round((stream.retryAtMs - nowMs) / 1000);
  const wait = waitS < 1 ? tr("gate_state.trying_again_now") : tr("gate_state.trying_again_in_s", { waitS });
  return stopped("offline", tr("gate_state.no_connection"), `${UNKNOWN} ${wait}`, sinceMs);
}

function stale(ageMs, reason = UNKNOWN) {
  return stopped("stale", tr("gate_state.stale"), reason, ageMs);
}

function stopped(kind, word, reason, ageMs) {
  return { kind, word, reason, detail: "", ...STAND_IN[kind], ageMs, isFresh: false, isCurrent: false, warning: "" };
}

function fresh(kind, word, reason, ageMs) {
  return { kind, word, reason, detail: "", toDo: "", call: "", ageMs, isFresh: true, isCurrent: (ageMs ?? 0) <= STALE_MS, warning: "" };
}
