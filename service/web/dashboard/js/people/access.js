/**
 * The log-in and its permissions. Polled from the controller and not kept over a reload: scripts cannot read the cookie.
 */

import { logOut, onRefusal, readMe } from "../api.js";
import { may } from "./permissions.js";
import { tr } from "../words/words.js";

/** Period of checking the log-in [ms]; a closed socket or a refused call triggers a check at once. */
const ASK_MS = 20_000;
const RETRY_MS = 2000;
/** Shortest time between checks after refusals [ms]. */
const REFUSED_MS = 3000;

const ENDED = tr("access.your_log_in_has_ended_the_gate_s_state_is_un");
const LEFT = tr("access.you_have_logged_out");
const LEFT_ARMED = tr("access.you_have_logged_out_the_gate_that_you_armed");

export class Access {
  /** @param {() => void} onChange called when the state or the person changes */
  constructor(onChange) {
    this.onChange = onChange;
    /** @type {"asking"|"out"|"change"|"in"} "change": logged in, and the password must be changed first */
    this.state = "asking";
    this.person = null;
    this.reason = "";
    this.epoch = 0;
    this.nextAskMs = 0;
    this.refusedMs = -Infinity;
    onRefusal((status) => this.#refused(status));
  }

  /** @returns {boolean} whether the log-in permits this */
  may(action) {
    return this.state === "in" && may(this.person, action);
  }

  /** Check the log-in when it is due; call it often. */
  tend(nowMs) {
    if (this.state !== "out" && !document.hidden && nowMs >= this.nextAskMs) this.ask();
  }

  async ask() {
    this.nextAskMs = performance.now() + (this.state === "asking" ? RETRY_MS : ASK_MS);
    const { epoch } = this;
    try {
      const person = await readMe();
      if (epoch === this.epoch) this.accept(person);
    } catch (error) {
      if (epoch !== this.epoch) return;
      if (error.status === 401) this.lose();
      // The controller did not answer: the log-in may still be valid. The stream shows that the gate is unknown.
      else if (this.state === "asking") this.reason = error.message;
    }
  }

  /** @param {object} person the person, from the controller's answer */
  accept(person) {
    const state = person.must_change_password ? "change" : "in";
    const isSame = state === this.state && JSON.stringify(person) === JSON.stringify(this.person);
    this.person = person;
    if (!isSame) this.#become(state, "");
  }

  /** Note that the log-in has ended. */
  lose() {
    if (this.state === "out") return;
    const reason = this.state === "asking" ? "" : ENDED;
    this.person = null;
    this.#become("out", reason);
  }

  /**
   * Log out; throws without a change if the controller does not answer.
   *
   * @param {boolean} hasArmed whether this person armed the gate, which is then held
   */
  async leave(hasArmed) {
    try {
      await logOut();
    } catch (error) {
      if (error.status !== 401) throw error;
    }
    this.person = null;
    this.#become("out", hasArmed ? LEFT_ARMED : LEFT);
  }

  #refused(status) {
    if (status === 401) {
      if (this.state === "in" || this.state === "change") this.lose();
      return;
    }
    const nowMs = performance.now();
    if (nowMs - this.refusedMs < REFUSED_MS) return;
    this.refusedMs = nowMs;
    this.ask();
  }

  #become(state, reason) {
    this.epoch += 1;
    this.nextAskMs = performance.now() + ASK_MS;
    this.state = state;
    this.reason = reason;
    this.onChange();
  }
}
