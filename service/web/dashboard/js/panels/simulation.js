/**
 * The simulation day of the session's plan: a person signs it before the start; then its breath stands beside today's,
 * and its window can be taken into the editor. Nothing of it is applied by itself.
 */

import { findSessions, readSimulation, signSimulation } from "../api.js";
import { byId, say, setText } from "../drawing/elements.js";
import { localTime } from "../drawing/local_time.js";
import { fixed } from "../drawing/numbers.js";
import { fillTable } from "../drawing/table.js";
import { obstacle } from "../people/permissions.js";
import { tr } from "../words/words.js";

const PERIOD_MS = 1000;
const SECONDS = 60;
const WIDTH = 600;
const HEIGHT = 150;
const MOST_BYTES = 2_900_000;
const NONE = "–";

export class SimulationPanel {
  /**
   * @param {import("./trace.js").Trace} trace with today's samples
   * @param {import("./window_editor.js").WindowEditor} editor which takes the window
   * @param {import("../people/access.js").Access} access the log-in
   */
  constructor(trace, editor, access) {
    Object.assign(this, { trace, editor, access, session: null, sample: null, found: null, nextMs: 0 });
    this.root = byId("simulation");
    this.opener = byId("do-simulation");
    this.form = byId("simulation-form");
    this.outcome = byId("simulation-outcome");
    this.opener.addEventListener("click", () => (this.root.hidden ? this.#open() : this.close()));
    byId("simulation-close").addEventListener("click", () => this.close());
    byId("simulation-window").addEventListener("click", () => this.#offer());
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#sign();
    });
  }

  /** @returns {boolean} whether it was open */
  close() {
    const wasOpen = !this.root.hidden;
    this.root.hidden = true;
    this.opener.setAttribute("aria-expanded", "false");
    this.form.reset();
    say(this.outcome, "", "");
    if (wasOpen) this.opener.focus();
    return wasOpen;
  }

  /** @param {?object} sample the newest sample if it is current, @param {?object} session the chosen or running session */
  tend(sample, session, nowMs) {
    this.opener.disabled = session === null;
    const isOther = session?.id !== this.session?.id || session?.status !== this.session?.status;
    Object.assign(this, { session, sample });
    if (this.root.hidden) return;
    if (session === null) this.close();
    else if (isOther) this.#read();
    else if (nowMs >= this.nextMs) this.#show(nowMs);
  }

  #open() {
    this.root.hidden = false;
    this.opener.setAttribute("aria-expanded", "true");
    byId("simulation-heading").focus();
    this.#read();
  }

  async #read() {
    const { id, status, patient_reference: patient } = this.session;
    this.found = null;
    this.form.hidden = true;
    setText(byId("simulation-note"), tr("page.loading"));
    try {
      const found = await readSimulation(id).catch((error) => (error.code === "not_found" ? null : Promise.reject(error)));
      const others = status === "created" ? await findSessions({ patient_reference: patient, limit: 50 }) : { items: [] };
      if (this.session?.id !== id) return;
      this.found = found;
      this.#offerSessions(others.items);
      setText(byId("simulation-note"), this.#words());
    } catch (error) {
      setText(byId("simulation-note"), tr("simulation.not_known", { message: error.message }));
    }
    this.#show(performance.now());
  }

  #words() {
    if (this.found !== null) {
      const { signed_by: name, signed_at: at, origin, begun_at: day } = this.found;
      const what = tr(`simulation.origin.${origin}`, { day: day === null ? "" : localTime(day) });
      const position = this.found.has_position ? tr("simulation.position") : tr("simulation.no_position");
      return `${what}, ${tr("simulation.signed", { name, at: localTime(at) })}. ${position}`;
    }
    return this.session.status === "created" ? tr("simulation.none") : tr("simulation.none_started");
  }

  #offerSessions(items) {
    const { session } = this.form.elements;
    const over = items.filter((one) => one.started_at !== null && !["created", "running"].includes(one.status));
    const options = over.map((one) => new Option(tr("simulation.session", { plan: one.plan_id, fraction: one.fraction_id, at: localTime(one.started_at) }), one.id));
    session.replaceChildren(new Option(tr("simulation.from_file"), ""), ...options);
    const why = obstacle(this.access.person, "reference");
    this.form.hidden = this.session.status !== "created";
    this.form.querySelector("[type=submit]").disabled = why !== "";
    if (why !== "" && !this.form.hidden) say(this.outcome, "failed", why);
  }

  #show(nowMs) {
    this.nextMs = nowMs + PERIOD_MS;
    const { found } = this;
    byId("simulation-traces").hidden = found === null;
    byId("simulation-window").hidden = found === null || found.lower_percent === null;
    fillTable(byId("simulation-table"), found === null ? [] : rows(found, this.sample, this.session));
    if (found === null) return;
    const signal = found.signal === "rpm" ? "whole" : found.signal;
    const all = this.trace.kept.all.filter((one) => Number.isFinite(one[signal]));
    const end = all.at(-1)?.t ?? 0;
    const today = all.filter((one) => one.t > end - SECONDS).map((one) => [one.t - end, one[signal]]);
    const last = found.trace.at(-1)[0];
    const then = found.trace.map(([at, mm]) => [at - last, mm]);
    const [low, high] = range(today);
    const reach = 1.6 * Math.max(found.end_inhale_mm - found.end_exhale_mm, high - low, 1);
    // Each from its own end of exhale: their zeros are those of two days.
    byId("simulation-then").setAttribute("points", line(then, found.end_exhale_mm, reach));
    byId("simulation-now").setAttribute("points", line(today, low, reach));
  }

  #offer() {
    const { lower_percent: lower, upper_percent: upper } = this.found;
    const isOpen = this.editor.offer(lower, upper);
    if (isOpen) this.close();
    else say(this.outcome, "failed", this.editor.opener.title);
  }

  async #sign() {
    const { elements } = this.form;
    const [file] = elements.file.files;
    const chosen = elements.session.value;
    if ((chosen === "") === (file === undefined)) return say(this.outcome, "failed", tr("simulation.choose_one"));
    if (file !== undefined && file.size > MOST_BYTES) return say(this.outcome, "failed", tr("simulation.too_large", { most: MOST_BYTES / 1e6 }));
    const submit = this.form.querySelector("[type=submit]");
    submit.disabled = true;
    try {
      const source = chosen === "" ? { file: await inBase64(file) } : { session_id: chosen };
      await signSimulation(this.session.id, { operator: this.access.person.name, password: elements.own_password.value || null, ...source });
      this.form.reset();
      say(this.outcome, "done", "");
      await this.#read();
    } catch (error) {
      say(this.outcome, "failed", error.message);
    } finally {
      elements.own_password.value = "";
      submit.disabled = false;
    }
  }
}

/** Rows: the breath, the period and the window of the simulation day and of today. */
function rows(found, sample, session) {
  const breath = sample?.breath;
  const rate = breath?.rate_per_min;
  const window = session.window ?? {};
  const edges = (lower, upper, unit = "%") => (Number.isFinite(lower) ? `${fixed(lower, 0)} – ${fixed(upper, 0)} ${unit}` : NONE);
  const own = Number.isFinite(window.lower_mm) ? edges(window.lower_mm, window.upper_mm, "mm") : edges(window.lower_percent, window.upper_percent);
  const number = (value, digits) => (Number.isFinite(value) ? fixed(value, digits) : NONE);
  return [
    ["", tr("simulation.heading"), tr("simulation.today")],
    [tr("simulation.depth"), number(found.end_inhale_mm - found.end_exhale_mm, 1), number(breath?.amplitude, 1)],
    [tr("simulation.period"), number(found.period_s, 1), number(60 / rate, 1)],
    [tr("simulation.range"), number(found.peak_to_peak_mm, 1), NONE],
    [tr("simulation.window"), edges(found.lower_percent, found.upper_percent), own],
  ];
}

/** The levels below which, and above which, a tenth of the values lies. */
function range(points) {
  const sorted = points.map(([, mm]) => mm).sort((one, other) => one - other);
  return [0.1, 0.9].map((share) => sorted[Math.floor(share * sorted.length)] ?? 0);
}

/** Points of a line: the last minute from left to right, `reach` [mm] from bottom to top. */
function line(points, zero, reach) {
  return points.map(([at, mm]) => `${(WIDTH * (1 + at / SECONDS)).toFixed(1)},${(HEIGHT * (0.85 - (mm - zero) / reach)).toFixed(1)}`).join(" ");
}

function inBase64(file) {
  return new Promise((resolve, reject) => {
    const reader = new FileReader();
    reader.addEventListener("load", () => resolve(reader.result.slice(reader.result.indexOf(",") + 1)));
    reader.addEventListener("error", () => reject(reader.error));
    reader.readAsDataURL(file);
  });
}
