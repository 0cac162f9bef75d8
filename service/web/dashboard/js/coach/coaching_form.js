/** The form of a session's coaching: display, band, words, sounds, and practice without beam. */

import { readCoaching, setCoaching } from "../api.js";
import { part, pushButton, say, setText, tick } from "../drawing/elements.js";

/** Period of reading the settings, which arming changes [ms]. */
const READ_MS = 2000;

export class CoachingForm {
  /** @param {import("../people/access.js").Access} access the log-in */
  constructor(access) {
    this.access = access;
    this.sessionId = null;
    this.stored = null;
    this.nextReadMs = 0;
    this.#build();
  }

  /** @param {?object} sample newest sample of the running session */
  tend(sample, nowMs) {
    const id = sample?.session_id ?? null;
    if (id !== this.sessionId) this.#begin(id);
    this.isArmed = sample?.is_armed === true;
    if (id !== null && nowMs >= this.nextReadMs) {
      this.nextReadMs = nowMs + READ_MS;
      this.#read(id);
    }
    const isReady = id !== null && this.stored !== null;
    this.fields.disabled = !isReady;
    const isPractice = this.stored?.is_practice === true;
    this.practice.disabled = !isReady || (this.isArmed && !isPractice);
    setText(this.practice, isPractice ? "End practice" : "Start practice");
    setText(this.note, id === null ? "No session runs." : this.isArmed ? "Armed: practice is without beam, and ends with arming." : "");
  }

  #begin(id) {
    this.sessionId = id;
    this.stored = null;
    this.nextReadMs = 0;
    this.root.reset();
    say(this.outcome, "", "");
  }

  async #read(id) {
    try {
      const settings = await readCoaching(id);
      if (id !== this.sessionId) return;
      const isFirst = this.stored === null;
      this.stored = settings;
      if (isFirst) this.#fill(settings);
    } catch {
      if (id === this.sessionId) this.stored = null;
    }
  }

  #fill(settings) {
    const { elements } = this.root;
    for (const name of ["display", "language"]) elements.namedItem(name).value = settings[name];
    elements.namedItem("sounds").checked = settings.sounds;
    elements.namedItem("rest_s").value = settings.rest_s;
    for (const name of ["band", "scale"]) {
      elements.namedItem(`${name}.lower`).value = settings[name]?.lower_percent ?? "";
      elements.namedItem(`${name}.upper`).value = settings[name]?.upper_percent ?? "";
    }
  }

  /** @returns {object} the settings as typed */
  #typed() {
    const { elements } = this.root;
    const value = (name) => elements.namedItem(name).value;
    return {
      display: value("display"),
      language: value("language"),
      sounds: elements.namedItem("sounds").checked,
      rest_s: Number(value("rest_s")),
      band: range(value("band.lower"), value("band.upper")),
      scale: range(value("scale.lower"), value("scale.upper")),
      is_practice: this.stored?.is_practice ?? false,
    };
  }

  async #send(settings, done) {
    const id = this.sessionId;
    try {
      const stored = await setCoaching(id, this.access.person?.name ?? "", settings);
      if (id !== this.sessionId) return;
      this.stored = stored;
      say(this.outcome, "done", done);
    } catch (error) {
      say(this.outcome, "failed", error.message);
    }
  }

  #build() {
    this.root = part("form", "", "coaching");
    this.root.noValidate = true;
    this.root.autocomplete = "off";
    this.fields = document.createElement("fieldset");
    this.fields.append(
      part("legend", "This session's screen", "unseen"),
      choice("Display", "display", [["bar", "Bar"], ["curve", "Curve"]]),
      number("Band from, %", "band.lower", { min: -100, max: 300, placeholder: "window" }),
      number("Band to, %", "band.upper", { min: -100, max: 300, placeholder: "window" }),
      choice("Language", "language", [["en", "English"], ["de", "Deutsch"]]),
      number("Screen from, %", "scale.lower", { min: -100, max: 300, placeholder: "automatic" }),
      number("Screen to, %", "scale.upper", { min: -100, max: 300, placeholder: "automatic" }),
      number("Rest after a hold, s", "rest_s", { min: 0, max: 120, value: 10 }),
      named(tick("Soft tones", "yes"), "sounds"),
      submit("Apply"),
      part("p", "0 % is the end of exhale in the training, 100 % the end of inhale.", "small"),
    );
    this.practice = pushButton("Start practice", () => this.#togglePractice());
    this.practice.id = "do-practice";
    this.note = part("p", "", "small");
    this.outcome = part("p", "", "outcome");
    this.outcome.setAttribute("role", "status");
    this.root.append(this.fields, this.practice, this.note, this.outcome);
    this.root.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#send(this.#typed(), "The screen shows this now.");
    });
  }

  #togglePractice() {
    const is_practice = !this.stored.is_practice;
    this.#send({ ...this.stored, is_practice }, is_practice ? "Practice: the beam stays held." : "Practice has ended.");
  }
}

/** @returns {?object} null where both fields are empty; a field alone is sent, and refused with its name */
function range(lower, upper) {
  if (lower === "" && upper === "") return null;
  return { lower_percent: lower === "" ? null : Number(lower), upper_percent: upper === "" ? null : Number(upper) };
}

function field(text, control, name) {
  const label = part("label", "", "field");
  control.name = name;
  label.append(part("span", text), control);
  return label;
}

function choice(text, name, options) {
  const select = document.createElement("select");
  for (const [value, shown] of options) select.append(new Option(shown, value));
  return field(text, select, name);
}

function number(text, name, attributes) {
  const input = document.createElement("input");
  input.type = "number";
  for (const [key, value] of Object.entries(attributes)) input.setAttribute(key, String(value));
  return field(text, input, name);
}

function named(label, name) {
  label.querySelector("input").name = name;
  return label;
}

function submit(text) {
  const button = part("button", text, "go");
  button.type = "submit";
  return button;
}
