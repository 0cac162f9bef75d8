/**
 * The button that shifts the window by a baseline drift. The window never follows by itself: a person clicks twice and
 * confirms the value shown at the first click.
 */

import { correctBaseline } from "../api.js";
import { setText } from "../drawing/elements.js";
import { signed } from "../drawing/numbers.js";
import { conditionsOf, hasEdges, hasSameSignal } from "../stream/gating_window.js";
import { tr } from "../words/words.js";

/** Smallest drift for which a correction is offered. */
const LEAST = { mm: 0.5, l: 0.05 };
const STEPS = { mm: 10, l: 100 };
const CONFIRM_MS = 6000;

export class BaselineButton {
  /** @param {object} controls provide the operator, make the call and show its result */
  constructor(button, controls) {
    this.button = button;
    this.controls = controls;
    this.offer = null;
    this.confirmed = null;
    button.addEventListener("click", () => this.#press());
  }

  /** @param {?object} sample the newest one of a running session */
  update(sample) {
    this.offer = sample === null ? null : offerOf(sample);
    if (this.confirmed !== null && this.confirmed.id !== sample?.session_id) this.#forget();
    const why = this.#obstacle(sample);
    this.button.disabled = why !== "" || this.controls.busy !== null;
    this.button.title = why === "" ? "" : tr("baseline_correction.not_now", { why });
    this.button.dataset.asks = this.confirmed === null ? "no" : "yes";
    setText(this.button, this.#label());
  }

  #obstacle(sample) {
    if (sample === null) return tr("baseline_correction.no_running_session");
    const why = this.controls.forbids("correct");
    if (why !== "" || this.confirmed !== null) return why;
    if (this.offer === null) return tr("baseline_correction.the_drift_is_not_known_or_the_window_has_no");
    return this.offer.isSmall ? tr("baseline_correction.the_window_is_at_the_baseline") : "";
  }

  #label() {
    if (this.confirmed !== null) return tr("baseline_correction.confirm_shift_the_window_by_disarms", { confirmed: text(this.confirmed) });
    return this.offer === null || this.offer.isSmall ? tr("baseline_correction.correct_baseline") : tr("baseline_correction.correct_baseline_by", { offer: text(this.offer) });
  }

  #press() {
    document.activeElement?.blur();
    if (this.confirmed === null) {
      this.confirmed = this.offer;
      this.asking = setTimeout(() => this.#forget(), CONFIRM_MS);
      return;
    }
    const { id, unit, by, drift } = this.confirmed;
    this.#forget();
    this.controls.run("correct", async () => {
      await correctBaseline(id, this.controls.operatorName, unit, by, drift, this.controls.reason);
      this.controls.forgetReason();
    });
  }

  #forget() {
    clearTimeout(this.asking);
    this.confirmed = null;
  }
}

function text({ by, unit }) {
  return `${signed(by, unit === "l" ? 2 : 1)} ${unit}`;
}

/** The drift is relative to the last correction, so it is the part that remains to be confirmed. */
function offerOf(sample) {
  const { breath } = sample;
  const [gated] = conditionsOf(sample.window);
  const edges = conditionsOf(sample.window).find((one) => hasEdges(one) && hasSameSignal(one, gated));
  if (!Number.isFinite(breath?.drift) || edges === undefined) return null;
  const { unit, drift } = breath;
  const by = Math.round(drift * STEPS[unit]) / STEPS[unit];
  return { id: sample.session_id, unit, by, drift, isSmall: Math.abs(drift) < LEAST[unit] };
}
