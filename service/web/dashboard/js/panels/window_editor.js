/**
 * Sets the window of a running session while it is not armed: edges in per cent of the patient's breath, in mm or litres,
 * typed or dragged on the trace, with what they would have done in the last minute.
 */

import { setWindow, withoutNulls } from "../api.js";
import { byId, setText } from "../drawing/elements.js";
import { conditionsOf, gatedUnit } from "../stream/gating_window.js";
import { forecast } from "../stream/window_forecast.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

/** Distance from an edge at which the pointer takes it [px]. */
const REACH_PX = 14;
/** Shortest useful pulse [s]: shorter ones are marked. */
const SHORT_S = 1;
const STEPS = { percent: 1, mm: 0.1, l: 0.01 };
const DIGITS = { percent: 0, mm: 1, l: 2 };
const FORECAST_MS = 250;
/** How long a breath has to be held still for its level to become the band [s]; how still, and half of the band. */
const HELD_S = 2;
const STILL = { mm: 1, l: 0.1 };
/** How long the answer to a breath that was not held stays [ms]. */
const SAID_MS = 6000;
const HALF_BAND = { mm: 1.5, l: 0.15 };

export class WindowEditor {
  /** @param {object} trace whose last minute is judged, and on which the edges are dragged */
  constructor(form, trace, controls) {
    Object.assign(this, { form, trace, controls, session: null, sample: null, unit: "mm", grip: null, drawnMs: -Infinity, saidMs: -Infinity, said: "", isWaiting: true });
    this.opener = byId("do-window");
    this.reason = this.form.elements.reason;
    this.opener.addEventListener("click", () => (this.isOpen ? this.close() : this.#open()));
    byId("window-held").addEventListener("click", () => this.#takeHeld());
    byId("window-cancel").addEventListener("click", () => {
      this.close();
      this.controls.leaveFields("window");
    });
    form.addEventListener("submit", (event) => this.#submit(event));
    form.addEventListener("input", (event) => this.#follow(event));
    const { surface } = trace;
    surface.addEventListener("pointerdown", (event) => this.#take(event));
    surface.addEventListener("pointermove", (event) => this.#drag(event));
    for (const kind of ["pointerup", "pointercancel"]) surface.addEventListener(kind, () => this.#release());
  }

  get isOpen() {
    return !this.form.hidden;
  }

  /** Whether it holds edges or a dwell that are not those of the session: the trace draws them, and no gate applies them. */
  get isChanged() {
    return this.isOpen && this.#entered !== this.enteredAtFirst;
  }

  get #entered() {
    const { unit, lower, upper, dwell_ms: dwell } = this.form.elements;
    return [unit, lower, upper, dwell].map((one) => one.value).join(" ");
  }

  /** @returns {boolean} whether it was open */
  close() {
    const wasOpen = this.isOpen;
    this.form.hidden = true;
    this.opener.setAttribute("aria-expanded", "false");
    this.trace.proposal = null;
    this.#release();
    this.trace.surface.style.cursor = "";
    return wasOpen;
  }

  /** @param {string} why why the log-in or the state does not permit it; empty if they do */
  update(sample, session, why, nowMs) {
    this.isWaiting = false;
    this.sample = sample;
    this.session = session?.id === sample?.session_id ? session : null;
    const obstacle = why || this.#obstacle();
    if (this.isOpen && (obstacle !== "" || this.session.id !== this.openedFor)) this.close();
    this.opener.disabled = obstacle !== "";
    this.opener.title = obstacle === "" ? tr("window_editor.set_the_window_on_the_patient_s_last_minute") : tr("window_editor.not_now", { obstacle });
    if (!this.isOpen) return;
    byId("window-apply").disabled = this.controls.isBusy || this.#edges() === null;
    if (nowMs - this.drawnMs < FORECAST_MS) return;
    this.drawnMs = nowMs;
    this.#show();
  }

  /**
   * The state is not known at present: what is typed stays, and nothing can be applied. It closes if the next state does
   * not allow it.
   *
   * @param {string} why why the log-in does not permit it; empty if it does
   */
  wait(why) {
    if (why !== "") this.close();
    this.isWaiting = true;
    this.opener.disabled = true;
    this.opener.title = tr("window.state_not_known");
    byId("window-apply").disabled = true;
    this.#release();
  }

  #obstacle() {
    if (this.sample === null) return tr("window_editor.no_running_session");
    if (this.sample.is_armed) return tr("window_editor.disarm_first");
    if (this.session === null || !this.session.window) return tr("window_editor.the_session_is_being_read");
    return this.#place === -1 ? tr("window_editor.no_condition_has_edges_create_another_sessio") : "";
  }

  /** Place of the first condition with edges; the others stay as they are. */
  get #place() {
    return conditionsOf(this.sample?.window).findIndex((one) => one.kind !== "phase");
  }

  get #length() {
    return conditionsOf(this.sample.window)[this.#place]?.signal === "volume" ? "l" : "mm";
  }

  #open() {
    if (this.isWaiting || this.#obstacle() !== "") return;
    this.openedFor = this.session.id;
    this.form.hidden = false;
    this.opener.setAttribute("aria-expanded", "true");
    const shown = conditionsOf(this.sample.window)[this.#place];
    const isInPercent = shown.unit === "percent";
    this.isLevelSet = Number.isFinite(shown.lower);
    this.form.elements.unit.options[1].textContent = this.#length;
    this.form.elements.unit.options[1].value = this.#length;
    this.unit = isInPercent || (this.isLevelSet && this.#range() !== null) ? "percent" : this.#length;
    this.form.elements.unit.value = this.unit;
    Object.assign(this.reason, { value: "", hidden: true });
    this.form.elements.dwell_ms.value = this.session.window.dwell_ms ?? 0;
    const toUnit = (value) => (value === null || isInPercent || this.unit !== "percent" ? value : this.#inPercent(value));
    this.#enter(toUnit(shown.lower), toUnit(shown.upper));
    byId("window-held").hidden = shown.kind !== "breath_hold";
    this.enteredAtFirst = this.#entered;
    setText(byId("window-others"), conditionsOf(this.sample.window).length > 1 ? tr("window_editor.other_conditions_stay_as_they_are") : "");
    this.#show();
    this.form.elements.lower.focus();
  }

  /** Open with edges in per cent of the breath, for a person to apply. @returns {boolean} whether it is open */
  offer(lower, upper) {
    if (!this.isOpen) this.#open();
    if (!this.isOpen) return false;
    this.unit = this.form.elements.unit.value = "percent";
    this.#enter(lower, upper);
    this.#show();
    return true;
  }

  /** End of exhale and end of inhale against the reference, from the proposed references; null until both are known. */
  #range() {
    const [low, high] = ["end_exhale", "end_inhale"].map((at) => this.session?.reference_proposals?.find((one) => one.at === at));
    if (this.#place !== 0 || !Number.isFinite(low?.percent) || !Number.isFinite(high?.percent) || high.percent - low.percent < 1) return null;
    const perPercent = (high.level - low.level) / (high.percent - low.percent);
    return perPercent > 0 ? { zero: low.level - low.percent * perPercent, perPercent } : null;
  }

  #inPercent(value) {
    const range = this.#range();
    return range === null ? value : (value - range.zero) / range.perPercent;
  }

  #inLength(value) {
    const range = this.#range();
    if (this.unit !== "percent") return value;
    return range === null ? null : range.zero + value * range.perPercent;
  }

  #enter(lower, upper) {
    const { elements } = this.form;
    for (const [name, value] of [["lower", lower], ["upper", upper]]) {
      elements[name].step = STEPS[this.unit];
      elements[name].value = value?.toFixed(DIGITS[this.unit]) ?? "";
    }
  }

  /** The band around a breath that the patient holds now: its level in the last seconds, if it stayed there. */
  #takeHeld() {
    const values = heldValues(this.trace.samples);
    const length = this.#length;
    const moved = Math.max(...values) - Math.min(...values);
    if (this.#place !== 0 || values.length === 0 || moved > STILL[length]) {
      const shown = Number.isFinite(moved) ? `${fixed(moved, DIGITS[length])} ${length}` : "–";
      Object.assign(this, { said: tr("window_editor.hold_the_breath_still", { seconds: HELD_S, moved: shown }), saidMs: performance.now() });
      this.#show();
      return;
    }
    const level = values.sort((one, other) => one - other)[Math.floor(values.length / 2)];
    this.saidMs = -Infinity;
    this.unit = this.form.elements.unit.value = length;
    this.#enter(level - HALF_BAND[length], level + HALF_BAND[length]);
    this.#show();
  }

  #follow(event) {
    if (event.target.name === "unit") {
      const edges = this.#edges();
      const from = this.unit;
      const lengths = edges === null ? null : [this.#inLength(edges.lower), this.#inLength(edges.upper)];
      this.unit = event.target.value;
      if (lengths !== null && lengths[0] !== null && from !== this.unit) this.#enter(...(this.unit === "percent" ? lengths.map((one) => this.#inPercent(one)) : lengths));
    }
    this.#show();
  }

  /** The edges as typed, in the chosen unit; null while they are no window. */
  #edges() {
    const [lower, upper] = ["lower", "upper"].map((name) => this.form.elements[name].valueAsNumber);
    return Number.isFinite(lower) && Number.isFinite(upper) && lower < upper ? { lower, upper } : null;
  }

  /** The edges in mm or litres; null while they are not known. */
  #proposal() {
    const edges = this.#edges();
    if (edges === null) return null;
    const [lower, upper] = [this.#inLength(edges.lower), this.#inLength(edges.upper)];
    if (lower === null) return null;
    const present = conditionsOf(this.sample.window)[this.#place];
    return { ...present, unit: this.#length, lower, upper, hysteresis: this.#hysteresis(present) };
  }

  /** The session's hysteresis where its unit stays, else the controller's default for the new unit. */
  #hysteresis(present) {
    const given = this.#target(this.session.window)[`hysteresis_${this.unit}`];
    const value = given ?? { percent: 2, mm: 0.2, l: 0.01 }[this.unit];
    if (this.unit !== "percent") return value;
    return (this.#range()?.perPercent ?? 0) * value || present.hysteresis;
  }

  #target(window) {
    return this.#place === 0 ? window : window.further[this.#place - 1];
  }

  #show() {
    const proposal = this.#proposal();
    this.trace.proposal = proposal;
    const text = byId("window-forecast");
    const found = proposal === null ? null : this.#forecast(proposal);
    text.dataset.short = found?.shortestS !== null && found?.shortestS < SHORT_S ? "yes" : "no";
    if (performance.now() - this.saidMs < SAID_MS) setText(text, this.said);
    else if (!this.isLevelSet && this.form.elements.lower.value === "") setText(text, tr("window_editor.held_first"));
    else setText(text, this.#edges() === null ? tr("window_editor.the_lower_edge_must_be_below_the_upper_one") : forecastText(found, this.#whyNoForecast(proposal)));
  }

  #whyNoForecast(proposal) {
    if (proposal === null) return tr("window_editor.the_learned_breath_is_not_known_no_predictio");
    if (conditionsOf(this.sample.window).length > 1 || proposal.kind !== "amplitude") return tr("window_editor.no_prediction_for_this_kind_of_window");
    return tr("window_editor.no_prediction_until_10_s_were_measured");
  }

  #forecast(proposal) {
    if (conditionsOf(this.sample.window).length > 1 || proposal.kind !== "amplitude") return null;
    const samples = this.trace.samples.map(({ t, gated }) => ({ t, value: gated }));
    return forecast(samples, proposal, this.form.elements.dwell_ms.valueAsNumber / 1000);
  }

  #take(event) {
    const proposal = this.isOpen ? this.trace.proposal : null;
    if (proposal === null || this.trace.choice !== "gated" || gatedUnit(this.sample.window) !== proposal.unit) return;
    const distances = ["lower", "upper"].map((name) => [Math.abs(this.trace.yOf(proposal[name]) - event.offsetY), name]);
    const [distance, name] = distances.sort(([one], [other]) => one - other)[0];
    if (distance > REACH_PX) return;
    this.grip = name;
    this.trace.keepsRange = true;
    this.trace.surface.setPointerCapture(event.pointerId);
    event.preventDefault();
  }

  #release() {
    this.grip = null;
    this.trace.keepsRange = false;
  }

  #drag(event) {
    if (!this.isOpen) return;
    this.trace.surface.style.cursor = "ns-resize";
    if (this.grip === null) return;
    const value = this.trace.valueAt(event.offsetY);
    const edges = { ...this.#edges(), [this.grip]: this.unit === "percent" ? this.#inPercent(value) : value };
    if (edges.lower < edges.upper) this.#enter(edges.lower, edges.upper);
    this.#show();
  }

  #submit(event) {
    event.preventDefault();
    const edges = this.#edges();
    if (edges === null || this.session === null || this.isWaiting) return;
    const { id } = this.session;
    const window = withoutNulls(this.session.window);
    const target = this.#target(window);
    for (const unit of Object.keys(STEPS)) {
      for (const edge of ["lower", "upper"]) delete target[`${edge}_${unit}`];
      if (unit !== this.unit) delete target[`hysteresis_${unit}`];
    }
    Object.assign(target, { [`lower_${this.unit}`]: edges.lower, [`upper_${this.unit}`]: edges.upper });
    window.dwell_ms = this.form.elements.dwell_ms.valueAsNumber;
    this.controls.run("window", async () => {
      try {
        await setWindow(id, this.controls.operatorName, window, this.reason.value.trim());
      } catch (error) {
        if (["reference_distance", "reason_missing"].includes(error.code)) this.reason.hidden = false;
        throw error;
      }
      this.close();
      this.controls.leaveFields("window");
    });
  }
}

/** The gated signal in the last `HELD_S`; empty where it was not measured all that time. */
function heldValues(samples) {
  const last = samples.at(-1);
  const recent = last === undefined ? [] : samples.filter(({ t }) => last.t - t <= HELD_S);
  const isWhole = recent.length > 1 && last.t - recent[0].t > HELD_S / 2 && recent.every(({ gated }) => Number.isFinite(gated));
  return isWhole ? recent.map(({ gated }) => gated) : [];
}

function forecastText(found, why) {
  if (found === null) return why;
  const shortest = found.shortestS === null ? tr("window_editor.no_complete_pulse") : tr("window_editor.shortest_s", { value: fixed(found.shortestS, 1) });
  return tr("window_editor.predicted_from_the_last_s_beam_on_pulses_min", { value: Math.round(found.seconds), value2: Math.round(found.percent), value3: fixed(found.pulsesPerMin, 0), shortest });
}
