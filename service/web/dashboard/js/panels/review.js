/**
 * A session that is over, looked at again: its whole trace, the figures of its report, and what can be taken away.
 *
 * The part that is shown stands in the page's address, so that a link leads to a session and to a moment in it.
 */

import { readReport, readSamples, reportUrl, samplesUrl, signReport } from "../api.js";
import { byId, part, said, say, setText } from "../drawing/elements.js";
import { Chart } from "../drawing/chart.js";
import { fixed } from "../drawing/numbers.js";
import { localTime } from "../drawing/local_time.js";
import * as layers from "../drawing/trace_layers.js";
import { shortReason } from "../words/reasons.js";
import { tr } from "../words/words.js";

const SIGNALS = ["whole", "thorax", "abdomen"];
const SHORTEST_S = 0.5;
/** Steps in which the report counts latencies [ms]. */
const LATENCY_STEP_MS = 5;
const FACTOR = 1.5;
/** Samples further apart are not joined [s]. */
const JOIN_S = 0.2;
const STEPS_S = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200];
const MOST_MARKS = 8;
/** The hold that is no event of its own: the breath leaves the window. */
const USUAL = new Set(["outside_window", "disarmed", ""]);
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
    this.forget();
    byId("review-all").addEventListener("click", () => this.#look(0, this.endS));
    byId("review-signal").addEventListener("change", () => this.#draw());
    this.frame.addEventListener("keydown", (event) => this.#key(event));
    this.form = byId("review-sign");
    this.form.addEventListener("submit", (event) => { event.preventDefault(); this.#sign(true); });
    byId("review-remark").addEventListener("click", () => this.#sign(false));
  }

  forget() {
    Object.assign(this, { id: null, samples: null, range: null, endS: 0, startMs: NaN });
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
      const [report, text] = await Promise.all([readReport(id), readSamples(id)]);
      if (id !== this.id) return;
      this.#figures(report);
      this.#signatures(report);
      this.samples = parsed(text);
      this.endS = this.samples.t.at(-1) ?? 0;
      setText(byId("review-note"), this.samples.t.length === 0 ? tr("review.no_samples") : "");
      if (this.samples.t.length > 0) this.#look(...(range ?? [0, this.endS]));
    } catch (error) {
      if (id === this.id) setText(byId("review-note"), tr("review.not_read", { message: error.message }));
    }
  }

  #figures({ figures, deviations, events }) {
    const rows = figures.motion.map((one) => [tr(`page.${one.signal}`), fixed(one.mean_mm, 2), fixed(one.deviation_mm, 2), `±${fixed(one.within_95_mm, 2)}`]);
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
      line.append(part("time", localTime(one.at)), part("strong", one.actor), part("span", said(one.text)));
      return line;
    }));
  }

  /** What is signed, how much is missing, and the form for those who may sign. */
  #signatures(report) {
    this.report = report;
    const { signatures, signatures_needed: needed } = report;
    const lines = signatures.map((one) => tr(one.is_signed ? "review.signed" : "review.noted", { name: one.name, at: localTime(one.at), note: one.note === "" ? "" : `: ${one.note}` }));
    const missing = needed - signatures.filter((one) => one.is_signed).length;
    if (missing > 0) lines.push(tr(needed > 1 ? "review.missing_second" : "review.missing", { missing }));
    byId("review-signatures").replaceChildren(...lines.map((one) => part("li", one)));
    this.form.hidden = !this.access.may("sign");
  }

  async #sign(isSigned) {
    const { id, report } = this;
    const note = this.form.elements.note.value.trim();
    try {
      const signed = await signReport(id, this.access.person?.name ?? "", isSigned, note, report.samples_sha256);
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
  }

  #draw() {
    if (this.samples === null || this.range === null) return;
    this.chart ??= this.#made();
    const values = this.samples[byId("review-signal").value];
    const [low, high] = extent(values, this.samples.t, this.range);
    this.chart.draw([this.samples.t, values], this.range, [low, high]);
  }

  #made() {
    const chart = new Chart(this.frame, [() => layers.COLORS.line], {
      below: (pen) => this.#below(pen),
      above: (pen) => layers.drawLane(pen, layers.labelsOf(this.samples.holds.filter(({ t }) => t >= this.range[0]), [])),
      times: (from, to) => this.#times(from, to),
      hasLabels: () => true,
      isJoined: (i) => i > 0 && this.samples.t[i] - this.samples.t[i - 1] < JOIN_S,
      onPress: () => this.samples !== null,
      onSelect: (from, to) => this.#look(from, to),
      onRelease: () => null,
    });
    chart.over.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.#zoom(event.deltaY < 0, chart.timeAt(event.offsetX));
    }, { passive: false });
    return chart;
  }

  #below(pen) {
    layers.drawUnit(pen, "mm");
    layers.clip(pen);
    layers.drawBeam(pen, this.samples.beams.filter(([from, to]) => to >= this.range[0] && from <= this.range[1]));
    layers.drawReference(pen);
  }

  #zoom(isIn, at) {
    const [from, to] = this.range;
    const factor = isIn ? 1 / FACTOR : FACTOR;
    this.#look(at - (at - from) * factor, at + (to - at) * factor);
  }

  #key(event) {
    if (this.range === null || event.ctrlKey || event.metaKey || event.altKey) return;
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
  }

  #times(from, to) {
    if (this.samples === null) return [];
    const step = STEPS_S.find((one) => (to - from) / one <= MOST_MARKS) ?? STEPS_S.at(-1);
    const marks = [];
    for (let at = Math.ceil(from / step) * step; at <= to; at += step) marks.push({ at, text: this.#clock(at, step < 1) });
    return marks;
  }

  #clock(t, hasTenths) {
    const at = new Date(this.startMs + this.samples.firstMs + 1000 * t);
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

/** The columns of the export that are drawn: times from the first frame [s], motion [mm], beam on, and holds. */
function parsed(text) {
  const [head, ...lines] = text.trimEnd().split("\n");
  const names = head.split(",");
  const [at, gate, reason, ...signals] = ["decided_ns", "gate", "hold_reason", ...SIGNALS.map((one) => `${one}_mm`)].map((name) => names.indexOf(name));
  const found = { t: [], beams: [], holds: [], firstMs: 0 };
  for (const name of SIGNALS) found[name] = [];
  let [first, before] = [null, ""];
  for (const line of lines) {
    const cells = line.split(",");
    // Nanoseconds since the machine's start exceed what a number holds exactly: the last digits do not matter here.
    const ns = Number(cells[at]);
    first ??= ns;
    const t = (ns - first) / 1e9;
    found.t.push(t);
    SIGNALS.forEach((name, i) => found[name].push(cells[signals[i]] === "" ? null : Number(cells[signals[i]])));
    const now = cells[gate] === "hold" || cells[gate] === "fault" ? cells[reason] : cells[gate];
    if (cells[gate] === "beam_on") {
      if (before === "beam_on") found.beams.at(-1)[1] = t;
      else found.beams.push([t, t]);
    } else if (before === "beam_on") found.beams.at(-1)[1] = t;
    if (now !== before && now === cells[reason] && !USUAL.has(now)) found.holds.push({ t, gate: cells[gate], text: shortReason(now) });
    before = now;
  }
  return found;
}
