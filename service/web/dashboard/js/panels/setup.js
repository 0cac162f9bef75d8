/** The sessions panel: choose or create a session, upload a calibration. It never covers the gate or the trace. */

import { createSession, listCalibrations, listDevices, listSessions, uploadCalibration } from "../api.js";
import { Conditions } from "./conditions.js";
import { may, obstacle } from "../people/permissions.js";

const SHOWN = 12;
const MAX_CALIBRATION_BYTES = 1_000_000;
const OPTIONAL = new Set(["fraction_number", "head_direction", "source.uri", "calibration_id", "regions.named"]);

export class Setup {
  /**
   * @param {import("../people/access.js").Access} access the log-in and its permissions
   * @param {(session: object) => void} onSelect called with the chosen or created session
   */
  constructor(access, onSelect) {
    this.access = access;
    this.onSelect = onSelect;
    this.panel = document.getElementById("setup");
    this.toggle = document.getElementById("do-setup");
    this.form = document.getElementById("new-session");
    this.outcome = document.getElementById("setup-outcome");
    this.toggle.addEventListener("click", () => this.show(this.panel.hidden));
    document.getElementById("setup-close").addEventListener("click", () => this.show(false));
    this.conditions = new Conditions(byId("conditions"), byId("condition-template"), byId("add-condition"), () => this.#showWindow());
    this.#empty();
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
    if (isShown) {
      this.panel.scrollTop = 0;
      this.#offer();
      this.refresh();
    }
  }

  /** Clear all names and patients after a log-out. */
  forget() {
    this.show(false);
    this.#empty();
    document.getElementById("session-list").replaceChildren();
    this.#say("", "");
  }

  /** Disable what the log-in does not permit. */
  #offer() {
    const { person } = this.access;
    const why = obstacle(person, "create");
    this.form.querySelector("[type=submit]").disabled = why !== "";
    byId("setup-why").hidden = why === "";
    byId("setup-why").textContent = why === "" ? "" : `Not available: ${why}.`;
    byId("calibration-file").disabled = !may(person, "upload");
    byId("calibration-file").title = obstacle(person, "upload");
  }

  /** Reload sessions, calibrations and cameras. */
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
    if (session.status !== "created") item.append(this.#again(session));
    return item;
  }

  /** Offer a new session with an earlier one's values; its fraction is entered by hand. */
  #again(session) {
    const again = document.createElement("button");
    again.type = "button";
    again.className = "again";
    again.textContent = "New, as in this";
    again.title = `Enter the values of ${session.patient_reference}, ${session.fraction_id} for a new fraction`;
    again.addEventListener("click", () => this.#fillFrom(session));
    return again;
  }

  #fillFrom(session) {
    this.#empty();
    const { window: { further = [], ...first }, ...rest } = session;
    this.conditions.reset([first, ...further]);
    const values = { ...rest, window: first, fraction_id: "", fraction_number: null };
    for (const input of this.form.elements) {
      if (!input.name || input.dataset.name !== undefined) continue;
      const found = input.name.split(".").reduce((from, key) => from?.[key], values);
      if (typeof found === "string" || typeof found === "number") input.value = found;
    }
    this.#input("regions.named").value = notation(session.regions?.named ?? []);
    this.#showFields();
    this.conditions.show();
    this.#say("", `As in ${session.fraction_id} of ${session.patient_reference}: check each value, and enter the fraction.`);
    this.#input("fraction_id").focus();
  }

  /** Empty the form: nothing of one patient is offered for the next. */
  #empty() {
    this.form.reset();
    this.conditions.reset();
    this.#showFields();
    this.#mark("");
    this.#say("", "");
  }

  async #loadCalibrations(wanted) {
    const select = this.#input("calibration_id");
    const kept = wanted ?? select.value;
    try {
      const { items } = await listCalibrations();
      const label = (item) => `${item.camera} · ${item.created_at.slice(0, 10)} · ${item.id.slice(0, 8)}`;
      select.replaceChildren(...items.map((item) => new Option(label(item), item.id)));
      if (items.length === 0) select.append(new Option("No calibration yet: upload one below", ""));
      select.append(new Option("None: the live camera's built-in registration", ""));
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
      // The first camera can be requested without a list.
    }
  }

  async #upload(input) {
    const [file] = input.files;
    if (!file) return;
    if (file.size > MAX_CALIBRATION_BYTES) {
      this.#say("failed", `${file.name} has ${file.size} bytes; a calibration has a few thousand.`);
      return this.#reset(input);
    }
    try {
      const stored = await uploadCalibration(await file.text(), this.access.person.name);
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
    const submit = this.form.querySelector("[type=submit]");
    submit.disabled = true;
    try {
      const session = await createSession(this.#request());
      this.#empty();
      this.onSelect(session);
      this.show(false);
    } catch (error) {
      this.#say("failed", error.message);
      this.#mark(error.field ?? "");
    } finally {
      submit.disabled = false;
    }
  }

  /** Return the visible fields as nested JSON: `window.lower_mm` becomes `{window: {lower_mm}}`. */
  #request() {
    const request = { operator: this.access.person.name };
    for (const input of this.form.elements) {
      if (!input.name || input.closest("[hidden]")) continue;
      const value = read(input);
      if (value === null) continue;
      put(request, input.name.split("."), value);
    }
    return request;
  }

  #showWindow() {
    byId("join-field").hidden = this.conditions.count < 2;
    byId("own-regions").hidden = !this.conditions.asksForRegions;
  }

  #showFields() {
    const chosen = new Set([this.#input("source.kind").value]);
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
  if (input.name === "regions.named") return regions(text);
  if (input.type !== "number") return text;
  const number = Number(text);
  return text !== "" && Number.isFinite(number) ? number : text;
}

function byId(id) {
  return document.getElementById(id);
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
