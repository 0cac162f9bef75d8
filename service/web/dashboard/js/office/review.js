/**
 * A session that is over, looked at again: what became of it, its whole trace with window and reference, the moment at the
 * pointer, the plan's other fractions, and the signatures.
 *
 * The session and the part that is shown stand in the page's address, so that a link leads to a moment.
 */

import { dicomUrl, listSessions, noteReport, readReport, readSent, readTrace, reportUrl, samplesUrl, sendReport, signReport } from "../api.js";
import { byId, part, pushButton, said, say, setText } from "../drawing/elements.js";
import { Chart } from "../drawing/chart.js";
import { stepFor } from "../drawing/color_scale.js";
import { fixed, signed } from "../drawing/numbers.js";
import { localTime } from "../drawing/local_time.js";
import * as layers from "../drawing/trace_layers.js";
import { may } from "../people/permissions.js";
import { shortReason, whatIs } from "../words/reasons.js";
import { has, tr } from "../words/words.js";
import { fractionsPicture } from "./fractions.js";
import { Moment } from "./moment.js";
import { table } from "./parts.js";

/** Ranges that are asked for: the part shown and half of it on either side, at two for each of 1,000 pixels. */
const POINTS = 4000;
const RANGES_SHOWN = 1000;
const SHORTEST_S = 0.5;
/** Steps in which the report counts latencies [ms]. */
const LATENCY_STEP_MS = 5;
const FACTOR = 1.5;
/** Samples further apart are not joined [s]. */
const JOIN_S = 0.2;
const STEPS_S = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200];
const MOST_MARKS = 8;
/** What is shown around an act of a person, before and after it [s]. */
const AROUND_S = [10, 20];
/** Fractions of the plan that are put beside each other: each report is computed from all of its session's samples. */
const MOST_FRACTIONS = 12;
const SIGNALS = new Set(["whole", "thorax", "abdomen"]);

export function reviewRoom({ root, person, ended }) {
  const [, id, from, to] = window.location.hash.split("/");
  root.append(byId("review-template").content.cloneNode(true));
  const range = [from, to].map(Number);
  new Review({ id, person, ended, heading: root.querySelector("h1") }).show(range[1] - range[0] >= SHORTEST_S ? range : null);
}

class Review {
  constructor({ id, person, ended, heading }) {
    Object.assign(this, { id, person, ended, heading, trace: null, report: null, range: null, endS: 0, startMs: NaN, isReading: false, chart: null });
    this.frame = byId("review-frame");
    this.moment = new Moment(id, (t) => this.#clock(t, true), () => this.#draw());
    byId("review-all").addEventListener("click", () => this.#look(0, this.endS));
    byId("review-signal").addEventListener("change", () => this.#draw());
    this.frame.addEventListener("keydown", (event) => this.#key(event));
    byId("review-send").addEventListener("click", () => this.#send());
    this.form = byId("review-sign");
    this.form.addEventListener("submit", (event) => { event.preventDefault(); this.#write(false); });
    this.signing = byId("review-do-sign");
    this.signing.addEventListener("submit", (event) => { event.preventDefault(); this.#write(true); });
  }

  /** Read report and samples and show them, the given part at first. */
  async show(range) {
    const { id } = this;
    byId("review-links").replaceChildren(...links(id));
    setText(byId("review-note"), tr("review.reading"));
    try {
      const [report, trace] = await Promise.all([readReport(id), readTrace(id, { points: POINTS })]);
      if (this.ended.aborted) return;
      this.endS = trace.end_s;
      this.startMs = Date.parse(trace.first_at ?? report.session.started_at);
      this.#figures(report);
      this.#sent();
      const isEmpty = trace.times_s.length === 0;
      setText(byId("review-note"), isEmpty ? tr("review.no_samples") : "");
      if (isEmpty) { this.#signatures(report); return; }
      this.trace = drawable(trace, 0, trace.end_s);
      this.moment.rangeMm = stepFor(Math.max(2, ...Object.values(this.trace.values).flat().map(Math.abs)));
      const { signal } = report.session.window;
      if (SIGNALS.has(signal)) byId("review-signal").value = signal;
      this.#look(...(range ?? [0, this.endS]));
      this.moment.show((this.range[0] + this.range[1]) / 2);
      this.#signatures(report); // with the place above it taken: what is clicked does not move
      this.#fractions(report);
    } catch (error) {
      if (!this.ended.aborted) setText(byId("review-note"), tr("review.not_read", { message: error.message }));
    }
  }

  #figures(report) {
    const { figures, head, session, deviations, events } = report;
    this.report = report;
    setText(this.heading, [session.patient_reference, session.plan_id, session.fraction_id].join(" · "));
    setText(byId("review-when"), tr("review.when", { started: localTime(session.started_at), status: tr(`status.${session.status}`), ended: localTime(session.ended_at) }));
    byId("review-figures").replaceChildren(...keyFigures(report).map(figure));
    byId("review-head").replaceChildren(...[
      ["review.armed_by", head.armed_by.join(", ")], ["review.plan", [head.plan_label, head.plan_uid].filter(Boolean).join(" · ")],
      ["review.room", [head.room, head.machine].filter(Boolean).join(" · ")], ["office.camera", head.camera],
      ["office.calibration", head.calibrated_at === null ? "" : localTime(head.calibrated_at)], ["review.qa", said(head.qa)],
    ].map(([name, value]) => figure([tr(name), value || "–"])));
    const rows = figures.motion.map((one) => [nameOf(one.signal), signed(one.mean_mm, 2), fixed(one.deviation_mm, 2), `±${fixed(one.within_95_mm, 2)}`]);
    const columns = (...names) => names.map((name, i) => ({ name, isNumber: i > 0 }));
    byId("review-motion").replaceChildren(table(columns(tr("review.region"), tr("review.mean"), tr("review.deviation"), tr("review.within")), rows));
    const pulses = figures.pulse_list.map((one, i) => [String(i + 1), this.#link(one.from_s), this.#clock(one.to_s, true), fixed(one.seconds, 2), one.spread === null ? "–" : fixed(one.spread, 2)]);
    byId("review-pulses").replaceChildren(table(columns(tr("office.number"), tr("tables.from"), tr("tables.to"), "s", tr("review.spread")), pulses));
    const holds = figures.holds.map((one) => [whatIs(one.reason, one.text), String(one.count), `${fixed(one.seconds, 1)} s`]);
    byId("review-holds").replaceChildren(holds.length === 0 ? part("p", tr("report.no_holds")) : table(columns(tr("office.reason"), tr("office.counted"), tr("review.time")), holds));
    byId("review-cells").replaceChildren(...cells(figures.cells));
    byId("review-latency").replaceChildren(...histogram(figures.latency_bins));
    byId("review-look").replaceChildren(...(deviations.length === 0 ? [part("li", tr("review.nothing"))] : deviations.map((one) => part("li", said(one)))));
    byId("review-acts").replaceChildren(...events.map((one) => {
      const line = part("li", "");
      line.append(this.#timeOf(one.at), part("strong", one.actor), part("span", said(one.text)));
      return line;
    }));
  }

  /** The plan's other fractions beside this one, each as soon as its report is there. */
  async #fractions({ session }) {
    const place = byId("review-fractions");
    const reports = [];
    try {
      const { items } = await listSessions(MOST_FRACTIONS, session.plan_id);
      const others = items.filter((one) => one.plan_id === session.plan_id && one.patient_reference === session.patient_reference && one.started_at !== null && one.status !== "running");
      for (const { id } of others) {
        if (this.ended.aborted) return;
        reports.push(id === this.id ? this.report : await readReport(id).catch(() => null));
        const found = reports.filter((one) => one !== null);
        if (!this.ended.aborted && found.length > 0) place.replaceChildren(...fractionsPicture(found, this.id));
      }
    } catch (error) {
      if (!this.ended.aborted) setText(place, error.message);
    }
  }

  /** A moment of the trace by its time of day, which leads to it. */
  #link(t) {
    const made = pushButton(this.#clock(t, true), () => { this.#look(t - AROUND_S[0], t + AROUND_S[1]); this.moment.show(t); this.frame.scrollIntoView({ block: "nearest" }); });
    made.className = "at";
    return made;
  }

  /** The time of an act, which leads to its part of the trace if it is in it. */
  #timeOf(at) {
    const t = (Date.parse(at) - this.startMs) / 1000;
    return t >= 0 && t <= this.endS ? this.#link(t) : part("time", localTime(at));
  }

  /** What is signed, how much is missing, and the form for those who may sign. */
  #signatures(report) {
    this.report = report;
    const { signatures, signatures_needed: needed } = report;
    const lines = [...report.differs, ...signatures.map((one) => tr(one.is_signed ? `review.signed${one.meaning ? `.${one.meaning}` : ""}` : "review.noted", { name: one.name, at: localTime(one.at), note: one.note === "" ? "" : `: ${one.note}` }))];
    const missing = needed - signatures.filter((one) => one.is_signed && one.is_of_this).length;
    if (missing > 0) lines.push(tr(needed > 1 ? "review.missing_second" : "review.missing", { missing }));
    byId("review-signatures").replaceChildren(...lines.map((one) => part("li", one)));
    const { person } = this;
    this.form.hidden = !may(person, "sign");
    this.signing.hidden = this.form.hidden || signatures.some((one) => one.is_signed && one.is_of_this && one.name === person.name);
    const isOutside = person.way === "oidc";
    byId("review-password").hidden = isOutside;
    this.signing.elements.password.required = !isOutside;
    byId("review-log-in-anew").hidden = this.signing.hidden || !isOutside;
  }

  async #write(isSigned) {
    const { id, report } = this;
    const note = this.form.elements.note.value.trim();
    const { meaning, password } = this.signing.elements;
    const { name } = this.person;
    const typed = password.required ? password.value : null;
    if (isSigned) password.value = "";
    try {
      const content = report.content_sha256;
      const signedNow = await (isSigned ? signReport(id, name, { meaning: meaning.value, password: typed, note, content }) : noteReport(id, name, note, content));
      if (this.ended.aborted) return;
      this.form.reset();
      if (isSigned) this.signing.reset();
      this.#figures(signedNow);
      this.#signatures(signedNow);
      say(byId("review-outcome"), "done", tr(isSigned ? "review.is_signed" : "review.is_noted"));
    } catch (error) {
      if (!this.ended.aborted) say(byId("review-outcome"), "failed", error.message);
    }
  }

  /** Ask for curve and report to be sent to the PACS, and say how far that is. */
  async #send() {
    try {
      await sendReport(this.id, this.person.name, this.report.content_sha256);
      await this.#sent();
    } catch (error) {
      if (!this.ended.aborted) say(byId("review-sent"), "failed", error.message);
    }
  }

  /** Whether the PACS has the session; without a PACS there is nothing to send to. */
  async #sent() {
    const found = await readSent().catch(() => null);
    if (this.ended.aborted || found === null) return;
    byId("review-pacs").hidden = !found.is_configured;
    byId("review-send").hidden = !may(this.person, "sign");
    const one = found.items.find((each) => each.session_id === this.id);
    if (one === undefined) return;
    const words = { name: one.asked_by, at: localTime(one.committed_at ?? one.sent_at ?? one.asked_at), trouble: one.trouble };
    say(byId("review-sent"), one.state === "sent" ? "done" : "waiting", tr(`review.${word(one)}`, words));
  }

  #look(from, to) {
    const span = Math.min(Math.max(to - from, SHORTEST_S), Math.max(this.endS, SHORTEST_S));
    const begin = Math.max(0, Math.min(from, this.endS - span));
    this.range = [begin, begin + span];
    const isWhole = this.range[0] === 0 && this.range[1] >= this.endS;
    window.history.replaceState(null, "", `#session/${this.id}${isWhole ? "" : this.range.map((one) => `/${one.toFixed(2)}`).join("")}`);
    this.#draw();
    this.#read();
  }

  /** Read the part that is shown at its scale, if what is there does not have it: of several wanted at once the last one. */
  async #read() {
    if (this.isReading) return;
    this.isReading = true;
    while (!this.ended.aborted && !this.#hasPart()) {
      const [from, to] = this.range;
      const spare = (to - from) / 2;
      const asked = [Math.max(0, from - spare), Math.min(this.endS + 1, to + spare)];
      try {
        const trace = await readTrace(this.id, { from_s: asked[0], to_s: asked[1], points: POINTS });
        if (this.ended.aborted) return;
        this.trace = drawable(trace, ...asked);
        setText(byId("review-note"), "");
        this.#draw();
      } catch (error) {
        if (this.ended.aborted) return;
        setText(byId("review-note"), tr("review.not_read", { message: error.message }));
        break;
      }
    }
    this.isReading = false;
  }

  #hasPart() {
    const [from, to] = this.range;
    const { from: first, to: last, stepS } = this.trace;
    return first <= from && last >= Math.min(to, this.endS) && stepS <= (to - from) / RANGES_SHOWN;
  }

  #draw() {
    if (this.trace === null || this.range === null) return;
    this.chart ??= this.#made();
    const values = this.trace.values[byId("review-signal").value];
    const edges = this.#edges();
    const [low, high] = extent(values, this.trace.t, this.range, edges.flatMap((one) => [one.lower, one.upper]));
    this.chart.draw([this.trace.t, values], this.range, [low, high]);
  }

  #made() {
    const chart = new Chart(this.frame, [() => layers.COLORS.line], {
      below: (pen) => this.#below(pen),
      above: (pen) => this.#above(pen),
      times: (from, to) => this.#times(from, to),
      hasLabels: () => true,
      isJoined: (i) => i > 0 && this.trace.t[i] - this.trace.t[i - 1] < Math.max(JOIN_S, 2 * this.trace.stepS),
      onPress: () => this.trace !== null,
      onSelect: (from, to) => this.#look(from, to),
      onRelease: () => null,
      hasCursor: false,
    });
    chart.over.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.#zoom(event.deltaY < 0, chart.timeAt(event.offsetX));
    }, { passive: false });
    chart.over.addEventListener("pointermove", (event) => {
      if (event.buttons === 0 && this.trace !== null) this.moment.show(Math.max(0, chart.timeAt(event.offsetX)));
    });
    return chart;
  }

  #below(pen) {
    layers.drawUnit(pen, "mm");
    layers.clip(pen);
    layers.drawBeam(pen, this.trace.beams.filter(([from, to]) => to >= this.range[0] && from <= this.range[1]));
    layers.drawReference(pen);
    layers.drawSteps(pen, this.#references());
    for (const { from, to, ...edges } of this.#edges()) {
      const box = { ...pen.box, x0: Math.max(pen.box.x0, pen.x(from)), x1: Math.min(pen.box.x1, pen.x(to)) };
      if (box.x1 > box.x0) layers.drawWindow({ ...pen, box }, edges);
    }
  }

  /** The window of the drawn signal as it was applied, from each change to the next [s]; none in per cent or of a phase. */
  #edges() {
    const { session, windows } = this.report;
    if (session.window.signal !== byId("review-signal").value) return [];
    const at = windows.map((one) => Math.max(0, (Date.parse(one.at) - this.startMs) / 1000));
    const all = windows.map(({ lower, upper }, i) => ({ from: at[i], to: at[i + 1] ?? this.endS, lower, upper }));
    return all.filter((one) => one.lower !== null && one.to > one.from);
  }

  /** Where a reference was set: what lies before the last one was measured against another. */
  #references() {
    const set = this.report.events.filter((one) => one.action === "session.reference" && !one.text.includes("refused"));
    return set.map((one) => ({ t: (Date.parse(one.at) - this.startMs) / 1000, text: tr("review.reference") })).filter((one) => one.t > 0);
  }

  /** Holds as long as they lasted, each with its cause in the lane. */
  #above(pen) {
    const [from, to] = this.range;
    const holds = this.trace.holds.filter((one) => one.to >= from && one.from <= to);
    layers.drawLane(pen, layers.labelsOf(holds, this.#references().filter((one) => one.t >= from && one.t <= to)));
    layers.clip(pen);
    layers.drawStates(pen, holds);
    if (this.moment.found !== null) layers.drawMoment(pen, this.moment.found.at_s);
  }

  #zoom(isIn, at) {
    const [from, to] = this.range;
    const factor = isIn ? 1 / FACTOR : FACTOR;
    this.#look(at - (at - from) * factor, at + (to - at) * factor);
  }

  #key(event) {
    if (this.range === null || this.trace === null || event.ctrlKey || event.metaKey || event.altKey) return;
    const [from, to] = this.range;
    const step = (to - from) / 4;
    const act = {
      "+": () => this.#zoom(true, (from + to) / 2),
      "=": () => this.#zoom(true, (from + to) / 2),
      "-": () => this.#zoom(false, (from + to) / 2),
      ArrowLeft: () => this.#look(from - step, to - step),
      ArrowRight: () => this.#look(from + step, to + step),
      Home: () => this.#look(0, this.endS),
    }[event.key];
    if (act === undefined) return;
    event.preventDefault();
    act();
    this.moment.show((this.range[0] + this.range[1]) / 2);
  }

  #times(from, to) {
    if (this.trace === null) return [];
    const step = STEPS_S.find((one) => (to - from) / one <= MOST_MARKS) ?? STEPS_S.at(-1);
    const marks = [];
    for (let at = Math.ceil(from / step) * step; at <= to; at += step) marks.push({ at, text: this.#clock(at, step < 1) });
    return marks;
  }

  #clock(t, hasTenths) {
    const at = new Date(this.startMs + 1000 * t);
    const text = at.toLocaleTimeString("en-GB");
    return hasTenths ? `${text}.${Math.floor(at.getMilliseconds() / 100)}` : text;
  }
}

/** The region's cells as the camera sees them, the darker the more they move while the beam is on; each with its number. */
function cells(rows) {
  const known = rows.flat().filter((one) => one !== null);
  const most = Math.max(...known, 0.1);
  return rows.map((row) => {
    const line = part("tr", "");
    line.append(...row.map((one) => {
      const cell = part("td", one === null ? "–" : fixed(one, 1));
      if (one !== null) cell.style.background = `color-mix(in srgb, var(--draw-gated) ${Math.round(60 * (one / most))}%, transparent)`;
      return cell;
    }));
    return line;
  });
}

/** Bars of the latencies that occurred, each with its range and count for those who point at it. */
function histogram(counts) {
  const most = Math.max(...counts, 1);
  const last = counts.findLastIndex((one) => one > 0);
  return counts.slice(0, last + 1).map((count, i) => {
    const bar = part("i", "");
    bar.style.height = `${Math.max(100 * (count / most), count > 0 ? 3 : 0)}%`;
    bar.title = tr("review.frames_from", { from: LATENCY_STEP_MS * i, to: LATENCY_STEP_MS * (i + 1), count });
    return bar;
  });
}

function keyFigures({ figures, session }) {
  const { latency, pulse_s: pulse, amplitude, period_s: period } = figures;
  const gated = figures.motion.find((one) => one.signal === session.window.signal);
  const unit = session.window.signal === "volume" ? "l" : "mm";
  return [
    [tr("report.beam_on", { value: session.is_simulated_beam ? tr("report.simulated") : "" }), `${fixed(figures.beam_on_s, 1)} s`],
    [tr("report.duty_cycle_while_armed"), figures.duty_percent === null ? "–" : `${fixed(figures.duty_percent, 0)} %`],
    [tr("review.pulses"), `${figures.pulses}${pulse === null ? "" : ` · ${fixed(pulse.median, 1)} s`}`],
    [tr("review.within_on"), gated === undefined ? "–" : `±${fixed(gated.within_95_mm, 2)} mm`],
    [tr("review.breath"), amplitude === null ? "–" : `${fixed(amplitude.median, 1)} ${unit}${period === null ? "" : ` · ${fixed(period.median, 1)} s`}`],
    [tr("report.elapsed"), `${fixed(figures.recorded_s, 0)} s`],
    [tr("report.not_measured_never_received"), `${figures.lost} · ${figures.missed_frames} / ${figures.frames}`],
    [tr("office.latency"), latency.p99_ms === null ? "–" : `${fixed(latency.p99_ms, 0)} ms`],
  ];
}

function figure([name, value]) {
  const line = part("div", "");
  line.append(part("dt", name), part("dd", value));
  return line;
}

/** How far a session is on its way to the PACS. */
const word = ({ state, trouble, committed_at: keptAt }) => (state === "sent" ? (keptAt === null ? "sent" : "kept") : trouble === "" ? "waits" : "waits_because");

const nameOf = (signal) => (has(`page.${signal}`) ? tr(`page.${signal}`) : signal);

function links(id) {
  const made = [["PDF", reportUrl(id, "pdf")], ["HTML", reportUrl(id, "html")], ["CSV", samplesUrl(id, "csv")], ["Arrow", samplesUrl(id, "arrow")], ["Parquet", samplesUrl(id, "parquet")], ["DICOM", dicomUrl(id)]];
  return made.map(([name, url], i) => {
    const link = part("a", i < 2 ? tr("review.report", { name }) : tr("review.samples", { name }));
    link.href = url;
    link.download = "";
    return link;
  });
}

/** Least and most within a part and of the window's edges, with some space. */
function extent(values, t, [from, to], edges) {
  let [low, high] = [Math.min(0, ...edges), Math.max(0, ...edges)];
  for (let i = 0; i < t.length; i += 1) {
    if (t[i] < from || t[i] > to || values[i] === null) continue;
    low = Math.min(low, values[i]);
    high = Math.max(high, values[i]);
  }
  return [low - 1, high + 1];
}

/** What is drawn of a trace: a range as its least and its most at one time, holds and beam as they are. */
function drawable(trace, from, to) {
  const isExact = trace.step_s === 0;
  const twice = (some, others) => (isExact ? some : some.flatMap((one, i) => [one, others[i]]));
  return {
    from, to, stepS: trace.step_s, beams: trace.beams_s,
    t: twice(trace.times_s, trace.times_s),
    values: Object.fromEntries(trace.signals.map((one) => [one.signal, twice(one.low_mm, one.high_mm)])),
    holds: trace.holds.map((one) => ({ t: one.from_s, from: one.from_s, to: one.to_s, gate: one.gate, text: shortReason(one.reason) })),
  };
}
