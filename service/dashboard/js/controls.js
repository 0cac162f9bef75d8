/**
 * The buttons of a session. None can turn the beam on: arming only lets the gate decide.
 *
 * Each is enabled only where it makes sense, and the line below says what is missing. Disarm and Hold are the exceptions:
 * one click or their key, at any time a running session is known, with or without a fresh connection, by whoever may.
 */

import { act, applyModel, retrain } from "./api.js";
import { setText } from "./gate.js";
import { needsZero, stageOf } from "./learning.js";
import { obstacle as forbidden } from "./permissions.js";
import { rememberArming } from "./presence.js";

/** What only takes permission away, and its key: never asked twice; a key is never swallowed, it is told what came of it. */
const HALTS = { disarm: "Escape", hold: "F8" };
const HALT_TITLES = { disarm: "Holds the beam until somebody arms again", hold: "Holds the beam until somebody releases it; the session stays armed" };
/** How long "Stop" waits for the second click [ms]. */
const CONFIRM_MS = 4000;

const DONE = {
  start: "Session started.",
  arm: "Armed: the gate decides now.",
  hold: "Held until released.",
  release: "Released: the gate decides again, after the dwell.",
  correct: "Disarmed. The window was moved.",
  disarm: "Disarmed.",
  reference: "Reference set.",
  acknowledge: "Fault acknowledged.",
  stop: "Session stopped.",
  retrain: "Learning again in the background.",
  apply: "Disarmed. The new model takes over.",
};

/** Why an action makes no sense now, in the order a person would fix it; empty when it does. What a log-in allows comes before. */
const OBSTACLES = {
  arm: (c) => running(c) || still(c) || (c.sample.gate === "fault" ? "acknowledge the fault first" : "") || measuring(c) || compared(c) || zeroed(c),
  release: (c) => running(c) || (c.sample.operator_hold ? "" : "nobody holds the beam"),
  reference: (c) => running(c) || still(c) || measuring(c),
  retrain: (c) => running(c) || compared(c) || (isLearning(c.sample) ? "already learning" : ""),
  apply: (c) => running(c) || (stageOf(c.sample) === "waiting" ? "" : "no new model waits"),
  acknowledge: (c) => running(c),
  start: (c) => (c.kind === "idle" ? "" : "a session is running") || (waits(c) ? "" : "create a session first"),
  stop: (c) => (waits(c) ? "" : running(c)),
};

/** Whether a session has been created and not yet started: there is at most one. */
const waits = (c) => c.kind === "idle" && c.selected?.status === "created";
const running = (c) => (c.sample === null ? "no running session" : "");
const still = (c) => (c.sample.is_armed ? "disarm first" : "");
const compared = (c) => (stageOf(c.sample) === "comparing" ? "the stored model is still being compared" : "");
const zeroed = (c) => (needsZero(c.sample, c.selected) ? "set the reference first" : "");
/** A patient who is not seen teaches nothing behind a kept zero: learning may then begin anew. */
const isLearning = (s) => s.state === "training" || stageOf(s) === "fitting" || (s.state === "measuring" && stageOf(s) === "gathering");
const measuring = (c) => (c.sample.state === "measuring" ? "" : c.sample.state === "training" ? "still learning" : "the patient is not seen");

export class Controls {
  /** @param {() => void} onChange called when an action has been done */
  constructor(onChange) {
    this.onChange = onChange;
    this.busy = null;
    this.lastRunningId = null;
    this.context = { kind: "connecting", sample: null, selected: null, person: null };
    this.outcome = document.getElementById("outcome");
    this.keepsZero = document.getElementById("keeps-zero");
    for (const action of Object.keys(OBSTACLES)) button(action).addEventListener("click", () => this.#press(action));
    for (const action of Object.keys(HALTS)) button(action).addEventListener("click", () => this.halt(action));
    document.addEventListener("keydown", (event) => {
      const action = Object.keys(HALTS).find((one) => HALTS[one] === event.key);
      if (action === undefined) return;
      if (action === "hold") event.preventDefault();
      if (!event.repeat) this.halt(action);
    }, { capture: true });
  }

  /** The name of whoever is logged in; nothing while nobody is. */
  get operatorName() {
    return this.context.person?.name ?? "";
  }

  /** Why whoever is logged in may not do this at all, or nothing. */
  forbids(action) {
    return forbidden(this.context.person, action);
  }

  /** Nobody is logged in any more: what was said and known is not for whoever comes next. */
  forget() {
    this.lastRunningId = null;
    this.busy = null;
    this.say("", "");
  }

  /** @param {{kind: string, sample: ?object, selected: ?object, person: ?object}} context the fresh sample of a running session, or null; who is logged in, or null */
  update(context) {
    this.context = context;
    if (context.sample !== null) this.lastRunningId = context.sample.session_id;
    else if (context.kind === "idle") this.lastRunningId = null;
    for (const [action, obstacle] of Object.entries(OBSTACLES)) {
      const why = this.forbids(action) || obstacle(this.context);
      button(action).disabled = why !== "" || this.busy !== null;
      button(action).title = why === "" ? "" : `Not now: ${why}`;
    }
    setText(document.getElementById("hint"), hint(this.context));
    for (const action of Object.keys(HALTS)) {
      const why = this.forbids(action) || (this.lastRunningId === null ? "no running session" : "");
      button(action).disabled = why !== "";
      button(action).title = why === "" ? HALT_TITLES[action] : `Not now: ${why}`;
    }
    button("setup").disabled = context.person === null;
    button("release").classList.toggle("go", Boolean(context.sample?.operator_hold));
    const isFault = context.sample?.gate === "fault";
    button("acknowledge").hidden = !isFault;
    button("arm").hidden = isFault;
    button("release").hidden = isFault;
    button("apply").hidden = stageOf(context.sample) !== "waiting";
    this.keepsZero.disabled = button("retrain").disabled;
  }

  async halt(action) {
    const why = this.forbids(action);
    if (why !== "" && this.context.kind !== "idle") {
      this.say("failed", `${label(action)}: ${why}.${elsewhere(action)}`);
      return;
    }
    if (this.lastRunningId !== null) await this.#send(action, this.lastRunningId, this.operatorName);
  }

  /** Do something of another panel's, told of here like all else. */
  async run(action, call) {
    await this.#attempt(action, call);
  }

  #press(action) {
    if (action === "stop" && !this.#isConfirmed()) return;
    // Focus must not rest on a button that does something else, or nothing, the next time a key is hit.
    document.activeElement?.blur();
    const id = this.context.sample?.session_id ?? this.context.selected.id;
    this.#send(action, id, this.operatorName);
  }

  #isConfirmed() {
    const stop = button("stop");
    const isSecond = stop.dataset.asks === "yes";
    clearTimeout(this.asking);
    stop.dataset.asks = isSecond ? "no" : "yes";
    setText(stop, isSecond ? "Stop" : "Really stop?");
    if (!isSecond) this.asking = setTimeout(() => { stop.dataset.asks = "no"; setText(stop, "Stop"); }, CONFIRM_MS);
    return isSecond;
  }

  async #send(action, id, operator) {
    await this.#attempt(action, () => this.#call(action, id, operator));
  }

  async #attempt(action, call) {
    const mine = (this.busy = Symbol(action));
    this.say("busy", "Sending…");
    this.update(this.context);
    try {
      await call();
      if (this.busy === mine) this.say("done", DONE[action]);
    } catch (error) {
      // A refused or failed halt is never hidden behind a later answer: it names what else stops the beam.
      this.say("failed", `${label(action)}: ${error.message}${action in HALTS ? elsewhere(action) : ""}`);
    } finally {
      if (this.busy === mine) this.busy = null;
      this.update(this.context);
      this.onChange();
    }
  }

  async #call(action, id, operator) {
    if (action === "apply") await applyModel(id, operator);
    else if (action !== "retrain") {
      await act(id, action, operator);
      if (action === "arm") rememberArming(id, operator);
    }
    else {
      await retrain(id, operator, this.keepsZero.checked);
      // To give the zero up is a choice for once.
      this.keepsZero.checked = true;
    }
  }

  say(kind, text) {
    this.outcome.dataset.kind = kind;
    setText(this.outcome, text);
  }
}

/** What else stops the beam when this page cannot. */
function elsewhere(action) {
  return ` The page could not ${action}: use the room's interlock.`;
}

/** What stands between the person and the next step. */
function hint(context) {
  const next = context.sample === null ? "start" : "arm";
  if (context.sample === null && context.kind !== "idle") return "";
  if (context.sample?.is_armed) return "";
  const why = forbidden(context.person, next) || OBSTACLES[next](context);
  return why === "" ? "" : `To ${next}: ${why}.`;
}

function button(action) {
  return document.getElementById(`do-${action}`);
}

function label(action) {
  return { reference: "Set reference", retrain: "Learn again", apply: "Apply", correct: "Correct baseline" }[action] ?? action[0].toUpperCase() + action.slice(1);
}
