/** The form of a session's coaching: display, band, words, sounds, and practice without beam. */

import { readCoaching, setCoaching } from "../api.js";
import { part, pushButton, say, setText, tick } from "../drawing/elements.js";
import { tr } from "../words/words.js";

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
    setText(this.practice, isPractice ? tr("coaching_form.end_practice") : tr("coaching_form.start_practice"));
    setText(this.note, id === null ? tr("coaching_form.no_session_runs") : this.isArmed ? tr("coaching_form.armed_practice_is_without_beam_and_ends_with") : "");
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
      part("legend", tr("coaching_form.this_session_s_screen"), "unseen"),
      choice(tr("coaching_form.display"), "display", [["bar", tr("coaching_form.bar")], ["curve", tr("coaching_form.curve")]]),
      number(tr("coaching_form.band_from"), "band.lower", { min: -100, max: 300, placeholder: tr("coaching_form.window") }),
      number(tr("coaching_form.band_to"), "band.upper", { min: -100, max: 300, placeholder: tr("coaching_form.window") }),
      choice(tr("coaching_form.language"), "language", [["en", "English"], ["de", "Deutsch"]]),
      number(tr("coaching_form.screen_from"), "scale.lower", { min: -100, max: 300, placeholder: tr("coaching_form.automatic") }),
      number(tr("coaching_form.screen_to"), "scale.upper", { min: -100, max: 300, placeholder: tr("coaching_form.automatic") }),
      number(tr("coaching_form.rest_after_a_hold_s"), "rest_s", { min: 0, max: 120, value: 10 }),
      named(tick(tr("coaching_form.soft_tones"), "yes"), "sounds"),
      submit(tr("coaching_form.apply")),
      part("p", tr("coaching_form.0_is_the_end_of_exhale_in_the_training_100_t"), "small"),
    );
    this.practice = pushButton(tr("coaching_form.start_practice"), () => this.#togglePractice());
    this.practice.id = "do-practice";
    this.note = part("p", "", "small");
    this.outcome = part("p", "", "outcome");
    this.outcome.setAttribute("role", "status");
    this.root.append(this.fields, this.practice, this.note, this.outcome);
    this.root.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#send(this.#typed(), tr("coaching_form.the_screen_shows_this_now"));
    });
  }

  #togglePractice() {
    const is_practice = !this.stored.is_practice;
    this.#send({ ...this.stored, is_practice }, is_practice ? tr("coaching_form.practice_the_beam_stays_held") : tr("coaching_form.practice_has_ended"));
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
