/**
 * The buttons of a session. None switches the beam on: arming allows the gate to do so.
 *
 * Each is enabled only when its call can succeed, and the line below says what is missing. Disarm and Hold are exceptions:
 * they work with one click or their key whenever a running session is known, with or without a fresh connection.
 */

import { act, applyModel, retrain, runningId, setReference, signPosition } from "../api.js";
import { setText } from "../drawing/elements.js";
import { needsReference, stageOf } from "./training.js";
import { obstacle as forbidden } from "../people/permissions.js";
import { rememberArming } from "../people/presence.js";
import { ClickGuard } from "./click_guard.js";
import { TwoPresses } from "./two_presses.js";
import { positionObstacle, renderPosition, signObstacle } from "./position.js";
import { awaitsLevel } from "../stream/gating_window.js";
import { roomMoveOf } from "../stream/gate_state.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

/** Actions that take the beam off, and their keys: never confirmed twice; the result of a key press is always shown. */
const HALTS = { disarm: "Escape", hold: "F8" };
const HALT_TITLES = { disarm: tr("controls.holds_the_beam_until_a_person_arms_again"), hold: tr("controls.holds_the_beam_until_a_person_releases_it_th") };
/** Buttons that never get the focus by themselves: each needs a decision of its own. */
const DECISIONS = ["acknowledge", "release", "sign"];
/** Within this time after an act the next step's button gets the focus [ms]. */
const GO_ON_MS = 60_000;
/** Actions that lead to beam on: clicks that may have been meant for another button are ignored. */
const PERMITTING = ["acknowledge", "arm", "release", "sign"];
/** Actions after which the gate is armed. */
const ARMS = new Set(["arm", "release"]);
const MOVED = tr("controls.the_buttons_moved_less_than_2_s_ago");
/** Time in which "Stop" and "Release" accept the second click [ms], and after which "Release" does. */
const CONFIRM_MS = 4000;
const CONSIDER_MS = 1000;
/** Time in which the state that an action leads to is expected; its message stays [ms]. */
const EXPECT_MS = 2000;
/** The state that each action leads to; under any other its message would contradict what is shown. */
const LEADS_TO = {
  start: "disarmed", arm: "armed", release: "armed", correct: "disarmed", disarm: "disarmed", reference: "disarmed",
  sign: "disarmed", window: "disarmed", acknowledge: "disarmed", stop: "idle", retrain: "disarmed", apply: "disarmed",
};

const DONE = {
  start: tr("controls.session_started"),
  arm: tr("controls.armed_the_gate_controls_the_beam"),
  hold: tr("controls.held_until_released"),
  release: tr("controls.released_the_beam_needs_a_full_dwell"),
  correct: tr("controls.disarmed_the_window_was_shifted"),
  disarm: tr("controls.disarmed"),
  reference: tr("controls.reference_set"),
  sign: tr("controls.position_signed"),
  window: tr("controls.window_set"),
  acknowledge: tr("controls.fault_acknowledged"),
  alarms: tr("controls.alarms_acknowledged"),
  stop: tr("controls.session_stopped"),
  retrain: tr("controls.training_again_in_the_background"),
  apply: tr("controls.disarmed_the_new_model_is_applied"),
};

/** Why an action is not possible now, in the order to fix it; empty if it is. Permissions are checked before. */
const OBSTACLES = {
  arm: (c) => running(c) || still(c) || (c.sample.gate === "fault" ? tr("controls.acknowledge_the_fault_first") : "") || measuring(c) || compared(c) || hasReference(c) || isApplied(c) || isInPlace(c) || positionObstacle(c.sample.position_check) || hasHead(c),
  release: (c) => running(c) || (c.sample.operator_hold ? "" : tr("controls.no_operator_holds_the_beam")),
  reference: (c) => running(c) || still(c) || measuring(c) || isProposed(c) || isSetUp(c),
  sign: (c) => running(c) || still(c) || signObstacle(c.sample.position_check, typedReason()),
  retrain: (c) => running(c) || compared(c) || (isLearning(c.sample) ? tr("controls.already_training") : ""),
  apply: (c) => running(c) || (stageOf(c.sample) === "waiting" ? "" : tr("controls.no_new_model_is_ready")),
  acknowledge: (c) => running(c) || (c.sample.gate === "fault" ? (c.sample.accelerator_beam === "on" ? tr("controls.beam_is_still_reported") : "") : tr("controls.there_is_no_fault")),
  start: (c) => (c.kind === "idle" ? "" : tr("controls.a_session_is_running")) || (waits(c) ? "" : tr("controls.create_a_session_first")),
  stop: (c) => (waits(c) ? "" : running(c)),
};

/** Whether a session is created and not yet started; there is at most one. */
const waits = (c) => c.kind === "idle" && c.selected?.status === "created";
const running = (c) => (c.sample === null ? tr("controls.no_running_session") : "");
const still = (c) => (c.sample.is_armed ? tr("controls.disarm_first") : "");
const compared = (c) => (stageOf(c.sample) === "comparing" ? tr("controls.the_stored_model_is_still_being_compared") : "");
const hasReference = (c) => (needsReference(c.sample, c.selected) ? tr("controls.set_the_reference_first") : "");
const isApplied = (c) => (c.isWindowEdited ? tr("controls.apply_the_window_or_cancel_it") : awaitsLevel(c.sample.window) ? tr("controls.level_of_the_hold_first") : "");
/** In clinical mode a person confirms stickers and chest before the session's first reference. */
const isSetUp = (c) => (c.selected?.mode !== "clinical" || !needsReference(c.sample, c.selected) || document.getElementById("setup-confirmed").checked ? "" : tr("controls.confirm_stickers_and_chest_first"));
const typedReason = () => document.getElementById("reference-reason").value.trim();
const referenceAt = () => document.getElementById("reference-at").value;
/** The proposed position for the chosen moment of the breath; null for the present position, and before it is known. */
const proposalOf = (c) => c.selected?.reference_proposals?.find((one) => one.at === referenceAt()) ?? null;
const isProposed = (c) => (referenceAt() === "now" || proposalOf(c) !== null ? "" : tr("controls.fewer_than_two_breaths_are_known"));
const isInPlace = (c) => (roomMoveOf(c.sample) === null ? "" : tr(`moved.${roomMoveOf(c.sample).what}.first`));
/** What the person who sets the reference was shown. */
const shownOf = (c) => ({
  ...(proposalOf(c) === null ? {} : { level_seen: proposalOf(c).level }),
  ...(roomMoveOf(c.sample) === null ? {} : { move_seen_mm: c.sample.lost.moved_mm }),
});
/** A lost patient adds no training frames while the reference is kept: training may then be restarted. */
const isLearning = (s) => s.state === "training" || stageOf(s) === "fitting" || (s.state === "measuring" && stageOf(s) === "gathering");
/** The head direction of the session that is armed; null if unknown, or if the session was not read yet. */
const headOf = (c) => (c.selected?.id === c.sample?.session_id ? (c.selected?.head_direction ?? null) : null);
/** Signals that are the same from whichever side the head lies. */
const SYMMETRIC = new Set(["whole", "volume"]);
const hasHead = (c) => (headOf(c) !== null || (c.sample.window?.conditions ?? []).every((one) => SYMMETRIC.has(one.signal)) ? "" : tr("controls.the_head_direction_is_unknown_create_the_ses"));
const measuring = (c) => (c.sample.state === "measuring" ? "" : c.sample.state === "training" ? tr("controls.still_training") : tr("controls.the_patient_is_not_visible"));

export class Controls {
  /**
   * @param {() => void} onChange called when an action has been done
   * @param {(sessionId: string, head: ?string) => void} onArm shows what would be armed
   * @param {() => boolean} onEscape closes what is open over the page; returns whether something was
   */
  constructor(onChange, onArm, onEscape) {
    Object.assign(this, { onChange, onArm, onEscape });
    this.busy = null;
    this.busyAction = "";
    this.permittedMs = -Infinity;
    this.lastRunningId = null;
    this.context = { kind: "connecting", sample: null, selected: null, person: null };
    this.outcome = document.getElementById("outcome");
    this.said = { state: "", atMs: -Infinity, action: "" };
    this.asked = {};
    this.left = null;
    this.turn = null;
    this.setupConfirmed = document.getElementById("setup-confirmed");
    this.setupConfirmed.addEventListener("change", () => this.update(this.context));
    this.keepsReference = document.getElementById("keep-reference");
    for (const action of Object.keys(OBSTACLES)) button(action).addEventListener("click", (event) => this.#press(action, event));
    this.clickGuard = new ClickGuard(PERMITTING.map(button));
    this.presses = new TwoPresses(button("acknowledge"), tr("controls.press_again"));
    for (const action of Object.keys(HALTS)) button(action).addEventListener("click", () => this.halt(action));
    document.addEventListener("keydown", (event) => {
      const action = Object.keys(HALTS).find((one) => HALTS[one] === event.key);
      if (action === undefined) return;
      if (action === "hold") event.preventDefault();
      // Disarm an armed gate at once, also one that may be; close open panels only while it is known not to be armed.
      if (action === "disarm" && this.#isSurelyDisarmed() && this.onEscape()) return;
      if (!event.repeat) this.halt(action);
    }, { capture: true });
  }

  /** Name of the person who is logged in; empty if there is none. */
  get operatorName() {
    return this.context.person?.name ?? "";
  }

  get isBusy() {
    return this.busy !== null;
  }

  get isWindowEdited() {
    return this.context.isWindowEdited === true;
  }

  /** The reason typed beside the reference, which a correction far from the fraction's first needs too. */
  get reason() {
    return typedReason();
  }

  /** Clear the reason: it is given for one call only. */
  forgetReason() {
    document.getElementById("reference-reason").value = "";
  }

  /** Why the log-in does not permit this action; empty if it does. */
  forbids(action) {
    return forbidden(this.context.person, action);
  }

  /** Clear messages and session after a log-out, before another person logs in. */
  forget() {
    this.lastRunningId = null;
    this.busy = null;
    this.forgetReason();
    this.say("", "");
  }

  /** @param {{kind: string, sample: ?object, selected: ?object, person: ?object}} context the fresh sample of a running session, or null; the person who is logged in, or null */
  update(context) {
    this.context = context;
    if (context.sample !== null && context.sample.session_id !== this.lastRunningId) this.setupConfirmed.checked = false;
    if (context.sample !== null) this.lastRunningId = context.sample.session_id;
    else if (context.kind === "idle") this.lastRunningId = null;
    for (const [action, obstacle] of Object.entries(OBSTACLES)) {
      const why = this.forbids(action) || obstacle(this.context);
      button(action).disabled = why !== "" || this.busy !== null;
      button(action).title = why === "" ? "" : tr("controls.not_now", { why });
    }
    if (!button("arm").disabled) button("arm").title = tr("controls.shows_what_would_be_armed_before_it_is");
    this.#showTurn();
    const laidOut = { ...context, sample: context.sample ?? context.laidOut ?? null };
    setText(document.getElementById("hint"), hint(laidOut));
    const proposal = proposalText(laidOut);
    document.getElementById("reference").hidden = proposal === "";
    // Before the session's first reference there is none to keep: the tick's place is that of the set-up.
    const isFirst = proposal !== "" && needsReference(laidOut.sample, context.selected);
    document.getElementById("setup-confirmed-field").hidden = !isFirst;
    document.getElementById("keep-reference-field").hidden = isFirst;
    setText(document.getElementById("reference-proposal"), proposal);
    const move = proposal === "" ? null : roomMoveOf(laidOut.sample);
    setText(button("reference"), move === null ? tr("page.set_reference") : tr(`moved.${move.what}.confirm`, move));
    this.#goOn();
    renderPosition(laidOut.sample?.position_check, proposalOf(laidOut), this.operatorName);
    for (const action of Object.keys(HALTS)) {
      const why = this.forbids(action) || (this.#runsNone ? tr("controls.no_running_session") : "");
      button(action).disabled = why !== "";
      button(action).title = why === "" ? HALT_TITLES[action] : tr("controls.not_now", { why });
    }
    button("setup").disabled = context.person === null;
    button("release").classList.toggle("go", Boolean(context.sample?.operator_hold));
    this.#forgetOutcome();
    if (!isAnothers(context)) this.#ask("release", false);
    if (button("acknowledge").disabled && this.presses.askedMs !== null) this.presses.reset();
    button("apply").hidden = stageOf(laidOut.sample) !== "waiting";
    this.keepsReference.disabled = button("retrain").disabled;
    const isIgnored = this.clickGuard.update(performance.now());
    for (const action of PERMITTING) showGuard(button(action), isIgnored);
  }

  /** Give the place of the next button to the one that has its turn; none while the gate decides. */
  #showTurn() {
    const { kind, sample, selected } = this.context;
    let turn = this.turn;
    if (sample?.gate === "fault") turn = "acknowledge";
    else if (sample?.operator_hold) turn = "release";
    else if (sample?.is_armed) turn = null;
    else if (sample !== null) turn = needsReference(sample, selected) || roomMoveOf(sample) !== null ? "reference" : "arm";
    else if (kind === "idle") turn = "start";
    if (turn === this.turn) return;
    for (const one of [this.turn, turn]) if (one) button(one).dataset.turn = one === turn ? "yes" : "no";
    this.turn = turn;
  }

  /** Whether no gate can be armed: the state is known, and nothing on its way arms. */
  #isSurelyDisarmed() {
    const { kind, sample } = this.context;
    if (performance.now() - this.permittedMs < EXPECT_MS || ARMS.has(this.busyAction)) return false;
    return sample === null ? kind === "idle" || this.lastRunningId === null : sample.is_armed === false;
  }

  async halt(action) {
    const why = this.forbids(action);
    if (why !== "" && this.context.kind !== "idle") {
      this.say("failed", `${label(action)}: ${why}.${elsewhere(action)}`);
      return;
    }
    if (this.#runsNone) return;
    await this.#attempt(action, async () => this.#call(action, this.lastRunningId ?? (await runningId()), this.operatorName));
  }

  /** Whether the state is known, and no session runs: in any other state a person can stop the beam. */
  get #runsNone() {
    return this.lastRunningId === null && this.context.kind === "idle";
  }

  /** Run an action of another panel and show its result here. */
  async run(action, call) {
    await this.#attempt(action, call);
  }

  #press(action, event) {
    if (action === "stop" && !this.#isConfirmed(action)) return;
    if (PERMITTING.includes(action) && !this.#isMeant(action, event)) return;
    if (action === "acknowledge" && !this.presses.isConfirmed(event)) return;
    if (action === "release" && isAnothers(this.context) && !this.#isConfirmed(action, CONSIDER_MS)) return;
    this.#leave(action);
    if (action === "arm") {
      this.onArm(this.context.sample.session_id, headOf(this.context));
      return;
    }
    const id = this.context.sample?.session_id ?? this.context.selected.id;
    this.#send(action, id, this.operatorName);
  }

  /** Focus must not stay on a button whose action has changed: it goes to the next step's, once that is known. */
  #leave(action) {
    if (document.activeElement === button(action)) this.left = { action, atMs: performance.now() };
    document.activeElement?.blur();
  }

  /** The person is done with the fields of a step: the focus goes on as after its button. */
  leaveFields(action) {
    document.activeElement?.blur();
    this.left = { action, atMs: performance.now() };
  }

  /** Focus the next step's button after an act, unless the person has gone elsewhere. Never one that is a decision. */
  #goOn() {
    if (this.left === null || this.busy !== null) return;
    if (document.activeElement !== document.body || performance.now() - this.left.atMs > GO_ON_MS) this.left = null;
    const next = this.left && document.querySelector(".buttons [data-next=yes]:enabled");
    if (!next || next === button(this.left.action) || DECISIONS.some((one) => next === button(one))) return;
    this.left = null;
    next.focus();
  }

  /** Whether the click counts; else it is ignored with a message. */
  #isMeant(action, event) {
    // A key has no place that another button could come to; Arm shows a summary, which has a guard of its own.
    if (action === "arm" && event.detail === 0) return true;
    const refusal = this.clickGuard.refusal(event);
    if (refusal === "moved") this.say("failed", tr("controls.not_sent", { action: label(action), why: MOVED }));
    return refusal === "";
  }

  /** Whether this is the second click, `afterMs` or more after the first; the first one asks for it. */
  #isConfirmed(action, afterMs = 0) {
    const askedMs = button(action).dataset.asks === "yes" ? this.asked[action].atMs : null;
    if (askedMs !== null && performance.now() - askedMs < afterMs) return false;
    this.#ask(action, askedMs === null);
    return askedMs !== null;
  }

  #ask(action, isAsking) {
    const asking = button(action);
    if (!isAsking && asking.dataset.asks !== "yes") return;
    clearTimeout(this.asked[action]?.timer);
    this.asked[action] = { atMs: performance.now(), timer: isAsking ? setTimeout(() => this.#ask(action, false), CONFIRM_MS) : null };
    asking.dataset.asks = isAsking ? "yes" : "no";
    setText(asking, isAsking ? CONFIRM[action](this.context) : label(action));
  }

  /** Clear a message whose state has passed: under another state it would contradict what is shown. */
  #forgetOutcome() {
    if (this.busy !== null || this.#isStillSo(stateOf(this.context))) return;
    // What failed while the state was known stays while it is unknown: it names the other way to stop the beam.
    const isUnknown = this.context.kind !== "idle" && this.context.sample === null;
    if (isUnknown && this.outcome.dataset.kind === "failed") return;
    this.outcome.dataset.kind = "";
    setText(this.outcome, "");
    this.said = { state: stateOf(this.context), atMs: -Infinity, action: "" };
  }

  /** Whether the message is about this state: the one it was said in, or the one its action leads to, of the same session. */
  #isStillSo(state) {
    const { action, atMs, state: before } = this.said;
    if (action === "") return state === before;
    if (state === before && performance.now() - atMs < EXPECT_MS) return true;
    const isLedTo = action === "hold" ? Boolean(this.context.sample?.operator_hold) : kindOf(state) === LEADS_TO[action];
    return isLedTo && sessionOf(state) === sessionOf(before);
  }

  async #send(action, id, operator) {
    await this.#attempt(action, () => this.#call(action, id, operator));
  }

  async #attempt(action, call) {
    const mine = (this.busy = Symbol(action));
    this.busyAction = action;
    try {
      this.say("busy", tr("controls.sending"));
      this.update(this.context);
      await call();
      const isDisarmed = this.context.sample?.is_armed !== true;
      if (this.busy === mine) this.say("done", action === "release" && isDisarmed ? tr("controls.released") : DONE[action], action);
    } catch (error) {
      // A failed hold or disarm stays visible after later answers: it names the other way to stop the beam.
      this.say("failed", `${label(action)}: ${error.message}${action in HALTS ? elsewhere(action) : ""}`);
    } finally {
      // Also a call that seems to have failed may have armed.
      if (ARMS.has(action)) this.permittedMs = performance.now();
      if (this.busy === mine) [this.busy, this.busyAction] = [null, ""];
      this.update(this.context);
      this.onChange();
    }
  }

  async #call(action, id, operator) {
    if (action === "apply") await applyModel(id, operator);
    else if (action === "reference") {
      await setReference(id, operator, referenceAt(), shownOf(this.context), this.reason, this.setupConfirmed.checked);
      this.forgetReason();
    } else if (action === "sign") {
      await signPosition(id, operator, this.context.sample.position_check.reference_number, this.reason);
      this.forgetReason();
    } else if (action === "release") {
      await act(id, action, operator);
      rememberArming(id, operator);
    } else if (action !== "retrain") await act(id, action, operator);
    else {
      await retrain(id, operator, this.keepsReference.checked);
      // Discarding the reference applies to one training only.
      this.keepsReference.checked = true;
    }
  }

  /** @param {string} action the action that succeeded: its message stays with the state it leads to */
  say(kind, text, action = "") {
    this.said = { state: stateOf(this.context), atMs: performance.now(), action };
    this.outcome.dataset.kind = kind;
    setText(this.outcome, text);
  }
}

const CONFIRM = { stop: () => tr("controls.confirm_stop"), release: (c) => tr("controls.release_s_hold", { operator_hold: c.sample.operator_holds.join(", ") }) };

/** Whether a release ends the hold of others: without a hold of one's own it ends those of all. */
function isAnothers({ sample, person }) {
  return Boolean(sample?.operator_hold) && !sample.operator_holds.includes(person?.name);
}

/** The state that a message below the buttons belongs to: session, gate, and who holds; the window's is one state. */
function stateOf({ kind, sample, selected }) {
  if (sample === null) return `${kind === "idle" ? "idle" : "unknown"} ${selected?.id} ${selected?.status}`;
  const gate = { hold: "armed", dwell: "armed", beam_on: "armed" }[sample.gate] ?? sample.gate;
  return `${gate} ${sample.session_id} ${sample.operator_holds}`;
}

const kindOf = (state) => state.split(" ")[0];
const sessionOf = (state) => state.split(" ")[1];

/** The other way to stop the beam, if this page cannot. */
function elsewhere(action) {
  return ` ${tr(`unable.${action}`)}`;
}

/** What the reference would be, for the person who confirms it. */
function proposalText(context) {
  if (context.sample === null || context.sample.is_armed || context.sample.state !== "measuring") return "";
  if (referenceAt() === "now") return tr("controls.the_position_in_the_next_frame_becomes_the_r");
  const one = proposalOf(context);
  if (one === null) return tr("controls.two_breaths_have_to_be_seen_before_their_pos");
  const place = one.percent === null ? "" : tr("controls.at_of_the_learned_breath", { value: Math.round(one.percent) });
  return tr("controls.mean_of_breaths_scatter", { one: far(one), breaths: one.breaths, value: fixed(one.level, 2), unit: one.unit, value2: fixed(one.scatter, 2), unit2: one.unit, place });
}

/** Where a proposal lies against the fraction's first reference, if it is too far for a click alone. */
function far(one) {
  if (!one.is_beyond) return "";
  const away = one.distance_mm === null ? tr("controls.at_an_unknown_distance") : `${fixed(one.distance_mm, 1)} mm`;
  return tr("controls.needs_a_reason_from_the_fraction_s_first", { away });
}

/** What is missing for the next step. */
function hint(context) {
  const next = context.sample === null ? "start" : "arm";
  if (context.sample === null && context.kind !== "idle") return "";
  if (context.sample?.is_armed) return "";
  const why = forbidden(context.person, next) || OBSTACLES[next](context);
  return why === "" ? "" : tr("controls.to", { next: tr(`to.${next}`), why });
}

/** A guarded button keeps the focus, and a click says why it is ignored: it is not `disabled`. */
function showGuard(element, isIgnored) {
  const isShown = isIgnored && !element.disabled;
  if (isShown) element.title = tr("controls.wait", { MOVED });
  if (isShown) element.setAttribute("aria-disabled", "true");
  else element.removeAttribute("aria-disabled");
}

function button(action) {
  return document.getElementById(`do-${action}`);
}

function label(action) {
  return tr(`action.${action}`);
}
