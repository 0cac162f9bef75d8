/**
 * What became of the last session: its figures after the end, and after a crash whose it was, what was delivered, and the
 * offer to continue it with its model. It lies over the lower panels, below all others; gate and trace stay in view.
 */

import { prepareSession, createSession, listModels, readSession, withoutNulls } from "../api.js";
import { byId, part, said, setText } from "../drawing/elements.js";
import { localTime } from "../drawing/local_time.js";
import { may, obstacle } from "../people/permissions.js";
import { duration, dutyText, onText } from "./treatment.js";
import { whatIs } from "../words/reasons.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

/** Statuses of a session that did not end as a person or a recording would have it. */
const BROKEN = new Set(["interrupted", "failed"]);
const OVER = new Set(["ended", "stopped", ...BROKEN]);
const NONE = "–";
const COPIED = ["patient_reference", "plan_id", "fraction_id", "fraction_number", "source", "calibration_id", "window", "regions", "head_direction"];
const OF_PLAN = ["fraction_number", "source", "calibration_id", "window", "regions", "head_direction"];

/** Whether a session was started and is over. */
export function isOver(session) {
  return OVER.has(session.status) && Boolean(session.started_at);
}

export class Summary {
  /**
   * @param {import("../people/access.js").Access} access the log-in and its permissions
   * @param {(session: object) => void} onCreated called with the session that continues the one shown
   * @param {(session: object, isBroken: boolean) => void} onShown called when a session is shown: what lies over it gives way
   */
  constructor(access, onCreated, onShown) {
    Object.assign(this, { access, onCreated, onShown, root: byId("report"), button: byId("report-continue"), dismissed: null });
    this.forget();
    byId("report-close").addEventListener("click", () => this.close());
    this.button.addEventListener("click", () => this.#continue());
  }

  get isOpen() {
    return !this.root.hidden;
  }

  /** Show a session that is over, unless it is shown already or was closed by a person. */
  async open({ id }) {
    if (id === this.id || id === this.dismissed) return;
    this.forget();
    this.id = id;
    try {
      const [session, models] = await Promise.all([readSession(id), listModels(id, 1)]);
      if (id !== this.id) return;
      if (isOver(session)) this.#show(session, models.items[0] ?? null);
    } catch {
      // It is asked for again with the next look.
      if (id === this.id) this.forget();
    }
  }

  /** Close it for good: the same session is not shown again. @returns {boolean} whether it was open */
  close() {
    const wasOpen = this.isOpen;
    if (wasOpen) this.dismissed = this.id;
    this.forget();
    if (wasOpen) this.id = this.dismissed;
    return wasOpen;
  }

  /** Remove everything of the session, after a log-out or as another one is chosen. */
  forget() {
    Object.assign(this, { id: null, session: null, model: null, isBusy: false });
    this.root.hidden = true;
    for (const name of ["report-heading", "report-when", "report-note", "report-outcome"]) setText(byId(name), "");
    byId("report-figures").replaceChildren();
    byId("report-holds").replaceChildren();
    this.button.hidden = true;
  }

  #show(session, model) {
    Object.assign(this, { session, model });
    const isBroken = BROKEN.has(session.status);
    this.root.dataset.kind = isBroken ? "broken" : "over";
    setText(byId("report-heading"), `${isBroken ? tr("report.interrupted") : tr("report.summary")}: ${session.patient_reference}`);
    setText(byId("report-when"), whenText(session));
    byId("report-figures").replaceChildren(...figures(session).map(figure));
    byId("report-holds").replaceChildren(...holdLines(session.summary.holds ?? []));
    byId("report-review").href = `office/#session/${session.id}`;
    this.button.hidden = !isBroken;
    if (isBroken) this.#offer();
    this.root.hidden = false;
    this.onShown(session, isBroken);
  }

  /** The offer to continue: nothing is armed by it, and the reference is confirmed again. */
  #offer() {
    const why = obstacle(this.access.person, "create");
    this.button.disabled = this.isBusy || !may(this.access.person, "create");
    setText(this.button, this.model === null ? tr("report.continue_training_again") : tr("report.continue_with_its_model"));
    this.button.title = why;
    const lost = this.session.status === "interrupted" ? tr("report.up_to_the_last_second_before_the_interruptio") : "";
    const next = tr("report.makes_a_new_session_of_this_fraction_that_ke");
    setText(byId("report-note"), `${next}${lost}`);
  }

  async #continue() {
    if (this.isBusy || this.session === null) return;
    const { session, model } = this;
    this.isBusy = true;
    this.#offer();
    setText(byId("report-outcome"), "");
    try {
      const created = await (session.rt_plan_id ? prepareSession(session.rt_plan_id, ofPlan(session, model)) : createSession(request(session, model)));
      if (session === this.session) this.onCreated(created);
    } catch (error) {
      if (session === this.session) setText(byId("report-outcome"), error.message);
    } finally {
      if (session === this.session) {
        this.isBusy = false;
        this.#offer();
      }
    }
  }
}

function request(session, model) {
  return taken(session, COPIED, model);
}

function ofPlan(session, model) {
  return { ...taken(session, OF_PLAN, model), repeats_fraction: tr("report.continues_session", { id: session.id }) };
}

function taken(session, names, model) {
  const copied = Object.fromEntries(names.map((name) => [name, session[name] ?? null]));
  return withoutNulls({ ...copied, model_id: model?.id ?? null, continues: session.id });
}

function whenText(session) {
  const fraction = tr("report.fraction", { plan_id: session.plan_id, fraction_id: session.fraction_id, value: session.fraction_number === null ? "" : tr("report.no", { number: session.fraction_number }) });
  return tr("report.started", { fraction, started_at: localTime(session.started_at), status: tr(`status.${session.status}`), ended_at: localTime(session.ended_at), status_detail: said(session.status_detail) });
}


function figures(session) {
  const { summary } = session;
  const { p50_ms: p50, p99_ms: p99, max_ms: max } = summary.latency;
  const ms = (value) => (Number.isFinite(value) ? fixed(value, 0) : NONE);
  return [
    [tr("report.beam_on", { value: session.is_simulated_beam ? tr("report.simulated") : "" }), onText(summary, session)],
    [tr("report.duty_cycle_while_armed"), dutyText(summary)],
    [tr("report.elapsed"), duration(summary.elapsed_s)],
    [tr("report.frames"), String(summary.frames)],
    [tr("report.not_measured_never_received"), `${summary.lost} · ${summary.missed_frames}`],
    [tr("report.latency_ms_p50_p99_max"), `${ms(p50)} · ${ms(p99)} · ${ms(max)}`],
  ];
}

function figure([name, value]) {
  const line = part("div", "");
  line.append(part("dt", name), part("dd", value));
  return line;
}

function holdLines(holds) {
  if (holds.length === 0) return [part("li", tr("report.no_holds"))];
  return holds.map(({ reason, text, count }) => {
    const line = part("li", "");
    line.dataset.reason = reason;
    line.append(part("strong", String(count)), ` ${whatIs(reason, text)}`);
    return line;
  });
}
