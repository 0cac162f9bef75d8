/**
 * Who is logged in, and what they may. Asked of the controller again and again, and never remembered over a reload: the
 * cookie is the browser's, and this page cannot read it.
 */

import { logOut, onRefusal, readMe } from "./api.js";
import { may } from "./permissions.js";

/** How often the controller is asked whether the log-in still holds [ms]; a closed socket or a refused call asks at once. */
const ASK_MS = 20_000;
const RETRY_MS = 2000;
/** Refusals can come many a second; they are looked into this often [ms]. */
const REFUSED_MS = 3000;

const ENDED = "Your log-in has ended. The gate is not known here, and this page can hold nothing: use the room's interlock.";
const LEFT = "You have logged out. What you had armed is held by hand until somebody releases it.";

export class Access {
  /** @param {() => void} onChange called when the state or the person is another */
  constructor(onChange) {
    this.onChange = onChange;
    /** @type {"asking"|"out"|"change"|"in"} "change": logged in, and a password of their own is to be chosen first */
    this.state = "asking";
    this.person = null;
    this.reason = "";
    this.epoch = 0;
    this.nextAskMs = 0;
    this.refusedMs = -Infinity;
    onRefusal((status) => this.#refused(status));
  }

  /** @returns {boolean} whether whoever is logged in may do this now */
  may(action) {
    return this.state === "in" && may(this.person, action);
  }

  /** To be called often. */
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
      // Not heard: a log-in is not over because of that. That nothing is known of the gate is said by the stream.
      else if (this.state === "asking") this.reason = error.message;
    }
  }

  /** @param {object} person who is logged in, as the controller says it */
  accept(person) {
    const state = person.must_change_password ? "change" : "in";
    const isSame = state === this.state && JSON.stringify(person) === JSON.stringify(this.person);
    this.person = person;
    if (!isSame) this.#become(state, "");
  }

  /** The controller says that nobody is logged in here. */
  lose() {
    if (this.state === "out") return;
    const reason = this.state === "asking" ? "" : ENDED;
    this.person = null;
    this.#become("out", reason);
  }

  /** Log out; throws, and nothing changes, when the controller did not hear it. */
  async leave() {
    try {
      await logOut();
    } catch (error) {
      if (error.status !== 401) throw error;
    }
    this.person = null;
    this.#become("out", LEFT);
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
