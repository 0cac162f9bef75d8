/**
 * The displayed gate state: one pure function from the stream and the time to word, shape and reason.
 *
 * An unknown, stale or contradictory state is never shown as a beam state.
 */

import { FAULT_MS, IDLE_STALE_MS, STALE_MS } from "./live_stream.js";

const WORDS = { disarmed: "Disarmed", hold: "Hold", dwell: "Dwell", beam_on: "Beam on", fault: "Fault" };

const REASONS = {
  disarmed: "The gate is not armed. The beam is held.",
  hold: "The beam is held.",
  dwell: "Inside the window. Dwell time is running.",
  beam_on: "Inside the window. The beam is permitted.",
  fault: "The beam is held until a named person acknowledges.",
};

const UNKNOWN = "The state of the gate is not known here.";

/** Time that the line may read on without a permit before a warning [ms]; one frame is normal. */
const MISMATCH_MS = 250;

/**
 * @returns {{kind: string, word: string, reason: string, detail: string, ageMs: ?number, isFresh: boolean, isCurrent: boolean,
 *   warning: string}} `isFresh`: the state of the gate is known; `isCurrent`: so is what the camera sees
 */
export function present(stream, nowMs) {
  const { message } = stream;
  if (stream.problem !== "") return stopped("offline", "No connection", stream.problem, null);
  if (message === null) return unconnected(stream, nowMs);
  const ageMs = stream.ageMs(nowMs);
  if (message.type === "idle") {
    if (ageMs > IDLE_STALE_MS) return stale(ageMs);
    return { ...stopped("idle", "No session", "The beam is held. Create or start a session.", null), isFresh: true, isCurrent: true };
  }
  // A latched fault stays valid without new frames, so it is shown as long as the controller sends messages; and beyond a
  // short silence, in which the engine is replaced: a fault that gives way to "stale" would look as if it were over.
  const isFault = message.gate === "fault";
  if (isFault ? stream.silenceMs(nowMs) > FAULT_MS : ageMs > STALE_MS) return stale(ageMs, stream.silenceMs(nowMs) > STALE_MS ? UNKNOWN : "The camera's newest frame is too old.");
  return gate(message, ageMs);
}

/**
 * The display without a log-in that permits watching: no gate state.
 *
 * @param {import("../people/access.js").Access} access
 */
export function presentLocked(access) {
  if (access.state === "asking") return stopped("connecting", "Connecting", access.reason || "Waiting for the controller.", null);
  if (access.state === "change") return stopped("out", "Locked", "Change your password first.", null);
  if (access.state === "out") return stopped("out", "Logged out", access.reason || `${UNKNOWN} Log in to see it.`, null);
  return stopped("out", "Not shown", `Your roles (${access.person.roles.join(", ") || "none"}) do not permit watching sessions.`, null);
}

function gate(message, ageMs) {
  const kind = message.gate;
  if (message.session_status !== "running" && kind !== "beam_on") {
    return fresh("idle", "Ended", `The session has ended (${message.session_status}). ${message.hold_text || "The beam is held."}`, null);
  }
  if (!(kind in WORDS)) {
    return stopped("fault", "Unknown", `The controller reports a state this page does not know: ${String(kind).slice(0, 40)}`, ageMs);
  }
  if (kind === "beam_on" && message.line_on !== true) {
    return fresh("hold", "Line off", "The gate permits the beam, but the beam line reads off.", ageMs);
  }
  return { ...fresh(kind, WORDS[kind], message.hold_text || REASONS[kind], ageMs), detail: detailOf(message) };
}

/** Details of the hold reason, and the operator who holds in addition to it. */
function detailOf(message) {
  const holder = message.operator_hold && message.hold_reason !== "operator_hold" ? `Also held by ${message.operator_hold}.` : "";
  return [message.hold_detail ?? "", holder].filter(Boolean).join(" · ");
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
    return isWrong && nowMs - this.sinceMs >= MISMATCH_MS ? "The beam line reads ON, or does not answer, although the gate holds. Use the room's interlock." : "";
  }
}

function unconnected(stream, nowMs) {
  const sinceMs = stream.lastNewsMs === null ? null : nowMs - stream.lastNewsMs;
  if (!stream.hasConnectedOnce && stream.retryAtMs === null) return stopped("connecting", "Connecting", "Waiting for the controller.", null);
  const waitS = stream.retryAtMs === null ? 0 : Math.round((stream.retryAtMs - nowMs) / 1000);
  const wait = waitS < 1 ? "Trying again now." : `Trying again in ${waitS} s.`;
  return stopped("offline", "No connection", `${UNKNOWN} ${wait}`, sinceMs);
}

function stale(ageMs, reason = UNKNOWN) {
  return stopped("stale", "Stale", reason, ageMs);
}

function stopped(kind, word, reason, ageMs) {
  return { kind, word, reason, detail: "", ageMs, isFresh: false, isCurrent: false, warning: "" };
}

function fresh(kind, word, reason, ageMs) {
  return { kind, word, reason, detail: "", ageMs, isFresh: true, isCurrent: (ageMs ?? 0) <= STALE_MS, warning: "" };
}
