/**
 * The form of a new session: of an imported plan, or typed. A prepared plan needs the fraction, the camera and its
 * calibration; everything else has the site's usual value under "More".
 */

import { byId, setText } from "../drawing/elements.js";
import { Conditions } from "./conditions.js";
import { tr } from "../words/words.js";

const OPTIONAL = new Set(["fraction_number", "head_direction", "calibration_id", "regions.named"]);
/** Fields that a refusal asks for: a person's reason for what the plan does not provide for. */
const REASON_FOR = { plan_gating: "overrides_plan_gating", fraction_done: "repeats_fraction", plan_contradicted: "overrides_contradiction" };
/** The calibration list's last entry: the session is created without a calibration. */
const BUILT_IN = "built-in";
const TECHNIQUE = {
  gating: "gating", breath_hold: tr("session_form.breath_hold"), none: tr("session_form.no_motion_compensation"), not_stated: tr("session_form.no_technique"), unknown: "unknown", mixed: tr("session_form.several_techniques"), other: tr("session_form.a_technique_that_is_not_done_here"),
};

export class SessionForm {
  /** @param {HTMLFormElement} form */
  constructor(form) {
    this.form = form;
    this.more = byId("more-settings");
    this.plans = [];
    this.conditions = new Conditions(byId("conditions"), byId("condition-template"), byId("add-condition"), () => this.#showWindow());
    this.reset();
    form.addEventListener("change", () => this.#showFields());
    form.addEventListener("input", ({ target }) => target.setAttribute("aria-invalid", "false"));
    this.#input("plan").addEventListener("change", () => this.#choosePlan());
  }

  /** The imported plan that was chosen; null for a typed one. */
  get plan() {
    return this.plans.find((one) => one.id === this.#input("plan").value) ?? null;
  }

  /** Empty the form: nothing of one patient is offered for the next. */
  reset() {
    this.form.reset();
    this.conditions.reset();
    this.more.open = false;
    this.#askReason("");
    this.#choosePlan();
    this.mark();
  }

  /** Offer the imported plans, the newest first. */
  offerPlans(plans) {
    // One that a search has found may be older than these.
    const { plan } = this;
    this.plans = plan === null || plans.some((one) => one.id === plan.id) ? plans : [plan, ...plans];
    const label = (one) => `${one.patient_reference} · ${one.label} · ${one.created_at.slice(0, 10)}`;
    replaceOptions(this.#input("plan"), [new Option(tr("session_form.none_typed_below"), ""), ...this.plans.map((one) => new Option(label(one), one.id))]);
    this.#showPlan();
  }

  /** Offer the cameras and recordings; a camera that is found is chosen. */
  offerSources(devices, recordings, kinds) {
    const missing = kinds.filter((one) => !one.is_installed).map((one) => tr("session_form.sdk_missing", { label: one.label, hint: one.install_hint }));
    setText(byId("camera-kinds"), missing.join(" · "));
    const cameras = devices.map((one) => new Option(one.name, `device:${one.uri}`));
    const files = recordings.map((one) => {
      const option = new Option(one.problem === null ? `${one.path}${length(one)}${one.mirrored === null ? "" : ` (${tr("session_form.stored_mirrored")})`}` : `${one.path}: ${one.problem}`, `recording:${one.path}`);
      option.disabled = one.problem !== null;
      return option;
    });
    const first = devices.length > 0 ? [] : [new Option(tr("session_form.choose_a_camera_or_recording"), "")];
    replaceOptions(this.#input("source"), [...first, ...grouped(tr("session_form.cameras"), [...cameras, new Option(tr("session_form.first_camera_found"), "device:")]), ...grouped(tr("session_form.recordings"), files)]);
    this.#showFields();
  }

  /** Offer the calibrations, the newest first. */
  offerCalibrations(items, wanted) {
    const label = (item) => `${item.camera} · ${item.created_at.slice(0, 10)} · ${item.id.slice(0, 8)}`;
    const options = items.map((item) => new Option(label(item), item.id));
    if (items.length === 0) options.push(new Option(tr("session_form.no_calibration_yet_upload_one_under_more"), ""));
    replaceOptions(this.#input("calibration_id"), [...options, new Option(tr("session_form.none_the_live_camera_s_built_in_registration"), BUILT_IN)], wanted);
  }

  /** Say in the calibrations' place why there are none. */
  refuseCalibrations(text) {
    this.#input("calibration_id").replaceChildren(new Option(text, ""));
  }

  /** Begin with a plan and its next fraction, or with none; the person goes on with what is not known yet. */
  choose(plan) {
    this.reset();
    if (plan !== null && !this.plans.some((one) => one.id === plan.id)) this.offerPlans([plan, ...this.plans]);
    this.#input("plan").value = plan?.id ?? "";
    this.#choosePlan();
    const next = plan === null ? "patient_reference" : this.#input("source").value === "" ? "source" : "fraction_number";
    this.#input(next).focus();
  }

  /** Enter the values of an earlier session; its fraction is entered by hand. */
  fillFrom(session) {
    this.reset();
    const { window: { further = [], ...first }, source, ...rest } = session;
    this.conditions.reset([first, ...further]);
    const values = { ...rest, window: first, fraction_id: "", fraction_number: null, calibration_id: rest.calibration_id ?? BUILT_IN };
    for (const input of this.form.elements) {
      if (!input.name || input.dataset.name !== undefined || "local" in input.dataset) continue;
      const found = input.name.split(".").reduce((from, key) => from?.[key], values);
      if (typeof found === "string" || typeof found === "number") input.value = found;
    }
    this.#input("regions.named").value = notation(session.regions?.named ?? []);
    this.#chooseSource(source);
    this.#showFields();
    this.conditions.show();
    this.#input("fraction_id").focus();
  }

  /** Return the visible fields as nested JSON: `window.lower_mm` becomes `{window: {lower_mm}}`. */
  request(operator) {
    const request = { operator, source: this.#source() };
    for (const input of this.form.elements) {
      if (!input.name || "local" in input.dataset || input.closest("[hidden]")) continue;
      const value = read(input);
      if (value === null) continue;
      put(request, input.name.split("."), value);
    }
    if (request.source.kind !== "recording") delete request.source.player;
    return request;
  }

  /** Mark the refused fields, ask for the reason that the refusal wants, and return what to say: every field by its name. */
  refuse(error) {
    this.#askReason(REASON_FOR[error.code] ?? this.#reason().name, error.code in REASON_FOR);
    const fields = error.errors.length > 0 ? error.errors : error.field ? [{ field: error.field }] : [];
    this.mark(...fields.map((one) => one.field));
    const named = error.errors.map((one) => ({ input: this.#refused(one.field), bound: one.bound }));
    if (named.length === 0 || named.some(({ input }) => input === undefined)) return error.message;
    return named.map(({ input, bound }) => `${nameOf(input)}: ${wantedOf(input, bound)}.`).join(" ");
  }

  /** Mark the fields of these names as wrong, and only these; the first one takes the focus. */
  mark(...fields) {
    const wrong = fields.map((field) => this.#refused(field)).filter(Boolean);
    for (const input of this.form.elements) input.setAttribute("aria-invalid", String(wrong.includes(input)));
    if (wrong.some((input) => this.more.contains(input))) this.more.open = true;
    wrong[0]?.focus();
  }

  #refused(field) {
    const name = field.replace(/^body\./, "").replace(/^source\..*/, "source");
    return name === "" ? undefined : [...this.form.elements].find((input) => input.name === name && !input.closest("[hidden]"));
  }

  #choosePlan() {
    const { plan } = this;
    this.#input("fraction_number").value = plan?.next_fraction ?? "";
    // Anew for each plan: the technique of one that was looked at before is not the next one's.
    this.conditions.reset([plan?.gating === "breath_hold" ? { kind: "breath_hold" } : null]);
    this.#showPlan();
  }

  #showPlan() {
    const { plan } = this;
    for (const field of this.form.querySelectorAll("[data-typed]")) field.hidden = plan !== null;
    this.#input("fraction_number").placeholder = plan === null ? tr("page.optional") : "";
    this.#input("head_direction").options[0].textContent = plan === null ? tr("session_form.not_known_gate_on_whole_or_volume_only") : tr("session_form.as_the_plan_s_position_says");
    const note = plan === null ? "" : tr("session_form.the_plan_prescribes", { value: TECHNIQUE[plan.gating] });
    byId("plan-note").textContent = note;
    byId("plan-note").hidden = note === "";
    this.#showFields();
  }

  #chooseSource(source) {
    const value = source.kind === "device" ? `device:${source.uri ?? ""}` : `recording:${source.path}`;
    const select = this.#input("source");
    if (![...select.options].some((one) => one.value === value)) select.append(new Option(source.path ?? source.uri, value));
    select.value = value;
    if (source.player) this.#input("source.player").value = source.player;
  }

  #source() {
    const [kind, ...rest] = this.#input("source").value.split(":");
    const place = rest.join(":");
    if (kind === "recording") return { kind, path: place };
    return kind === "device" ? { kind, ...(place === "" ? {} : { uri: place }) } : {};
  }

  #reason() {
    return byId("plan-reason").querySelector("input");
  }

  #askReason(name, isAsked = false) {
    const input = this.#reason();
    if (input.name !== name) input.value = "";
    input.name = name;
    byId("plan-reason").hidden = name === "";
    if (isAsked) input.focus();
  }

  #showWindow() {
    byId("join-field").hidden = this.conditions.count < 2;
    byId("own-regions").hidden = !this.conditions.asksForRegions;
  }

  #showFields() {
    const chosen = this.#input("source").value.split(":")[0];
    for (const field of this.form.querySelectorAll("[data-only]")) field.hidden = field.dataset.only !== chosen;
  }

  #input(name) {
    return this.form.elements.namedItem(name);
  }
}

/** Replace a list's options; what was chosen stays chosen where it is still offered. */
function replaceOptions(select, options, wanted = select.value) {
  select.replaceChildren(...options);
  if ([...select.options].some((one) => one.value === wanted && !one.disabled)) select.value = wanted;
}

function grouped(label, options) {
  if (options.length === 0) return [];
  const group = document.createElement("optgroup");
  group.label = label;
  group.append(...options);
  return [group];
}

function length({ seconds, has_color: hasColor }) {
  const parts = [seconds === null ? null : `${Math.round(seconds)} s`, hasColor === false ? tr("session_form.no_colour") : null];
  return parts.map((one) => (one === null ? "" : ` · ${one}`)).join("");
}

/** Set the value at a path; numbers in the path are list indices. */
function put(target, [key, ...rest], value) {
  if (rest.length === 0) target[key] = value;
  else put((target[key] ??= /^\d+$/.test(rest[0]) ? [] : {}), rest, value);
}

/** Parse regions in the notation of the command line; invalid ones are sent as text, and the controller refuses them. */
function regions(text) {
  const found = text.split(/\s+/).map((one) => {
    const [name, corners = ""] = one.split("=");
    return { name, vertices: corners.split(";").map((corner) => corner.split(",").map(Number)) };
  });
  return found.every((one) => one.vertices.flat().every(Number.isFinite)) ? found : text;
}

/** Write regions in the notation of the command line. */
function notation(named) {
  return named.map(({ name, vertices }) => `${name}=${vertices.map((one) => one.join(",")).join(";")}`).join(" ");
}

/** Return the value to send; null leaves the key out. Invalid numbers are sent as text, and the controller refuses them. */
function read(input) {
  const text = input.value.trim();
  if (text === "" && (OPTIONAL.has(input.name) || "optional" in input.dataset)) return null;
  if (input.name === "calibration_id" && text === BUILT_IN) return null;
  if (input.name === "regions.named") return regions(text);
  if (input.type !== "number") return text;
  const number = Number(text);
  return text !== "" && Number.isFinite(number) ? number : text;
}

function nameOf(input) {
  return input.closest("label")?.querySelector("span")?.textContent ?? input.name;
}

/** What a field has to be: as the form knows it, else as the controller says. */
function wantedOf(input, bound) {
  if (input.value.trim() === "") return tr("session_form.is_empty");
  const value = Number(input.value);
  const [least, most] = [input.min, input.max].map((one) => (one === "" || one === undefined ? NaN : Number(one)));
  if (value < least || value > most) return tr("session_form.is_between", { least, most });
  return tr("session_form.must_be", { bound });
}
