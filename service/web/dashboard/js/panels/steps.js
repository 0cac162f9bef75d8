/**
 * The steps of a set-up: what is done, what comes next and with which button, until the gate is armed for the first time.
 * The list names the buttons and marks the next one; it sends nothing itself.
 */

import { readModel, readSpectrum } from "../api.js";
import { byId, capitalized, part, said } from "../drawing/elements.js";
import { awaitsLevel, describe as describeWindow } from "../stream/gating_window.js";
import { roomMoveOf } from "../stream/gate_state.js";
import { needsReference } from "./training.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

const TITLES = {
  patient: tr("steps.patient_and_plan"), camera: tr("steps.camera"), markers: tr("steps.markers"), training: tr("steps.training"), reference: tr("steps.reference"),
  position: tr("steps.position"), fault: tr("steps.fault"), window: tr("steps.window"), summary: tr("steps.summary"),
};
const MARKS = { done: "✓", now: "▸", attention: "!", later: "·" };
const WORDS = { done: tr("steps.done"), now: tr("steps.now"), attention: tr("steps.look"), later: "" };
/** What a person does about each advice of `camera_view`. */
const ADVICE = {
  too_near: tr("steps.raise_the_camera_nearer_than_60_cm"),
  too_far: tr("steps.lower_the_camera_farther_than_120_cm"),
  tilted: tr("steps.point_the_camera_straight_at_the_patient_til"),
  gaps: tr("steps.more_than_a_tenth_of_the_picture_has_no_dept"),
  too_dark: tr("steps.too_dark_for_the_markers_more_light"),
  too_bright: tr("steps.overexposed_less_light_or_turn_the_lamp_away"),
};

export class Steps {
  constructor(root) {
    this.root = root;
    this.list = root.querySelector("ol");
    this.show = byId("steps-show");
    Object.assign(this, { sessionId: null, wasArmed: false, isHidden: false, windowLookedAt: false, model: null, modelId: null, drawn: "", next: null });
    byId("steps-hide").addEventListener("click", () => { this.isHidden = true; });
    this.show.addEventListener("click", () => { this.isHidden = false; });
    byId("do-window").addEventListener("click", () => { this.windowLookedAt = true; });
  }

  /**
   * @param {{may: boolean, isFresh: boolean, sample: ?object, session: ?object, isWindowEdited: boolean}} context whether the
   * person may run sessions; the fresh sample of a running session; the session that runs or was chosen; whether the
   * trace shows edges that are not applied
   */
  render({ may, isFresh, sample, session: known, isWindowEdited }) {
    // With a late picture the list keeps its place: nothing below it moves under a hand.
    this.root.dataset.stale = isFresh ? "no" : "yes";
    if (may && !isFresh) { this.#point(null); return; }
    const session = isOpen(known) ? known : null;
    const id = sample?.session_id ?? session?.id ?? null;
    if (id !== this.sessionId) Object.assign(this, { sessionId: id, wasArmed: false, isHidden: false, windowLookedAt: false, model: null, modelId: null });
    if (sample?.is_armed) this.wasArmed = true;
    const isOver = !may || this.wasArmed;
    const isShown = !isOver && !this.isHidden;
    this.root.hidden = !isShown;
    this.show.hidden = isOver || !this.isHidden;
    const windowLookedAt = this.windowLookedAt && !isWindowEdited && !awaitsLevel(sample?.window);
    const steps = isOver ? [] : stepsOf({ sample, session, windowLookedAt, model: this.model });
    this.#point(steps.find((one) => one.state === "now")?.button ?? null);
    if (isShown) this.#draw(steps);
    if (sample !== null) this.#readModel(session?.active_model_id ?? null);
  }

  #draw(steps) {
    const key = JSON.stringify(steps);
    if (key === this.drawn) return;
    this.drawn = key;
    this.list.style.setProperty("--steps", String(steps.length));
    this.list.replaceChildren(...steps.map(line));
  }

  /** Mark the button of the next step; never more than one. */
  #point(button) {
    if (button === this.next) return;
    for (const one of [this.next, button]) if (one !== null) byId(one).dataset.next = one === button ? "yes" : "no";
    this.next = button;
  }

  async #readModel(id) {
    if (id === this.modelId) return;
    Object.assign(this, { modelId: id, model: null });
    if (id === null) return;
    try {
      const [model, spectrum] = await Promise.all([readModel(id), readSpectrum(id)]);
      if (this.modelId === id) this.model = { ...model, share: spectrum.share };
    } catch {
      // The step is shown without the quality.
    }
  }
}

const isOpen = (session) => ["created", "running"].includes(session?.status);

/** The steps with their states; at most one is "now". Exported for the page's tests. */
export function stepsOf({ sample, session, windowLookedAt, model }) {
  const isKnown = session !== null;
  const steps = [
    ...(sample?.gate === "fault" ? [step("fault", false, tr("steps.read_its_reason_then_acknowledge"), "do-acknowledge")] : []),
    step("patient", sample !== null || isKnown, isKnown ? `${session.patient_reference} · ${session.plan_id} · ${session.fraction_id}` : tr("steps.press_sessions_choose_the_plan_or_type_patie"), "do-setup"),
    cameraStep(sample, session),
    step("markers", sample !== null && sample.state !== "lost", markersText(sample)),
    step("training", sample?.state === "measuring", trainingText(sample, model)),
    step("reference", sample?.state === "measuring" && (session?.has_reference === true || Boolean(sample.reference)) && !needsReference(sample, session) && roomMoveOf(sample) === null, referenceText(sample, session), "do-reference"),
  ];
  const check = sample?.position_check;
  if (check && ["unsigned", "lapsed", "signed"].includes(check.status)) steps.push(step("position", check.status === "signed", said(check.text), "do-sign"));
  steps.push(step("window", windowLookedAt, sample === null ? tr("steps.set_on_the_patient_s_own_trace") : awaitsLevel(sample.window) ? tr("window_editor.held_first") : tr("steps.gated_on_press_set_window_change_it_or_keep", { window: describeWindow(sample.window) }), "do-window"));
  steps.push(step("summary", false, tr("steps.press_arm_read_each_line_then_arm_now"), "do-arm"));
  const now = steps.find((one) => one.state === "later");
  if (now) now.state = "now";
  return steps;
}

function step(code, isDone, text, button = null) {
  return { code, state: isDone ? "done" : "later", text, button };
}

function cameraStep(sample, session) {
  if (sample === null && session?.status === "running") return step("camera", false, tr("steps.the_camera_is_being_opened"));
  if (sample === null) return step("camera", false, tr("steps.press_start_when_the_patient_lies_still"), "do-start");
  const view = sample.camera_view;
  if (!view) return step("camera", true, "");
  const figures = [
    view.distance_mm === null ? tr("steps.no_depth") : `${Math.round(view.distance_mm / 10)} cm`,
    view.tilt_deg === null ? null : tr("steps.tilt", { value: fixed(view.tilt_deg, 0) }),
    tr("steps.with_depth", { value: Math.floor(100 * view.coverage) }),
    tr("steps.light", { value: Math.round(100 * view.brightness) }),
    view.running_s >= 60 ? tr("steps.on_for_min", { value: Math.floor(view.running_s / 60) }) : null,
  ].filter((one) => one !== null);
  const warming = tr("steps.the_camera_warms_up_for_more_minutes", { value: Math.ceil(view.warm_in_s / 60) });
  const advice = view.advice.map((one) => (one === "warming_up" ? warming : ADVICE[one] ?? one));
  return { code: "camera", state: advice.length === 0 ? "done" : "attention", text: [figures.join(" · "), ...advice.map((one) => one.replace(/\.$/, ""))].join(". "), button: null };
}

function markersText(sample) {
  if (sample === null) return tr("steps.four_dots_on_the_chest_inside_the_picture");
  return sample.state === "lost" ? `${sample.lost?.detail ? capitalized(said(sample.lost.detail)) : capitalized(tr("steps.not_found"))}.` : tr("steps.all_four_are_found_look_at_the_frame_on_the");
}

function trainingText(sample, model) {
  if (sample === null || sample.state === "lost") return tr("steps.some_quiet_breaths_the_first_model_takes_abo");
  if (sample.state === "training") return tr("steps.let_the_patient_breathe_quietly", { value: Math.round(100 * (sample.training?.share ?? 0)) });
  if (!model?.quality) return tr("steps.the_model_is_in_use");
  const { amplitude_mm: amplitude, explained_share: explained, residual_mm: residual } = model.quality;
  const parts = (model.share ?? []).slice(0, 4).map((one) => Math.round(100 * one)).join(", ");
  return tr("steps.mm_of_breathing_explained_residual_mm", { value: fixed(amplitude, 1), value2: Math.round(100 * explained), value3: fixed(residual, 2), value4: parts === "" ? "" : tr("steps.components", { parts }) });
}

function referenceText(sample, session) {
  if (sample?.state !== "measuring") return tr("steps.the_end_of_exhale_of_the_last_breaths_confir");
  const move = roomMoveOf(sample);
  if (move !== null) return tr(`moved.${move.what}.what`, move);
  if (session?.has_reference === true && !needsReference(sample, session)) return sample.reference?.text ? capitalized(said(sample.reference.text)) : tr("steps.is_set");
  return tr("steps.read_the_proposed_level_above_the_buttons_th");
}

function line({ code, state, text }) {
  const item = part("li", "");
  Object.assign(item.dataset, { code, state });
  const mark = part("span", MARKS[state], "mark-of");
  mark.setAttribute("aria-hidden", "true");
  const words = part("p", text);
  const plain = words.textContent;
  words.prepend(part("span", WORDS[state], "unseen"));
  const name = part("div", "");
  name.append(mark, part("strong", TITLES[code]));
  name.title = plain;
  item.append(name, words);
  if (state === "now") item.setAttribute("aria-current", "step");
  return item;
}
