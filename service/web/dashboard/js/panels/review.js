/**
 * A session that is over, looked at again: its whole trace, the figures of its report, and what can be taken away.
 *
 * The part that is shown stands in the page's address, so that a link leads to a session and to a moment in it.
 */

import { readReport, readTrace, reportUrl, samplesUrl, signReport } from "../api.js";
import { byId, part, pushButton, said, say, setText } from "../drawing/elements.js";
import { Chart } from "../drawing/chart.js";
import { fixed } from "../drawing/numbers.js";
import { localTime } from "../drawing/local_time.js";
import * as layers from "../drawing/trace_layers.js";
import { shortReason } from "../words/reasons.js";
import { has, tr } from "../words/words.js";
import { Moment } from "./moment.js";

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
const NAMES = { session: "session", from: "from", to: "to" };

/** The session that the page's address names, and the part of it [s]; null without one. */
export function addressed() {
  const given = new URLSearchParams(window.location.search);
  const id = given.get(NAMES.session);
  const [from, to] = [given.get(NAMES.from), given.get(NAMES.to)].map((one) => (one === null ? NaN : Number(one)));
  if (id === null || !/^[0-9a-f]{32}$/.test(id)) return null;
  return { id, range: Number.isFinite(from) && Number.isFinite(to) && to - from >= SHORTEST_S ? [from, to] : null };
}

export class Review {
  /** @param {import("../people/access.js").Access} access the log-in, whose person signs */
  constructor(access) {
    this.access = access;
    this.root = byId("review");
    this.frame = byId("review-frame");
    this.chart = null;
    this.moment = new Moment((t) => this.#clock(t, true));
    this.forget();
    byId("review-all").addEventListener("click", () => this.#look(0, this.endS));
    byId("review-signal").addEventListener("change", () => this.#draw());
    this.frame.addEventListener("keydown", (event) => this.#key(event));
    this.form = byId("review-sign");
    this.form.addEventListener("submit", (event) => { event.preventDefault(); this.#sign(false); });
    byId("review-do-sign").addEventListener("click", () => this.#sign(true));
  }

  forget() {
    Object.assign(this, { id: null, trace: null, range: null, endS: 0, startMs: NaN, isReading: false });
    this.moment.forget();
    this.root.hidden = true;
    setText(byId("review-note"), "");
    for (const name of ["review-motion", "review-look", "review-acts", "review-links", "review-signatures", "review-latency", "review-cells"]) byId(name).replaceChildren();
    this.form?.reset();
    if (this.form) this.form.hidden = true;
    say(byId("review-outcome"), "", "");
    this.chart?.clear();
    address(null);
  }

  /** Read report and samples of a session and show them, the given part of it at first. */
  async show(session, range) {
    this.forget();
    const { id } = session;
    this.id = id;
    this.startMs = Date.parse(session.started_at);
    this.root.hidden = false;
    byId("review-links").replaceChildren(...links(id));
    setText(byId("review-note"), tr("review.reading"));
    try {
      const [report, trace] = await Promise.all([readReport(id), readTrace(id, { points: POINTS })]);
      if (id !== this.id) return;
      this.trace = drawable(trace, 0, trace.end_s);
      this.endS = trace.end_s;
      if (trace.first_at !== null) this.startMs = Date.parse(trace.first_at);
      this.#figures(report);
      this.#signatures(report);
      const isEmpty = trace.times_s.length === 0;
      setText(byId("review-note"), isEmpty ? tr("review.no_samples") : "");
      if (isEmpty) return;
      this.#look(...(range ?? [0, this.endS]));
      this.moment.show(id, (this.range[0] + this.range[1]) / 2);
    } catch (error) {
      if (id === this.id) setText(byId("review-note"), tr("review.not_read", { message: error.message }));
    }
  }

  #figures({ figures, deviations, events }) {
    const rows = figures.motion.map((one) => [has(`page.${one.signal}`) ? tr(`page.${one.signal}`) : one.signal, fixed(one.mean_mm, 2), fixed(one.deviation_mm, 2), `±${fixed(one.within_95_mm, 2)}`]);
    const head = [tr("review.region"), tr("review.mean"), tr("review.deviation"), tr("review.within")];
    const row = (cells, name) => {
      const line = part("tr", "");
      line.append(...cells.map((one) => part(name, one)));
      return line;
    };
    byId("review-motion").replaceChildren(row(head, "th"), ...rows.map((one) => row(one, "td")));
    byId("review-cells").replaceChildren(...cells(figures.cells ?? []));
    byId("review-latency").replaceChildren(...histogram(figures.latency_bins ?? []));
    byId("review-look").replaceChildren(...(deviations.length === 0 ? [part("li", tr("review.nothing"))] : deviations.map((one) => part("li", said(one)))));
    byId("review-acts").replaceChildren(...events.map((one) => {
      const line = part("li", "");
      line.append(this.#timeOf(one.at), part("strong", one.actor), part("span", said(one.text)));
      return line;
    }));
  }

  /** The time of an act, which leads to its part of the trace if it is in it. */
  #timeOf(at) {
    const t = (Date.parse(at) - this.startMs) / 1000;
    if (!(t >= 0 && t <= this.endS)) return part("time", localTime(at));
    const made = pushButton(localTime(at), () => { this.#look(t - AROUND_S[0], t + AROUND_S[1]); this.moment.show(this.id, t); this.frame.scrollIntoView({ block: "nearest" }); });
    made.className = "at";
    return made;
  }

  /** What is signed, how much is missing, and the form for those who may sign. */
  #signatures(report) {
    this.report = report;
    const { signatures, signatures_needed: needed } = report;
    const lines = [...report.differs, ...signatures.map((one) => tr(one.is_signed ? "review.signed" : "review.noted", { name: one.name, at: localTime(one.at), note: one.note === "" ? "" : `: ${one.note}` }))];
    const missing = needed - signatures.filter((one) => one.is_signed && one.is_of_this).length;
    if (missing > 0) lines.push(tr(needed > 1 ? "review.missing_second" : "review.missing", { missing }));
    byId("review-signatures").replaceChildren(...lines.map((one) => part("li", one)));
    this.form.hidden = !this.access.may("sign");
    byId("review-do-sign").hidden = signatures.some((one) => one.is_signed && one.is_of_this && one.name === this.access.person?.name);
  }

  async #sign(isSigned) {
    const { id, report } = this;
    const note = this.form.elements.note.value.trim();
    try {
      const signed = await signReport(id, this.access.person?.name ?? "", isSigned, note, report.content_sha256);
      if (id !== this.id) return;
      this.form.reset();
      this.#figures(signed);
      this.#signatures(signed);
      say(byId("review-outcome"), "done", tr(isSigned ? "review.is_signed" : "review.is_noted"));
    } catch (error) {
      if (id === this.id) say(byId("review-outcome"), "failed", error.message);
    }
  }

  #look(from, to) {
    const span = Math.min(Math.max(to - from, SHORTEST_S), Math.max(this.endS, SHORTEST_S));
    const begin = Math.max(0, Math.min(from, this.endS - span));
    this.range = [begin, begin + span];
    address({ id: this.id, range: this.range[0] === 0 && this.range[1] >= this.endS ? null : this.range });
    this.#draw();
    this.#read();
  }

  /** Read the part that is shown at its scale, if what is there does not have it: of several wanted at once the last one. */
  async #read() {
    const { id } = this;
    if (this.isReading) return;
    this.isReading = true;
    while (id === this.id && !this.#hasPart()) {
      const [from, to] = this.range;
      const spare = (to - from) / 2;
      const asked = [Math.max(0, from - spare), Math.min(this.endS + 1, to + spare)];
      try {
        const trace = await readTrace(id, { from_s: asked[0], to_s: asked[1], points: POINTS });
        if (id !== this.id) return;
        this.trace = drawable(trace, ...asked);
        setText(byId("review-note"), "");
        this.#draw();
      } catch (error) {
        if (id !== this.id) return;
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
    const [low, high] = extent(values, this.trace.t, this.range);
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
    });
    chart.over.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.#zoom(event.deltaY < 0, chart.timeAt(event.offsetX));
    }, { passive: false });
    chart.over.addEventListener("pointermove", (event) => {
      if (event.buttons === 0 && this.trace !== null) this.moment.show(this.id, Math.max(0, chart.timeAt(event.offsetX)));
    });
    return chart;
  }

  #below(pen) {
    layers.drawUnit(pen, "mm");
    layers.clip(pen);
    layers.drawBeam(pen, this.trace.beams.filter(([from, to]) => to >= this.range[0] && from <= this.range[1]));
    layers.drawReference(pen);
  }

  /** Holds as long as they lasted, each with its cause in the lane. */
  #above(pen) {
    const [from, to] = this.range;
    const holds = this.trace.holds.filter((one) => one.to >= from && one.from <= to);
    layers.drawLane(pen, layers.labelsOf(holds, []));
    layers.clip(pen);
    layers.drawStates(pen, holds);
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
    this.moment.show(this.id, (this.range[0] + this.range[1]) / 2);
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

/** Put the session and the part of it into the page's address, or take it out of it. */
function address(looked) {
  const url = new URL(window.location.href);
  for (const name of Object.values(NAMES)) url.searchParams.delete(name);
  if (looked?.id) url.searchParams.set(NAMES.session, looked.id);
  if (looked?.range) [NAMES.from, NAMES.to].forEach((name, i) => url.searchParams.set(name, looked.range[i].toFixed(2)));
  window.history.replaceState(null, "", url);
}

function links(id) {
  const made = [["PDF", reportUrl(id, "pdf")], ["HTML", reportUrl(id, "html")], ["CSV", samplesUrl(id, "csv")], ["Arrow", samplesUrl(id, "arrow")], ["Parquet", samplesUrl(id, "parquet")]];
  return made.map(([name, url], i) => {
    const link = part("a", i < 2 ? tr("review.report", { name }) : tr("review.samples", { name }));
    link.href = url;
    link.download = "";
    return link;
  });
}

/** Least and most within a part, with some space. */
function extent(values, t, [from, to]) {
  let [low, high] = [0, 0];
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
