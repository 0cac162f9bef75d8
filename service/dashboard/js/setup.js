/** Choosing a session, creating one, uploading a calibration. It never covers the gate or the trace. */

import { createSession, listCalibrations, listDevices, listSessions, uploadCalibration } from "./api.js";

const SHOWN = 12;
const MAX_CALIBRATION_BYTES = 1_000_000;
const WHOLE_NUMBERS = new Set(["fraction_number", "window.row", "window.column"]);
const NUMBERS = new Set([...WHOLE_NUMBERS, "window.lower_mm", "window.upper_mm", "window.hysteresis_mm", "window.dwell_ms"]);

export class Setup {
  /**
   * @param {() => string} operatorName who is at the page
   * @param {(session: object) => void} onSelect called with the session a person chose or created
   */
  constructor(operatorName, onSelect) {
    this.operatorName = operatorName;
    this.onSelect = onSelect;
    this.panel = document.getElementById("setup");
    this.toggle = document.getElementById("do-setup");
    this.form = document.getElementById("new-session");
    this.outcome = document.getElementById("setup-outcome");
    this.toggle.addEventListener("click", () => this.show(this.panel.hidden));
    document.getElementById("setup-close").addEventListener("click", () => this.show(false));
    this.form.addEventListener("change", () => this.#showFields());
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#create();
    });
    document.getElementById("calibration-file").addEventListener("change", (event) => this.#upload(event.target));
    this.#showFields();
  }

  show(isShown) {
    this.panel.hidden = !isShown;
    this.toggle.setAttribute("aria-expanded", String(isShown));
    document.body.dataset.setup = isShown ? "yes" : "no";
    if (isShown) this.refresh();
  }

  /** Ask the controller again for sessions, calibrations and cameras. */
  async refresh() {
    if (this.panel.hidden) return;
    await Promise.all([this.#loadSessions(), this.#loadCalibrations(), this.#loadDevices()]);
  }

  async #loadSessions() {
    const empty = document.getElementById("session-empty");
    try {
      const { items } = await listSessions(SHOWN);
      document.getElementById("session-list").replaceChildren(...items.map((session) => this.#row(session)));
      empty.textContent = items.length > 0 ? "" : "No session yet. Create the first one here.";
    } catch (error) {
      empty.textContent = error.message;
    }
    empty.hidden = empty.textContent === "";
  }

  #row(session) {
    const item = document.createElement("li");
    const choose = document.createElement("button");
    choose.type = "button";
    choose.append(part("strong", session.patient_reference), part("span", `${session.plan_id} · ${session.fraction_id}`), status(session));
    choose.disabled = session.status !== "created";
    choose.addEventListener("click", () => {
      this.onSelect(session);
      this.show(false);
    });
    item.append(choose);
    return item;
  }

  async #loadCalibrations(wanted) {
    const select = this.#input("calibration_id");
    const kept = wanted ?? select.value;
    try {
      const { items } = await listCalibrations();
      const label = (item) => `${item.camera} · ${item.created_at.slice(0, 10)} · ${item.id.slice(0, 8)}`;
      select.replaceChildren(...items.map((item) => new Option(label(item), item.id)));
      if (items.length === 0) select.append(new Option("No calibration yet: upload one below", ""));
      select.append(new Option("None: the live camera's own registration", ""));
      if (items.some((item) => item.id === kept)) select.value = kept;
    } catch (error) {
      select.replaceChildren(new Option(error.message, ""));
    }
  }

  async #loadDevices() {
    try {
      const { items } = await listDevices();
      this.#input("source.uri").replaceChildren(new Option("First found", ""), ...items.map((item) => new Option(item.name, item.uri)));
    } catch {
      // The first camera found can be asked for without a list.
    }
  }

  async #upload(input) {
    const [file] = input.files;
    if (!file) return;
    if (!this.#isNamed()) return this.#reset(input);
    if (file.size > MAX_CALIBRATION_BYTES) {
      this.#say("failed", `${file.name} has ${file.size} bytes; a calibration has a few thousand.`);
      return this.#reset(input);
    }
    try {
      const stored = await uploadCalibration(await file.text(), this.operatorName());
      await this.#loadCalibrations(stored.id);
      const notes = (stored.notes ?? []).map((note) => ` Mind: ${note}.`);
      this.#say("done", `Calibration of ${stored.camera} stored.${notes.join("")}`);
    } catch (error) {
      this.#say("failed", `Calibration refused: ${error.message}`);
    }
    this.#reset(input);
  }

  #reset(input) {
    input.value = "";
  }

  async #create() {
    this.#mark("");
    if (!this.#isNamed()) return;
    const submit = this.form.querySelector("[type=submit]");
    submit.disabled = true;
    try {
      const session = await createSession(this.#request());
      this.#say("", "");
      this.onSelect(session);
      this.show(false);
    } catch (error) {
      this.#say("failed", error.message);
      this.#mark(error.field ?? "");
    } finally {
      submit.disabled = false;
    }
  }

  /** What the visible fields say, as nested JSON: `window.lower_mm` becomes `{window: {lower_mm}}`. */
  #request() {
    const request = { operator: this.operatorName() };
    for (const input of this.form.elements) {
      if (!input.name || input.closest("[hidden]")) continue;
      const value = read(input);
      if (value === null) continue;
      const [group, key] = input.name.split(".");
      if (key === undefined) request[group] = value;
      else (request[group] ??= {})[key] = value;
    }
    return request;
  }

  #isNamed() {
    if (this.operatorName() !== "") return true;
    this.#say("failed", "Enter the operator's name first (on the left).");
    document.getElementById("operator").focus();
    return false;
  }

  #showFields() {
    const chosen = new Set([this.#input("source.kind").value, this.#input("window.signal").value]);
    for (const field of this.form.querySelectorAll("[data-only]")) field.hidden = !chosen.has(field.dataset.only);
  }

  #mark(field) {
    const name = field.replace(/^body\./, "").replace(/^source\.(recording|device)\./, "source.");
    for (const input of this.form.elements) {
      const isWrong = name !== "" && input.name === name;
      input.setAttribute("aria-invalid", String(isWrong));
      if (isWrong) input.focus();
    }
  }

  #input(name) {
    return this.form.elements.namedItem(name);
  }

  #say(kind, text) {
    this.outcome.dataset.kind = kind;
    this.outcome.textContent = text;
  }
}

/** The value to send: null to leave the key out. Numbers that are none go as text, and the controller says what is wrong. */
function read(input) {
  const text = input.value.trim();
  const isOptional = input.name === "fraction_number" || input.name === "source.uri" || input.name === "calibration_id";
  if (text === "" && isOptional) return null;
  if (!NUMBERS.has(input.name)) return text;
  const number = Number(text);
  return text !== "" && Number.isFinite(number) ? number : text;
}

function status(session) {
  const element = part("em", session.status);
  element.dataset.status = session.status;
  return element;
}

function part(name, text) {
  const element = document.createElement(name);
  element.textContent = text;
  return element;
}
