/**
 * The steps of a set-up: what is done, what comes next and with which button, until the gate is armed for the first time.
 * The list names the buttons and marks the next one; it sends nothing itself.
 */

import { readModel, readSpectrum } from "../api.js";
import { byId, part } from "../drawing/elements.js";
import { describe as describeWindow } from "../stream/gating_window.js";
import { needsReference } from "./training.js";

const TITLES = {
  patient: "Patient and plan", camera: "Camera", markers: "Markers", training: "Training", reference: "Reference",
  position: "Position", window: "Window", summary: "Summary",
};
const MARKS = { done: "✓", now: "▸", attention: "!", later: "·" };
const WORDS = { done: "Done. ", now: "Now. ", attention: "Look. ", later: "" };
/** What a person does about each advice of `camera_view`. */
const ADVICE = {
  too_near: "Raise the camera: nearer than 60 cm.",
  too_far: "Lower the camera: farther than 120 cm.",
  tilted: "Point the camera straight at the patient: tilted by more than 15°.",
  gaps: "More than a tenth of the picture has no depth: look for shiny, dark or covered surfaces, and for sunlight.",
  too_dark: "Too dark for the markers: more light.",
  too_bright: "Overexposed: less light, or turn the lamp away.",
  warming_up: "The camera warms up for 15 minutes; until then its readings drift.",
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
   * @param {{may: boolean, isFresh: boolean, sample: ?object, session: ?object}} context whether the person may run sessions;
   * the fresh sample of a running session; the session that runs or was chosen
   */
  render({ may, isFresh, sample, session: known }) {
    const session = isOpen(known) ? known : null;
    const id = sample?.session_id ?? session?.id ?? null;
    if (id !== this.sessionId) Object.assign(this, { sessionId: id, wasArmed: false, isHidden: false, windowLookedAt: false, model: null, modelId: null });
    if (sample?.is_armed) this.wasArmed = true;
    const isOver = !may || this.wasArmed;
    const isShown = !isOver && isFresh && !this.isHidden;
    this.root.hidden = !isShown;
    this.show.hidden = isOver || !this.isHidden || !isFresh;
    const steps = isOver || !isFresh ? [] : stepsOf({ sample, session, windowLookedAt: this.windowLookedAt, model: this.model });
    this.#point(steps.find((one) => one.state === "now")?.button ?? null);
    if (isShown) this.#draw(steps);
    if (sample !== null) this.#readModel(session?.active_model_id ?? null);
  }

  #draw(steps) {
    const key = JSON.stringify(steps);
    if (key === this.drawn) return;
    this.drawn = key;
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
    step("patient", sample !== null || isKnown, isKnown ? `${session.patient_reference} · ${session.plan_id} · ${session.fraction_id}` : "Press Sessions: choose the plan, or type patient and plan.", "do-setup"),
    cameraStep(sample, session),
    step("markers", sample !== null && sample.state !== "lost", markersText(sample)),
    step("training", sample?.state === "measuring", trainingText(sample, model)),
    step("reference", sample?.state === "measuring" && session?.has_reference === true && !needsReference(sample, session), referenceText(sample, session), "do-reference"),
  ];
  const check = sample?.position_check;
  if (check && ["unsigned", "lapsed", "signed"].includes(check.status)) steps.push(step("position", check.status === "signed", check.text, "do-sign"));
  steps.push(step("window", windowLookedAt, sample === null ? "Set on the patient's own trace." : `Gated on ${describeWindow(sample.window)}. Press Set window: change it or keep it.`, "do-window"));
  steps.push(step("summary", false, "Press Arm…, read each line, then Arm now.", "do-arm"));
  const now = steps.find((one) => one.state === "later");
  if (now) now.state = "now";
  return steps;
}

function step(code, isDone, text, button = null) {
  return { code, state: isDone ? "done" : "later", text, button };
}

function cameraStep(sample, session) {
  if (sample === null && session?.status === "running") return step("camera", false, "The camera is being opened.");
  if (sample === null) return step("camera", false, "Press Start when the patient lies still.", "do-start");
  const view = sample.camera_view;
  if (!view) return step("camera", true, "");
  const figures = [
    view.distance_mm === null ? "no depth" : `${Math.round(view.distance_mm / 10)} cm`,
    view.tilt_deg === null ? null : `tilt ${view.tilt_deg.toFixed(0)}°`,
    `${Math.round(100 * view.coverage)} % with depth`,
    `light ${Math.round(100 * view.brightness)} %`,
    view.running_s >= 60 ? `on for ${Math.floor(view.running_s / 60)} min` : null,
  ].filter((one) => one !== null);
  const advice = view.advice.map((one) => ADVICE[one] ?? one);
  return { code: "camera", state: advice.length === 0 ? "done" : "attention", text: [figures.join(" · "), ...advice].join(". "), button: null };
}

function markersText(sample) {
  if (sample === null) return "Four dots on the chest, inside the picture.";
  return sample.state === "lost" ? `${capitalized(sample.lost?.detail ?? "not found")}.` : "All four are found: look at the frame on the picture.";
}

function trainingText(sample, model) {
  if (sample === null || sample.state === "lost") return "Some quiet breaths; the first model takes about ten seconds.";
  if (sample.state === "training") return `${Math.round(100 * (sample.training?.share ?? 0))} %: let the patient breathe quietly.`;
  if (!model?.quality) return "The model is in use.";
  const { amplitude_mm: amplitude, explained_share: explained, residual_mm: residual } = model.quality;
  const parts = (model.share ?? []).slice(0, 4).map((one) => Math.round(100 * one)).join(", ");
  return `${amplitude.toFixed(1)} mm of breathing, ${Math.round(100 * explained)} % explained, residual ${residual.toFixed(2)} mm${parts === "" ? "" : `; components ${parts} %`}.`;
}

function referenceText(sample, session) {
  if (sample?.state !== "measuring") return "The end of exhale of the last breaths, confirmed by you.";
  if (session?.has_reference === true && !needsReference(sample, session)) return capitalized(sample.reference?.text ?? "set");
  return "Read the proposed level above the buttons, then press Set reference.";
}

function capitalized(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

function line({ code, state, text }) {
  const item = part("li", "");
  Object.assign(item.dataset, { code, state });
  const mark = part("span", MARKS[state], "mark-of");
  mark.setAttribute("aria-hidden", "true");
  const words = part("p", "");
  words.append(part("span", WORDS[state], "unseen"), text);
  item.append(mark, part("strong", TITLES[code]), words);
  if (state === "now") item.setAttribute("aria-current", "step");
  return item;
}
