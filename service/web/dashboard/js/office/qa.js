/** QA: what is due, a daily run, the runs with their reports, each check over time with its limits, and the baseline. */

import { cancelQaRun, listCalibrations, listQaChecks, listQaRuns, listRecordings, qaReportUrl, readQaBaseline, readQaLatency, readQaRun, readQaStatus, readQaTrend, startQaRun } from "../api.js";
import { part, said, setText } from "../drawing/elements.js";
import { localTime } from "../drawing/local_time.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";
import { chosen, field, filled, form, link, pages, section, table, typed, verdict } from "./parts.js";
import { trendPicture } from "./trend.js";

const ASK_MS = 1000;
const LIMIT = 20;
const TREND_RUNS = 200;
const HOUR_MS = 3_600_000;
const CAMERA = "camera";
const KINDS = ["daily", "monthly", "annual"];

export function qaRoom({ root, person, ended }) {
  const due = part("div", "");
  const runs = part("div", "");
  const list = () => {
    filled(due, ended, readQaStatus, status);
    pages(runs, ended, ["kind", "time", "verdict", "person", "files"].map((one) => ({ name: tr(`office.${one}`) })), (cursor) => listQaRuns(LIMIT, cursor), runRow, tr("office.no_runs"));
  };
  root.append(section(tr("office.due"), due));
  if (person.permissions.includes("qa.run")) root.append(startSection(person, ended, list));
  root.append(section(tr("office.runs"), runs), trendSection(ended), latencySection(ended), baselineSection(ended));
  list();
}

function status(found) {
  const lines = [];
  if (found.refusal !== null) lines.push(part("p", said(found.refusal), "bad"));
  const { daily } = found.newest;
  if (found.required_daily_h === 0) lines.push(part("p", tr("office.not_required"), "note"));
  else if (daily !== null) lines.push(part("p", tr("office.due_at", { at: localTime(new Date(Date.parse(daily.created_at) + HOUR_MS * found.required_daily_h).toISOString()) }), found.is_arming_allowed ? "good" : "bad"));
  return lines.length > 0 ? lines : part("p", tr("qa.never"), "look");
}

function runRow(run) {
  return [
    tr(`qa.${run.kind}`),
    localTime(run.created_at),
    run.verdict === null ? tr(`qa.verdict.${run.status}`) : verdict(run.verdict),
    `${run.operator}${run.is_simulated ? ` · ${tr("office.simulated")}` : ""}`,
    run.status === "finished" ? link(tr("qa.report"), qaReportUrl(run.id)) : "",
  ];
}

/** A run: daily with the plate; monthly and annual with the phantom as well, whose trace is a file in a recording folder. */
function startSection(person, ended, done) {
  const place = part("div", "");
  filled(place, ended, () => Promise.all([listCalibrations(), listRecordings()]), ([calibrations, recordings]) => {
    const progress = part("div", "");
    progress.setAttribute("role", "status");
    const safe = typed("checkbox");
    const kind = chosen(KINDS.map((one) => [one, tr(`qa.${one}`)]));
    const seen = () => chosen([[CAMERA, tr("office.the_camera")], ...recordings.items.map((one) => [one.path, one.path])]);
    const phantom = part("fieldset", "");
    phantom.append(
      part("legend", tr("office.phantom")),
      field(tr("office.phantom_seen_by"), seen(), "phantom"),
      field(tr("office.phantom_trace"), typed("text", 200), "trace"),
      field(tr("office.window_from"), number(), "lower"),
      field(tr("office.window_to"), number(), "upper"),
    );
    const asks = () => { phantom.hidden = kind.value === "daily"; phantom.disabled = phantom.hidden; };
    kind.addEventListener("change", asks);
    asks();
    const fields = [
      field(tr("office.kind"), kind, "kind"),
      field(tr("office.calibration"), chosen(calibrations.items.map((one) => [one.id, `${one.camera} · ${localTime(one.created_at)}`])), "calibration_id"),
      field(tr("office.plate_seen_by"), seen(), "source"),
      phantom,
      field(tr("office.code"), typed("text", 20), "code"),
      field(tr("office.remark"), typed("text", 200), "note"),
      field(tr("office.beam_is_safe"), safe, "safe"),
    ];
    const starting = form(fields, tr("office.start_run"), async (given, button) => {
      button.disabled = true;
      try {
        await follow(await startQaRun(request(person, given, safe.checked)), progress, ended);
        done();
      } catch (error) {
        progress.replaceChildren(part("p", error.message, "bad"));
      }
      button.disabled = false;
    });
    return [part("p", tr("office.run_warning"), "look"), starting, progress];
  });
  return section(tr("office.new_run"), place);
}

function number() {
  return Object.assign(typed("number"), { step: 0.1, min: -100, max: 100, required: true });
}

const sourceOf = (chosenSource) => (chosenSource === CAMERA ? { kind: "device" } : { kind: "recording", path: chosenSource });

function request(person, { kind, calibration_id: calibration, source, phantom, trace, lower, upper, code, note }, isSafe) {
  const moved = kind === "daily" ? {} : { phantom: { source: sourceOf(phantom), trace, window_lower_mm: Number(lower), window_upper_mm: Number(upper) } };
  return {
    kind, operator: person.name, is_beam_safe: isSafe, plate: { source: sourceOf(source) }, ...moved,
    ...(calibration === undefined ? {} : { calibration_id: calibration }), ...(code === undefined ? {} : { code }), ...(note === undefined ? {} : { note }),
  };
}

/** Show the progress of a run until it ends; it goes on by itself where this page is left. */
async function follow(run, place, ended) {
  const bar = document.createElement("progress");
  const stage = part("span", "");
  const cancel = part("button", tr("page.cancel"));
  cancel.type = "button";
  cancel.addEventListener("click", () => cancelQaRun(run.id).catch((error) => setText(stage, error.message)));
  place.replaceChildren(bar, " ", stage, " ", cancel);
  let now = await readQaRun(run.id);
  while (now.status === "running" && !ended.aborted) {
    const { progress } = now;
    if (progress?.total) Object.assign(bar, { max: progress.total, value: progress.done });
    else bar.removeAttribute("value");
    setText(stage, said(progress?.stage ?? ""));
    await new Promise((resolve) => { setTimeout(resolve, ASK_MS); });
    now = await readQaRun(run.id);
  }
  if (!ended.aborted) place.replaceChildren(now.verdict === null ? part("p", `${tr(`qa.verdict.${now.status}`)} ${now.status_detail}`, "bad") : verdict(now.verdict), results(now.results));
}

function results(found) {
  const columns = [["check"], ["value", true], ["expected", true], ["warn_at", true], ["fail_at", true], ["verdict"]].map(([name, isNumber]) => ({ name: tr(`office.${name}`), isNumber }));
  return table(columns, found.map((one) => [said(one.title), valued(one.value, one.unit), valued(one.expected, one.unit), valued(one.warn, one.unit), valued(one.fail, one.unit), verdict(one.verdict)]));
}

const valued = (value, unit) => (value === null ? "–" : `${fixed(value, Math.abs(value) < 10 ? 2 : 1)} ${unit}`);

function trendSection(ended) {
  const place = part("div", "");
  const picture = part("div", "");
  filled(place, ended, listQaChecks, ({ items }) => {
    const choice = chosen(items.map((one) => [one.code, one.title]));
    choice.lang = "en";
    const show = () => filled(picture, ended, () => readQaTrend(choice.value, TREND_RUNS), (trend) => (trend.items.length === 0 ? part("p", tr("office.no_runs"), "note") : trendPicture(trend)));
    choice.addEventListener("change", show);
    show();
    return [field(tr("office.check"), choice, "check"), picture];
  });
  return section(tr("office.trend"), place);
}

function latencySection(ended) {
  const place = part("div", "");
  const columns = [["camera"], ["time"], ["median", true], ["p95", true], ["counted", true], ["verdict"]].map(([name, isNumber]) => ({ name: tr(`office.${name}`), isNumber }));
  filled(place, ended, readQaLatency, ({ items }) => (items.length === 0
    ? part("p", tr("office.no_latency"), "note")
    : table(columns, items.map((one) => [`${one.camera.name} ${one.camera.serial}`, localTime(one.at), `${fixed(one.median_ms, 0)} ms`, `${fixed(one.p95_ms, 0)} ms`, `${fixed(one.counted_ms, 0)} ms`, verdict(one.verdict)]))));
  return section(tr("office.camera_latency"), place);
}

function baselineSection(ended) {
  const place = part("div", "");
  const columns = ["number", "time", "person", "reason", "expected"].map((name) => ({ name: tr(`office.${name}`), isLong: name === "reason" || name === "expected" }));
  const row = (one) => [String(one.number), localTime(one.created_at), one.set_by, one.reason, Object.entries(one.expected).map(([name, value]) => `${name} ${fixed(value, 2)}`).join(", ")];
  filled(place, ended, readQaBaseline, (found) => (found.number === 0 ? part("p", tr("office.no_baseline"), "note") : table(columns, [found, ...found.earlier].map(row))));
  return section(tr("office.baseline"), place);
}
