/**
 * Sessions: all of them, searched by text, time and state, page by page; each leads to its review and to its report. The
 * figures of those in the list can be read beside each other.
 */

import { findSessions, readReport, reportUrl, samplesUrl } from "../api.js";
import { part, pushButton, setText } from "../drawing/elements.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";
import { between, chosen, field, form, link, pages, section, timed, typed } from "./parts.js";

const LIMIT = 25;
const TEXTS = ["patient", "plan", "fraction", "started", "state", "signed"];
const STATES = ["created", "running", "ended", "stopped", "failed", "interrupted"];
const FIGURES = ["beam_on", "duty", "pulses", "amplitude", "period", "spread", "latency"];
/** Sessions that are over have a report; one that was never started has nothing. */
const OVER = new Set(["ended", "stopped", "failed", "interrupted"]);

export function sessionsRoom({ root, ended }) {
  const list = part("div", "");
  const search = typed("search");
  // A link from another room names what is searched for.
  search.value = decodeURIComponent(window.location.hash.split("/")[1] ?? "");
  let wanted = search.value === "" ? {} : { search: search.value };
  const show = (hasFigures) => rows(list, ended, wanted, hasFigures);
  const fields = [
    field(tr("office.search_sessions"), search, "search"),
    field(tr("office.state"), chosen([["", tr("office.any")], ...STATES.map((one) => [one, tr(`status.${one}`)])]), "status"),
    field(tr("office.since"), typed("date"), "since"),
    field(tr("office.to"), typed("date"), "until"),
  ];
  const bar = form(fields, tr("office.find"), (given) => { wanted = given; show(false); });
  bar.append(pushButton(tr("office.compare"), () => show(true)));
  root.append(section("", bar, list));
  show(false);
}

function rows(list, ended, { since, until, ...wanted }, hasFigures) {
  const shown = [];
  const names = hasFigures ? FIGURES : [];
  const columns = [...TEXTS.map((one) => ({ name: tr(`office.${one}`) })), ...names.map((one) => ({ name: tr(`office.${one}`), isNumber: true })), { name: tr("office.files") }];
  const row = (session) => {
    const places = Object.fromEntries(names.map((one) => [one, part("span", "")]));
    const isOver = OVER.has(session.status) && session.started_at !== null;
    if (isOver) shown.push({ id: session.id, places });
    const name = `${session.fraction_id}${session.fraction_number === null ? "" : ` (${session.fraction_number})`}`;
    return [
      session.patient_reference,
      session.plan_id,
      isOver ? link(name, `#session/${session.id}`) : name,
      timed(session.started_at),
      tr(`status.${session.status}`),
      session.signed_by.join(", ") || "–",
      ...Object.values(places),
      isOver ? files(session.id) : "",
    ];
  };
  const read = (cursor) => findSessions({ ...wanted, ...between(since, until), limit: LIMIT, ...(cursor === null ? {} : { cursor }) });
  pages(list, ended, columns, read, row, tr("office.no_sessions"), () => hasFigures && fill(shown, ended));
}

function files(id) {
  const made = part("span", "");
  const links = [["PDF", reportUrl(id, "pdf")], ["CSV", samplesUrl(id, "csv")], ["Parquet", samplesUrl(id, "parquet")]];
  made.append(...links.flatMap(([name, url], i) => [i === 0 ? "" : " · ", link(name, url, i > 0)]));
  return made;
}

/** Read the reports one after another: each is computed from the whole of its session's samples. */
async function fill(shown, ended) {
  for (const { id, places } of shown) {
    if (ended.aborted) return;
    if (places.beam_on.textContent !== "") continue;
    setText(places.beam_on, "…");
    try {
      const { figures } = await readReport(id);
      const texts = figured(figures);
      for (const name of FIGURES) setText(places[name], texts[name]);
    } catch (error) {
      setText(places.beam_on, error.message);
    }
  }
}

function figured({ beam_on_s: on, duty_percent: duty, pulses, amplitude, period_s: period, motion, latency }) {
  const whole = motion.find((one) => one.signal === "whole");
  return {
    beam_on: `${fixed(on, 1)} s`,
    duty: duty === null ? "–" : `${fixed(duty, 0)} %`,
    pulses: String(pulses),
    amplitude: amplitude === null ? "–" : fixed(amplitude.median, 2),
    period: period === null ? "–" : `${fixed(period.median, 2)} s`,
    spread: whole === undefined ? "–" : `±${fixed(whole.within_95_mm, 2)} mm`,
    latency: latency.p99_ms === null ? "–" : `${fixed(latency.p99_ms, 0)} ms`,
  };
}
