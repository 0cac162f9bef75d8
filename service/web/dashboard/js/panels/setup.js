/** The sessions panel: choose or create a session, upload a calibration. It never covers the gate or the trace. */

import { createSession, listCalibrations, listDevices, listPlans, listRecordings, listSessions, listSessionsOf, prepareSession, uploadCalibration } from "../api.js";
import { may, obstacle } from "../people/permissions.js";
import { localTime } from "../drawing/local_time.js";
import { isOver } from "./report.js";
import { SessionForm } from "./session_form.js";
import { tr } from "../words/words.js";

const SHOWN = 12;
const MAX_CALIBRATION_BYTES = 1_000_000;

export class Setup {
  /**
   * @param {import("../people/access.js").Access} access the log-in and its permissions
   * @param {(session: object) => void} onSelect called with the chosen or created session
   * @param {(session: object) => string} onOpen called with a session that is over, to show it; returns why it cannot be
   */
  constructor(access, onSelect, onOpen) {
    Object.assign(this, { access, onSelect, onOpen });
    this.panel = document.getElementById("setup");
    this.toggle = document.getElementById("do-setup");
    this.form = document.getElementById("new-session");
    this.outcome = document.getElementById("setup-outcome");
    this.toggle.addEventListener("click", () => this.show(this.panel.hidden));
    document.getElementById("setup-close").addEventListener("click", () => this.show(false));
    this.fields = new SessionForm(this.form);
    this.form.elements.namedItem("plan").addEventListener("change", () => this.#proposeFraction());
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#create();
    });
    document.getElementById("calibration-file").addEventListener("change", (event) => this.#upload(event.target));
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
    byId("setup-why").textContent = why === "" ? "" : tr("setup.not_available", { why });
    byId("calibration-file").disabled = !may(person, "upload");
    byId("calibration-file").title = obstacle(person, "upload");
  }

  /** Reload sessions, calibrations and cameras. */
  async refresh() {
    if (this.panel.hidden) return;
    await Promise.all([this.#loadSessions(), this.#loadPlans(), this.#loadCalibrations(), this.#loadSources()]);
  }

  async #loadSessions() {
    const empty = document.getElementById("session-empty");
    try {
      const { items } = await listSessions(SHOWN);
      document.getElementById("session-list").replaceChildren(...items.map((session) => this.#row(session)));
      empty.textContent = items.length > 0 ? "" : tr("setup.no_session_yet_create_the_first_one_here");
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
    const isPast = isOver(session);
    choose.className = isPast ? "open" : "";
    choose.disabled = session.status !== "created" && !isPast;
    choose.title = isPast ? tr("setup.show_its_summary") : "";
    choose.append(part("time", localTime(session.started_at ?? session.created_at)));
    choose.addEventListener("click", () => {
      if (isPast) this.#say("failed", this.onOpen(session));
      else {
        this.onSelect(session);
        this.show(false);
      }
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
    again.textContent = tr("setup.new_as_in_this");
    again.title = tr("setup.enter_the_values_of_for_a_new_fraction", { patient_reference: session.patient_reference, fraction_id: session.fraction_id });
    again.addEventListener("click", () => {
      this.fields.fillFrom(session);
      this.#say("", tr("setup.as_in_of_check_each_value_and_enter_the_frac", { fraction_id: session.fraction_id, patient_reference: session.patient_reference }));
    });
    return again;
  }

  #empty() {
    this.fields.reset();
    this.#say("", "");
  }

  async #loadPlans() {
    try {
      this.fields.offerPlans((await listPlans()).items);
    } catch {
      // A session can be typed without the list.
    }
  }

  async #loadCalibrations(wanted) {
    try {
      this.fields.offerCalibrations((await listCalibrations()).items, wanted);
    } catch (error) {
      this.fields.refuseCalibrations(error.message);
    }
  }

  async #loadSources() {
    const none = () => ({ items: [] });
    const [devices, recordings] = await Promise.all([listDevices().catch(none), listRecordings().catch(none)]);
    this.fields.offerSources(devices.items, recordings.items);
  }

  /** Propose the plan's next fraction: one more than the highest that was started. */
  async #proposeFraction() {
    const { plan } = this.fields;
    if (plan === null) return;
    try {
      const { items } = await listSessionsOf(plan.patient_reference, plan.label);
      const numbers = items.filter((one) => one.started_at !== null).map((one) => one.fraction_number ?? 0);
      if (this.fields.plan?.id === plan.id) this.fields.enterFraction(1 + Math.max(0, ...numbers));
    } catch {
      // The number can be typed.
    }
  }

  async #upload(input) {
    const [file] = input.files;
    if (!file) return;
    if (file.size > MAX_CALIBRATION_BYTES) {
      this.#say("failed", tr("setup.has_bytes_a_calibration_has_a_few_thousand", { name: file.name, size: file.size }));
      return this.#reset(input);
    }
    try {
      const stored = await uploadCalibration(await file.text(), this.access.person.name);
      await this.#loadCalibrations(stored.id);
      const notes = (stored.notes ?? []).map((note) => tr("setup.mind", { note }));
      this.#say("done", tr("setup.calibration_of_stored", { camera: stored.camera, value: notes.join("") }));
    } catch (error) {
      this.#say("failed", tr("setup.calibration_refused", { message: error.message }));
    }
    this.#reset(input);
  }

  #reset(input) {
    input.value = "";
  }

  async #create() {
    this.fields.mark("");
    const submit = this.form.querySelector("[type=submit]");
    submit.disabled = true;
    const { plan } = this.fields;
    try {
      const request = this.fields.request(this.access.person.name);
      if (request.source.kind === undefined) throw Object.assign(new Error(tr("setup.choose_a_camera_or_a_recording")), { field: "source" });
      const session = plan === null ? await createSession(request) : await prepareSession(plan.id, request);
      this.#empty();
      this.onSelect(session);
      this.show(false);
    } catch (error) {
      this.#say("failed", error.message);
      this.fields.refuse(error);
    } finally {
      submit.disabled = false;
    }
  }

  #say(kind, text) {
    this.outcome.dataset.kind = kind;
    this.outcome.textContent = text;
  }
}

function byId(id) {
  return document.getElementById(id);
}

function status(session) {
  const element = part("em", tr(`status.${session.status}`));
  element.dataset.status = session.status;
  return element;
}

function part(name, text) {
  const element = document.createElement(name);
  element.textContent = text;
  return element;
}
