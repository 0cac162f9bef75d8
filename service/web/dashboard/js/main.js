/** Assembles the page: the stream feeds the panels, two timers redraw them so that old data is never shown as new. */

import "./words/document.js";
import { AlarmPanel, urgentText } from "./panels/alarms.js";
import { ArmingPanel } from "./panels/arming.js";
import { Access } from "./people/access.js";
import { listSessions, readArming, readSession } from "./api.js";
import { DataTables } from "./panels/data_tables.js";
import { SimulationPanel } from "./panels/simulation.js";
import { hideCovered } from "./drawing/covered.js";
import { BaselineButton } from "./panels/baseline_correction.js";
import { renderBreath } from "./panels/breath.js";
import { CoachPanel } from "./coach/panel.js";
import { ClickGuard } from "./panels/click_guard.js";
import { Controls } from "./panels/controls.js";
import { DistanceView } from "./panels/distance.js";
import { EventList } from "./panels/events.js";
import { renderBody, renderCalibration, renderCamera, renderFigures, renderLikeness, renderReference, renderSource } from "./panels/measurement.js";
import { said, setText } from "./drawing/elements.js";
import { GatePanel } from "./panels/gate.js";
import { GridPanel } from "./panels/motion_map.js";
import { needsReference, renderLearning } from "./panels/training.js";
import { renderLamps } from "./panels/lamps.js";
import { readHistory } from "./stream/history.js";
import { LiveStream } from "./stream/live_stream.js";
import { LogIn } from "./people/login.js";
import { ModelQuality } from "./panels/model_quality.js";
import { PicturePanel } from "./panels/picture.js";
import { rolesText } from "./people/permissions.js";
import { isArmedElsewhere, Presence, rememberArming } from "./people/presence.js";
import { QaPanel } from "./panels/qa.js";
import { Range } from "./drawing/color_scale.js";
import { KeyList } from "./panels/key_list.js";
import { Summary, isOver } from "./panels/summary.js";
import { Setup } from "./panels/setup.js";
import { MismatchWatch, present, presentLocked } from "./stream/gate_state.js";
import { SoundPanel } from "./sounds/sound_panel.js";
import { Steps } from "./panels/steps.js";
import { renderTreatment, timeText } from "./panels/treatment.js";
import { Trace } from "./panels/trace.js";
import { WindowEditor } from "./panels/window_editor.js";
import { describe as describeWindow, gatedUnit, gatedValue } from "./stream/gating_window.js";
import { fixed } from "./drawing/numbers.js";
import { tr } from "./words/words.js";

const TICK_MS = 50;
/** Redraw periods of pictures and numbers [ms]; the trace is drawn in every animation frame. */
const TRACE_MS = 40;
const PANEL_MS = 120;
/** How many of the newest sessions are looked at: those that were never started are no news. */
const LOOKED_AT = 5;
/** The service records a change of the gate a moment after it: delay before reading it [ms]. */
const SOON_MS = 400;
/** When the text of a new reference is read, and how often again [ms]: the service records it a moment after it is set. */
const LABEL_AFTER_MS = 1000;
const LABEL_MS = 15_000;
/** Period of looking for a running session [ms]. */
const LOOK_MS = 1500;
/** Period of reading what the stream does not contain, reference and patient match [ms]. */
const DESCRIBE_MS = 2000;
/** Time in which "Log out" accepts the second click while the gate is armed [ms]. */
const ASK_MS = 4000;

const byId = (id) => document.getElementById(id);
const liveUrl = new URL("/api/v1/live", window.location.href);
liveUrl.protocol = liveUrl.protocol === "https:" ? "wss:" : "ws:";

const access = new Access(() => followAccess());
const stream = new LiveStream(liveUrl, receive, () => access.ask());
const gate = new GatePanel(byId("gate"));
const trace = new Trace(byId("trace-frame"));
const picture = new PicturePanel(byId("picture"), byId("overlay"));
const grid = new GridPanel(byId("grid"), byId("legend"), byId("grid-readout"));
const events = new EventList(byId("events"), byId("events-empty"), (atMs) => trace.lookAt(atMs));
const controls = new Controls(() => lookAgain(), (id, head) => openArming(id, head), () => closeTopmost());
const arming = new ArmingPanel(byId("arming"), controls);
const windowEditor = new WindowEditor(byId("window-editor"), trace, controls);
const alarms = new AlarmPanel(byId("alarms"), controls);
const baseline = new BaselineButton(byId("do-correct"), controls);
const presence = new Presence();
const tables = new DataTables(trace);
const simulation = new SimulationPanel(trace, windowEditor, access);
const quality = new ModelQuality();
const setup = new Setup(access, select);
const summary = new Summary(access, select, uncoverReport);
const keyList = new KeyList();
const logIn = new LogIn(access);
const qa = new QaPanel();
const coach = new CoachPanel(access);
const takeOver = byId("do-take-over");
const takeOverGuard = new ClickGuard([takeOver]);
const steps = new Steps(byId("steps"));
const sounds = new SoundPanel();
const distance = new DistanceView(byId("do-distance"));
const range = new Range();
const mismatch = new MismatchWatch();

/** The running or chosen session, as last read from the controller. */
let session = null;
let shownSessionId = null;
let lastGate = "";
/** The session whose history was fetched. */
let historyOf = null;
/** When this page saw the gate go to its present state [ms]; null where it was in it before. */
let beganMs = null;
let drawn = { trace: -Infinity, panels: -Infinity };
let hasLooked = false;
const LATE = new Set(["stale", "offline"]);
let laidOut = null;
let isSimulatedBeam = false;
let asking = 0;
let nextLookMs = 0;
let nextDescribeMs = 0;
/** Session and number of the reference that the trace names, and when its text is read next [ms]. */
let labelled = { key: null, nextMs: 0 };

/** Update the page after a log-in, a log-out or a change of permissions. */
function followAccess() {
  document.body.dataset.access = access.state;
  logIn.show();
  byId("person").hidden = access.person === null;
  setText(byId("person-name"), access.person?.name ?? "");
  setText(byId("person-roles"), rolesText(access.person?.roles ?? []));
  byId("do-account").title = access.person === null ? "" : tr("main.change_your_password", { name: access.person.name, value: rolesText(access.person.roles) });
  byId("technical").dataset.own = access.person?.roles.includes("physicist") ? "yes" : "no";
  byId("badge-glass").hidden = access.person?.is_break_glass !== true;
  if (access.may("watch")) watch();
  else leave();
  render();
}

function watch() {
  if (!stream.isWanted) stream.connect();
  setup.refresh();
}

/** Remove patient, session and beam state from the page after a log-out. */
function leave() {
  stream.stop();
  session = null;
  shownSessionId = null;
  lastGate = "";
  historyOf = null;
  beganMs = null;
  hasLooked = false;
  labelled = { key: null, nextMs: 0 };
  trace.reset(null);
  arming.close();
  windowEditor.close();
  picture.follow(null, false);
  setup.forget();
  summary.forget();
  keyList.close();
  tables.close();
  simulation.close();
  quality.follow(null);
  controls.forget();
  qa.forget();
}

/** Close the set-up over an interruption, and over the end of a session that ran here unless a person is typing there. */
function uncoverReport({ id }, isBroken) {
  if (isBroken || (id === shownSessionId && !byId("setup").contains(document.activeElement))) setup.show(false);
}

/** Close what lies on top of the page, for Esc. @returns {boolean} whether anything was open */
function closeTopmost() {
  if (sounds.close() || keyList.close() || arming.close() || windowEditor.close() || tables.close() || simulation.close() || quality.close()) return true;
  for (const [panel, hide] of [["coach", () => coach.show(false)], ["setup", () => setup.show(false)]]) {
    if (byId(panel) === null || byId(panel).hidden) continue;
    hide();
    return true;
  }
  return summary.close();
}

/** Remove what was measured in another session: nothing of one patient is shown under another's name. */
function forgetSession() {
  labelled = { key: null, nextMs: 0 };
  trace.reset(null);
  picture.follow(null, false);
  events.follow(null);
}

/** A log-out may hold the beam: while the gate is armed the first click asks for confirmation. */
async function logOut() {
  const button = byId("do-log-out");
  const asks = button.dataset.asks !== "yes" && stream.message?.is_armed === true;
  button.dataset.asks = asks ? "yes" : "no";
  setText(button, asks ? tr("main.confirm_may_hold") : tr("main.log_out"));
  clearTimeout(asking);
  if (asks) {
    asking = setTimeout(() => { button.dataset.asks = "no"; setText(button, tr("main.log_out")); }, ASK_MS);
    return;
  }
  try {
    await access.leave(stream.message?.is_armed === true && stream.message.armed_by === access.person?.name);
  } catch (error) {
    controls.say("failed", tr("main.log_out_you_are_still_logged_in", { message: error.message }));
  }
}

function receive(message, nowMs) {
  if (message.type !== "sample") return;
  trace.add(message, nowMs);
  fetchHistory(message);
  picture.add(message);
  const gateNow = `${message.gate} ${message.hold_reason}`;
  if (gateNow !== lastGate) {
    beganMs = lastGate === "" ? null : nowMs;
    events.hurry(nowMs);
    nextDescribeMs = Math.min(nextDescribeMs, nowMs + SOON_MS);
  }
  lastGate = gateNow;
}

/** Fetch what was recorded before this page was opened, once for each session. */
async function fetchHistory(message) {
  if (message.session_id === historyOf || message.state !== "measuring" || !access.may("events")) return;
  historyOf = message.session_id;
  const messages = await readHistory(liveUrl, message).catch(() => []);
  trace.putBefore(message.session_id, messages);
}

function select(chosen) {
  if (chosen.id !== shownSessionId) forgetSession();
  summary.forget();
  session = chosen;
  shownSessionId = chosen.id;
  controls.say("", tr("main.session_of_is_ready_start_it_when_the_patien", { patient_reference: chosen.patient_reference }));
}

/** Refresh after a call changed the session. */
async function lookAgain() {
  events.hurry(performance.now());
  if (shownSessionId !== null) await describe(shownSessionId);
  await Promise.all([setup.refresh(), access.may("watch") ? qa.refresh() : null]);
}

async function describe(id) {
  try {
    const answer = await readSession(id);
    if (id === shownSessionId) session = answer;
  } catch {
    // Keep the patient's data, drop values that may have changed. The gate depends on neither.
    if (id === shownSessionId && session !== null) session = { ...session, has_reference: null, likeness: null, gate: null, summary: null };
  }
}

/**
 * While no session runs: select a created session (perhaps just made by planning software), and follow the shown session to
 * its end. On the first call without a session, open the form to create one.
 */
async function lookForSession() {
  const isFirstLook = !hasLooked;
  hasLooked = true;
  let items;
  try {
    ({ items } = await listSessions(LOOKED_AT));
  } catch {
    return;
  }
  if (!access.may("watch")) return;
  const [newest] = items;
  if (newest?.status === "created" && newest.id !== shownSessionId) select(newest);
  else if (newest !== undefined && newest.id === shownSessionId) session = newest;
  const last = items.find((one) => one.started_at || one.status === "created");
  if (last !== undefined && isOver(last)) summary.open(last);
  if (last?.status === "interrupted" || last?.status === "failed") return;
  if (isFirstLook && session === null && access.may("create")) setup.show(true);
}

function follow(view, sample, nowMs) {
  document.body.dataset.armed = (sample ?? laidOut)?.is_armed ? "yes" : "no";
  if (sample !== null && sample.session_id !== shownSessionId) {
    if (shownSessionId !== null) forgetSession();
    shownSessionId = sample.session_id;
    session = null;
    nextDescribeMs = nowMs + DESCRIBE_MS;
    describe(shownSessionId);
  } else if (sample?.session_status === "running" && nowMs >= nextDescribeMs && !document.hidden) {
    nextDescribeMs = nowMs + DESCRIBE_MS;
    describe(shownSessionId);
  }
  // A session that runs replaces the one that is over.
  if (sample?.session_status === "running" && summary.id !== null) summary.forget();
  if (view.kind !== "idle") nextLookMs = 0;
  else if (nowMs >= nextLookMs) {
    nextLookMs = nowMs + LOOK_MS;
    lookForSession();
  }
  const id = sample?.session_id ?? (view.kind === "idle" ? null : picture.sessionId);
  picture.follow(id, view.isFresh);
  events.follow(shownSessionId);
  if (sample !== null) hasLooked = true;
  labelReference(sample?.session_status === "running" ? sample : null, nowMs);
}

/** Name the reference on the trace: how it was confirmed is in the summary before arming. */
async function labelReference(sample, nowMs) {
  const number = sample?.position_check?.reference_number ?? null;
  if (sample === null) return;
  const key = number === null ? null : `${sample.session_id} ${number}`;
  if (key !== labelled.key) {
    trace.referenceText = "";
    labelled = { key, nextMs: nowMs + LABEL_AFTER_MS };
  }
  if (key === null || nowMs < labelled.nextMs || document.hidden) return;
  labelled.nextMs = nowMs + LABEL_MS;
  try {
    const { answer } = await readArming(sample.session_id);
    const text = answer.items.find((one) => one.code === "reference" && one.state !== "missing")?.text ?? "";
    if (labelled.key === key) trace.referenceText = said(text.split(/, set by |; /)[0]);
  } catch {
    // It is read again.
  }
}

function renderWho(view) {
  setText(byId("room-name"), stream.hello?.room ?? byId("room-name").textContent);
  setText(byId("who-patient"), session?.patient_reference ?? "–");
  setText(byId("who-plan"), session?.plan_id ?? "–");
  setText(byId("who-fraction"), session ? fraction(session) : "–");
  setText(byId("who-status"), view.isFresh ? tr(`status.${stream.message?.session_status ?? session?.status ?? "none"}`) : tr("main.not_known"));
}

function fraction({ fraction_id: id, fraction_number: number }) {
  return number === null || number === undefined ? id : tr("main.fraction_no", { id, number });
}

/** The person who armed at another page answers for the gate at this one from now on. */
takeOver.addEventListener("click", (event) => {
  const sample = stream.message;
  if (takeOverGuard.refusal(event) === "" && isArmedElsewhere(sample, controls.operatorName)) rememberArming(sample.session_id, controls.operatorName);
});

/** Show what would be armed; the trace then has one band only. */
function openArming(id, head) {
  windowEditor.close();
  arming.open(id, head);
}

/** Update everything that can become stale; called by a timer and by every animation frame. */
function render() {
  const nowMs = performance.now();
  access.tend(nowMs);
  stream.tend(nowMs);
  const view = access.may("watch") ? present(stream, nowMs) : presentLocked(access);
  const isSample = view.isFresh && stream.message?.type === "sample";
  const sample = isSample ? stream.message : null;
  const activeAlarms = access.may("watch") ? stream.alarms(nowMs) : null;
  if (view.kind === "idle" && stream.message?.type === "idle" && session?.status === "created") {
    view.word = tr("main.ready");
    view.reason = tr("main.start_the_session_of_when_the_patient_lies_s", { patient_reference: session.patient_reference });
  }
  view.warning = mismatch.check(sample, nowMs) || urgentText(activeAlarms, sample?.hold_reason ?? null) || view.warning;
  if (view.kind === "disarmed" && needsReference(sample, session)) view.reason = `${view.reason.replace(/\.$/, "")}. ${tr("main.set_the_reference_before_arming")}`;
  const isElsewhere = view.isCurrent && sample?.hold_reason === "operator_lost" && isArmedElsewhere(sample, access.may("arm") ? controls.operatorName : "");
  if (isElsewhere) Object.assign(view, { toDo: tr("main.you_armed_at_another_page"), call: "" });
  takeOver.hidden = !isElsewhere;
  takeOverGuard.update(nowMs);
  gate.render(view, nowMs);
  // Drawn with the gate, not with the other numbers: the two must always agree.
  setText(byId("figure-line"), lineText(sample));
  renderLamps(sample);
  const running = sample?.session_status === "running" ? sample : null;
  // While the picture is late, what is shown keeps its place: that is laid out by the newest sample that was fresh.
  laidOut = running ?? (LATE.has(view.kind) ? laidOut : null);
  follow(view, sample, nowMs);
  controls.update({ kind: view.kind, sample: running, laidOut, selected: session, person: access.state === "in" ? access.person : null, isWindowEdited: windowEditor.isChanged });
  arming.update(view.isCurrent ? running : null, view.kind === "idle", nowMs);
  if (view.isCurrent) windowEditor.update(running, session, controls.forbids("window"), nowMs);
  else windowEditor.wait(controls.forbids("window"));
  setText(byId("gate-by"), armedText(sample));
  alarms.render(activeAlarms, view.kind === "fault", nowMs);
  sounds.update(view, running, activeAlarms, nowMs);
  baseline.update(view.isCurrent ? running : null);
  coach.tend(running, nowMs);
  presence.tend(running, access.may("arm") ? controls.operatorName : "", nowMs, distance.isShown);
  if (!access.may("events")) events.tell(access.state === "in" ? tr("main.not_shown_your_log_in_does_not_allow_it") : tr("main.no_events_yet"));
  else if (view.isFresh) events.tend(nowMs);
  if (access.may("watch")) qa.tend(nowMs);
  return { nowMs, view, sample };
}

function lineText(sample) {
  if (sample === null) return "–";
  return tr(sample.line_on === true ? "line.on" : "line.off");
}

/** Who armed the gate, or released a hold since, and when; the time comes with the session, a moment later. */
function armedText(sample) {
  if (!sample?.is_armed || !sample.armed_by) return "";
  const known = session?.id === sample.session_id && session.gate?.armed_by === sample.armed_by ? session.gate.armed_at : null;
  const at = known ? ` ${new Date(known).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" })}` : "";
  return tr("main.armed_by", { armed_by: sample.armed_by, at });
}

function draw() {
  const { nowMs, view, sample } = render();
  if (nowMs - drawn.trace >= TRACE_MS) {
    drawn.trace = nowMs;
    trace.draw(nowMs);
  }
  if (nowMs - drawn.panels >= PANEL_MS) {
    drawn.panels = nowMs;
    drawPanels(nowMs, view, view.isCurrent ? sample : null);
  }
  requestAnimationFrame(draw);
}

function drawPanels(nowMs, view, sample) {
  const rangeMm = range.update(sample?.regions_mm ?? [], nowMs);
  picture.draw(nowMs, rangeMm, view.isCurrent, session?.id === shownSessionId ? (session?.head_direction ?? null) : null);
  grid.draw(sample?.regions_mm ?? null, rangeMm, sample?.window, sample?.unseen_cells ?? []);
  isSimulatedBeam = sample?.is_simulated_beam ?? session?.is_simulated_beam ?? isSimulatedBeam;
  renderFigures(sample, isSimulatedBeam);
  renderTreatment(sample, session, serverMs(nowMs));
  setText(byId("gate-time"), timeText(sample, session, serverMs(nowMs), beganMs === null ? null : nowMs - beganMs));
  renderBreath(sample);
  renderCalibration(sample?.calibration ?? session?.calibration);
  renderSource(session?.source_warning);
  renderCamera(session?.camera);
  renderBody(sample?.body_warning ?? session?.body?.warning);
  renderLikeness(sample, session?.likeness);
  renderLearning(sample ?? laidOut, session, view.isFresh);
  steps.render({ may: access.may("create") && byId("report").hidden, isFresh: view.isFresh, sample, session, isWindowEdited: windowEditor.isChanged });
  renderWho(view);
  renderTraceValue(sample);
  tables.tend(sample, session, nowMs);
  simulation.tend(sample, session, nowMs);
  quality.follow(session?.status === "running" ? session.active_model_id ?? null : null);
  hideCovered(document.querySelector(".room"));
}

/** The service's time of day now [ms], from its newest message. */
function serverMs(nowMs) {
  return stream.message === null ? NaN : Date.parse(stream.message.sent_at) + stream.silenceMs(nowMs);
}

function renderTraceValue(sample) {
  const isGated = trace.choice === "gated";
  const unit = isGated && sample ? gatedUnit(sample.window) : "mm";
  const value = sample ? (isGated ? gatedValue(sample) : sample[`${trace.choice}_mm`]) : null;
  setText(byId("trace-value"), Number.isFinite(value) ? fixed(value, unit === "l" ? 2 : 1) : "–");
  setText(byId("trace-unit"), unit);
  renderReference(sample?.reference);
  setText(byId("trace-name"), sample && isGated ? [tr("main.gated_on", { window: describeWindow(sample.window, true) }), trace.referenceText].filter(Boolean).join(" · ") : "");
}

byId("trace-choice").addEventListener("change", (event) => {
  trace.choice = event.target.value;
});
document.addEventListener("visibilitychange", () => {
  // Another person may have logged in with this browser.
  if (!document.hidden && access.state === "in") access.ask();
  render();
});
byId("do-log-out").addEventListener("click", logOut);
byId("do-account").addEventListener("click", () => logIn.ask(logIn.panel.hidden));
picture.run();
setInterval(render, TICK_MS);
requestAnimationFrame(draw);
