/** The start: the work list, and the form of a new session. It never covers the gate, nor the trace of a session. */

import { createSession, listCalibrations, listDevices, listRecordings, prepareSession, uploadCalibration } from "../api.js";
import { byId, say } from "../drawing/elements.js";
import { may, obstacle } from "../people/permissions.js";
import { SessionForm } from "./session_form.js";
import { WorkList } from "./work_list.js";
import { tr } from "../words/words.js";

const MAX_CALIBRATION_BYTES = 1_000_000;

export class Setup {
  /**
   * @param {import("../people/access.js").Access} access the log-in and its permissions
   * @param {(session: object) => void} onSelect called with the chosen or created session
   */
  constructor(access, onSelect) {
    Object.assign(this, { access, onSelect, sources: { devices: [], recordings: [], kinds: [] } });
    this.panel = byId("setup");
    this.toggle = byId("do-setup");
    this.form = byId("new-session");
    this.outcome = byId("setup-outcome");
    this.toggle.addEventListener("click", () => this.show(this.panel.hidden));
    byId("setup-close").addEventListener("click", () => this.show(false));
    this.fields = new SessionForm(this.form);
    this.list = new WorkList({
      onPlan: (plan) => this.#setUp(plan),
      onSession: (session) => this.#take(session),
      onAgain: (session) => this.#again(session),
      onPlans: (plans) => this.fields.offerPlans(plans),
    });
    byId("work-typed").addEventListener("click", () => this.#setUp(null));
    // A complaint is over when its field is changed.
    this.form.addEventListener("input", () => this.outcome.dataset.kind === "failed" && this.#say("", ""));
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#create();
    });
    byId("calibration-file").addEventListener("change", (event) => this.#upload(event.target));
  }

  show(isShown) {
    this.panel.hidden = !isShown;
    this.toggle.setAttribute("aria-expanded", String(isShown));
    document.body.dataset.setup = isShown ? "yes" : "no";
    if (isShown) {
      this.panel.scrollTop = 0;
      this.#offer();
      // The plans are there long before cameras have answered.
      this.refresh(() => this.#focusFirst());
    }
  }

  /** Focus the first plan, where no one has gone anywhere yet. */
  #focusFirst() {
    if (document.activeElement === document.body && !this.panel.hidden) document.querySelector("#plan-list button")?.focus();
  }

  /** Clear all names and patients after a log-out. */
  forget() {
    this.show(false);
    this.#empty();
    this.sources = { devices: [], recordings: [], kinds: [] };
    this.list.forget();
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

  /** Reload sessions, calibrations and cameras. @param {() => void} onPlans called once the plans are shown */
  async refresh(onPlans = () => {}) {
    if (this.panel.hidden) return;
    await Promise.all([this.list.refresh().then(onPlans), this.#loadCalibrations(), this.#loadSources()]);
  }

  /** Fill the form for a plan's next fraction; for null a person types patient and plan. */
  #setUp(plan) {
    this.fields.choose(plan);
    this.#say("", plan === null ? "" : tr("work.check_camera", { patient_reference: plan.patient_reference, label: plan.label }));
  }

  /** Take up a session that was created. */
  #take(session) {
    this.onSelect(session);
    this.show(false);
  }

  #again(session) {
    this.fields.fillFrom(session);
    this.#say("", tr("setup.as_in_of_check_each_value_and_enter_the_frac", { fraction_id: session.fraction_id, patient_reference: session.patient_reference }));
  }

  #empty() {
    this.fields.reset();
    this.#say("", "");
  }

  async #loadCalibrations(wanted) {
    try {
      this.fields.offerCalibrations((await listCalibrations()).items, wanted);
    } catch (error) {
      this.fields.refuseCalibrations(error.message);
    }
  }

  async #loadSources() {
    const none = () => ({ items: [], kinds: [] });
    const offer = (part) => {
      Object.assign(this.sources, part);
      this.fields.offerSources(this.sources.devices, this.sources.recordings, this.sources.kinds);
    };
    // SDKs of cameras take seconds to answer: recordings do not wait for them.
    await Promise.all([
      listRecordings().catch(none).then(({ items }) => offer({ recordings: items })),
      listDevices().catch(none).then(({ items, kinds }) => offer({ devices: items, kinds: kinds ?? [] })),
    ]);
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
    this.fields.mark();
    const submit = this.form.querySelector("[type=submit]");
    submit.disabled = true;
    const { plan } = this.fields;
    try {
      const request = this.fields.request(this.access.person.name);
      if (request.source.kind === undefined) throw Object.assign(new Error(tr("setup.choose_a_camera_or_a_recording")), { field: "source", errors: [] });
      const session = plan === null ? await createSession(request) : await prepareSession(plan.id, request);
      this.#empty();
      this.onSelect(session);
      this.show(false);
    } catch (error) {
      this.#say("failed", this.fields.refuse(error));
    } finally {
      submit.disabled = false;
    }
  }

  #say(kind, text) {
    say(this.outcome, kind, text);
  }
}
