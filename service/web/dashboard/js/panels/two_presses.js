/**
 * A button that acts on the second key press, with the focus kept on it: a key that was meant for another button does
 * nothing. A click of the pointer acts at once.
 */

import { setText } from "../drawing/elements.js";

/** Time in which the second press is accepted [ms], and before which it is not. */
const ASK_MS = 4000;
const CONSIDER_MS = 500;

export class TwoPresses {
  constructor(button, question) {
    Object.assign(this, { button, question, text: button.textContent, askedMs: null });
    button.addEventListener("blur", () => this.reset());
  }

  /** @param {MouseEvent} event a click; one that a key made has no count */
  isConfirmed(event) {
    if (event.detail > 0) {
      this.reset();
      return true;
    }
    const nowMs = performance.now();
    if (this.askedMs !== null && nowMs - this.askedMs < CONSIDER_MS) return false;
    const isSecond = this.askedMs !== null && nowMs - this.askedMs <= ASK_MS;
    this.reset();
    if (!isSecond) this.#ask(nowMs);
    return isSecond;
  }

  /** Ask no longer: what the first press was about has changed. */
  reset() {
    clearTimeout(this.timer);
    this.askedMs = null;
    this.button.dataset.asks = "no";
    setText(this.button, this.text);
  }

  #ask(nowMs) {
    this.askedMs = nowMs;
    this.button.dataset.asks = "yes";
    setText(this.button, this.question);
    this.timer = setTimeout(() => this.reset(), ASK_MS);
  }
}
