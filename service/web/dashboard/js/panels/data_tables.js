/**
 * What the page draws, as tables: the gating window, the trace, the motion of each region and the holds by cause. Shown
 * on request and filled once a second; cells are changed in place, so that a reader keeps its place.
 */

import { byId, setText } from "../drawing/elements.js";
import { fixed, signed } from "../drawing/numbers.js";
import { fillTable } from "../drawing/table.js";
import { isUnseen } from "../drawing/canvas.js";
import { conditionsOf, signalName } from "../stream/gating_window.js";
import { tr } from "../words/words.js";

const PERIOD_MS = 1000;
/** Lines of the trace [s]. */
const SECONDS = 30;
const NONE = "–";

export class DataTables {
  /** @param {import("./trace.js").Trace} trace whose samples are listed */
  constructor(trace) {
    Object.assign(this, { trace, root: byId("tables"), opener: byId("do-tables"), nextMs: 0 });
    this.opener.addEventListener("click", () => (this.root.hidden ? this.#open() : this.close()));
    byId("tables-close").addEventListener("click", () => this.close());
  }

  #open() {
    this.root.hidden = false;
    this.nextMs = 0;
    this.opener.setAttribute("aria-expanded", "true");
    byId("tables-heading").focus();
  }

  /** @returns {boolean} whether it was open */
  close() {
    const wasOpen = !this.root.hidden;
    this.root.hidden = true;
    this.opener.setAttribute("aria-expanded", "false");
    this.#fill(null, null);
    if (wasOpen) this.opener.focus();
    return wasOpen;
  }

  /** @param {?object} sample the newest sample if it is current: without one nothing is listed */
  tend(sample, session, nowMs) {
    if (this.root.hidden || nowMs < this.nextMs) return;
    this.nextMs = nowMs + PERIOD_MS;
    this.#fill(sample, session);
  }

  #fill(sample, session) {
    setText(byId("tables-note"), sample === null ? tr("tables.nothing_present") : tr("tables.once_a_second"));
    fillTable(byId("table-window"), sample === null ? [] : windowRows(sample.window));
    fillTable(byId("table-trace"), sample === null ? [] : traceRows(this.trace.kept.all));
    fillTable(byId("table-map"), sample?.regions_mm ? mapRows(sample.regions_mm, sample.unseen_cells ?? []) : []);
    const isOwn = sample !== null && session?.id === sample.session_id;
    fillTable(byId("table-holds"), isOwn ? holdRows(session.summary?.holds ?? []) : []);
  }
}

function windowRows(window) {
  const head = [tr("tables.condition"), tr("tables.signal"), tr("tables.from"), tr("tables.to"), tr("tables.inside")];
  return [head, ...conditionsOf(window).map((one) => [tr(`tables.kind.${one.kind}`), signalName(one), ...edges(one), one.is_inside ? tr("tables.yes") : tr("tables.no")])];
}

function edges(one) {
  if (one.kind === "phase") return [`${one.from_percent} %`, `${one.to_percent} %`];
  return [one.lower, one.upper].map((value) => value === null ? "–" : `${value} ${one.unit === "percent" ? "%" : one.unit}`);
}

/** One sample a second, the newest first. */
function traceRows(samples) {
  const rows = [[tr("tables.seconds_ago"), tr("page.gated"), tr("page.whole"), tr("page.thorax"), tr("page.abdomen"), tr("arming.gate")]];
  const newest = samples.at(-1);
  let next = 0;
  for (let i = samples.length - 1; i >= 0 && next <= SECONDS; i -= 1) {
    const ago = newest.t - samples[i].t;
    if (ago < next) continue;
    next = Math.floor(ago) + 1;
    const values = ["gated", "whole", "thorax", "abdomen"].map((name) => number(samples[i][name]));
    rows.push([fixed(Math.floor(ago), 0), ...values, tr(`trace.${samples[i].gate}`)]);
  }
  return rows;
}

function mapRows(regionsMm, unseenCells) {
  const head = [tr("tables.row"), ...regionsMm[0].map((_, column) => String(column))];
  return [head, ...regionsMm.map((row, r) => [String(r), ...row.map((value, c) => cellText(value, isUnseen(unseenCells, r, c)))])];
}

function cellText(value, isHidden) {
  if (!Number.isFinite(value)) return tr("trace.not_measured");
  return isHidden ? tr("tables.not_seen", { value: signed(value) }) : signed(value);
}

function holdRows(holds) {
  return [[tr("tables.cause"), tr("tables.count")], ...holds.map(({ text, count }) => [text, String(count)])];
}

function number(value) {
  return Number.isFinite(value) ? signed(value) : NONE;
}
