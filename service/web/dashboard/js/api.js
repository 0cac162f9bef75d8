/** All HTTP calls of the page. A problem (RFC 9457) becomes an ApiError whose message includes field and bound. */

import { said } from "./drawing/elements.js";
import { learnSentences, tr } from "./words/words.js";

const ROOT = "/api/v1";
const TIMEOUT_MS = 8000;
const PRESENCE_TIMEOUT_MS = 2000;

export class ApiError extends Error {
  constructor(status, problem) {
    learnSentences(problem.sentences);
    super(sentence(status, problem));
    this.name = "ApiError";
    this.status = status;
    this.code = problem.code ?? "";
    this.field = problem.field ?? "";
    /** Every field that was refused, with its value and bound. */
    this.errors = problem.errors ?? [];
    this.retryAfterS = null;
  }
}

/** Whether the call itself is a log-in, so that its 401 does not end the page's log-in. */
const isAboutLogIn = (path) => path.startsWith("/login") || path === "/me" || path === "/me/password" || path.startsWith("/coach/");
let onRefused = () => {};

/** @param {(status: number) => void} listener called for every 401 and 403: the log-in has ended or lost permissions */
export function onRefusal(listener) {
  onRefused = listener;
}

function sentence(status, problem) {
  const own = problem.detail || problem.title || "";
  const detail = own === "" || problem.code === "unreachable" ? own || tr("api.the_controller_answered", { status }) : said(own);
  const parts = [detail];
  if (problem.field && !detail.includes(problem.field)) parts.push(tr("api.field", { field: said(problem.field) }));
  if (problem.value && !detail.includes(problem.value)) parts.push(tr("api.given", { value: said(problem.value) }));
  if (problem.bound && !detail.includes(problem.bound)) parts.push(tr("api.must_be", { bound: said(problem.bound) }));
  return parts.join(" ");
}

async function call(method, path, body, headers = {}) {
  const response = await send(method, path, body, headers);
  const answer = await response.json().catch(() => null);
  if (!response.ok) throw withWait(new ApiError(response.status, answer ?? {}), response);
  return answer;
}

function withWait(error, response) {
  const seconds = Number(response.headers.get("Retry-After") ?? NaN);
  if (Number.isFinite(seconds)) error.retryAfterS = seconds;
  return error;
}

async function send(method, path, body, headers, timeoutMs = TIMEOUT_MS) {
  const request = { method, headers: { Accept: "application/json", ...headers }, signal: AbortSignal.timeout(timeoutMs), cache: "no-store" };
  if (body !== undefined) {
    request.body = typeof body === "string" || body instanceof Blob ? body : JSON.stringify(body);
    request.headers["Content-Type"] ??= "application/json";
  }
  try {
    const response = await fetch(ROOT + path, request);
    if ((response.status === 401 || response.status === 403) && !isAboutLogIn(path)) onRefused(response.status);
    return response;
  } catch (error) {
    const text = error.name === "TimeoutError" ? tr("api.the_controller_did_not_answer_in_time") : tr("api.the_controller_cannot_be_reached");
    throw new ApiError(0, { code: "unreachable", detail: text });
  }
}

/** A copy without the fields that are null: requests leave out what does not apply. */
export function withoutNulls(value) {
  if (Array.isArray(value)) return value.map(withoutNulls);
  if (value === null || typeof value !== "object") return value;
  return Object.fromEntries(Object.entries(value).filter(([, one]) => one !== null).map(([name, one]) => [name, withoutNulls(one)]));
}

const session = (id) => `/sessions/${encodeURIComponent(id)}`;
/** Return a new Idempotency-Key, so that a repeated submission does not create twice. */
const once = () => ({ "Idempotency-Key": crypto.randomUUID?.() ?? `${Date.now()}-${Math.random()}` });

const searched = (limit, search, cursor = null) => new URLSearchParams({ limit, ...(search === "" ? {} : { search }), ...(cursor === null ? {} : { cursor }) });
export const listSessions = (limit, search = "", cursor = null) => call("GET", `/sessions?${searched(limit, search, cursor)}`);
export const findSessions = (wanted) => call("GET", `/sessions?${new URLSearchParams(wanted)}`);
export const readSession = (id) => call("GET", session(id));
/** Id of the session that runs, for a page that has not seen one yet; an error where none does. */
export async function runningId() {
  const { items } = await listSessions(20);
  const found = items.find((one) => one.status === "running");
  if (found === undefined) throw new ApiError(409, { code: "session_state", detail: tr("controls.no_running_session") });
  return found.id;
}
export const createSession = (request) => call("POST", "/sessions", request, once());
export const listPlans = (search = "") => call("GET", `/plans?${searched(50, search)}`);
export const prepareSession = (planId, request) => call("POST", `/plans/${encodeURIComponent(planId)}/sessions`, request, once());
export const listRecordings = () => call("GET", "/recordings?limit=100");
const model = (id) => `/models/${encodeURIComponent(id)}`;
export const readModel = (id) => call("GET", model(id));
export const readSpectrum = (id) => call("GET", `${model(id)}/spectrum`);
export const readSimilarity = (id, other) => call("GET", `${model(id)}/similarity?${new URLSearchParams({ other })}`);
export const readQualityMaps = (id) => call("GET", `${model(id)}/quality-maps`);
export const listModels = (id, limit) => call("GET", `${session(id)}/models?limit=${limit}`);
export const listCalibrations = () => call("GET", "/calibrations?limit=100");
export const readQaStatus = () => call("GET", "/qa/status");
const SAMPLES_TIMEOUT_MS = 60_000;
export const readReport = (id) => call("GET", `${session(id)}/report`);
/** A part of a session's trace, in at most `points` ranges. @param {{from_s?: number, to_s?: number, points: number}} part */
export const readTrace = (id, part) => call("GET", `${session(id)}/trace?${new URLSearchParams(part)}`);
export const readSimulation = (id) => call("GET", `${session(id)}/simulation`);
/** Sign a session or a file as the simulation day. @param {object} request as the contract's SimulationRequest */
export const signSimulation = (id, request) => call("POST", `${session(id)}/simulation`, request);
export const readSent = () => call("GET", "/pacs");
export const sendReport = (id, operator, content) => call("POST", `${session(id)}/send`, { operator, content_sha256: content });
export const readMoment = (id, atS) => call("GET", `${session(id)}/moment?${new URLSearchParams({ at_s: atS.toFixed(3) })}`);
/** `content` is the hash of the report that the person looked at. */
export const noteReport = (id, operator, note, content) => call("POST", `${session(id)}/note`, { operator, note, content_sha256: content });
/** @param {string|null} password null of people of an identity provider */
export const signReport = (id, operator, { meaning, password, note, content }) =>
  call("POST", `${session(id)}/signature`, { operator, meaning, password, note, content_sha256: content });
export const reportUrl = (id, form) => `${ROOT}${session(id)}/report.${form}`;
export const samplesUrl = (id, form) => `${ROOT}${session(id)}/samples?format=${form}`;
export const dicomUrl = (id) => `${ROOT}${session(id)}/waveform.dcm`;
export const qaReportUrl = (id) => `${ROOT}/qa/runs/${encodeURIComponent(id)}/report.pdf`;
const qaRun = (id) => `/qa/runs/${encodeURIComponent(id)}`;
export const listQaRuns = (limit, cursor) => call("GET", `/qa/runs?${searched(limit, "", cursor)}`);
export const readQaRun = (id) => call("GET", qaRun(id));
export const startQaRun = (request) => call("POST", "/qa/runs", request, once());
export const cancelQaRun = (id) => call("POST", `${qaRun(id)}/cancel`, {});
export const listQaChecks = () => call("GET", "/qa/checks");
export const readQaTrend = (check, limit) => call("GET", `/qa/trend?${new URLSearchParams({ check, limit })}`);
export const readQaLatency = () => call("GET", "/qa/latency");
export const readQaBaseline = () => call("GET", "/qa/baseline");
/** A DICOM file as it is. */
export async function importPlan(file) {
  const response = await send("POST", "/plans", file, { "Content-Type": "application/dicom" }, SAMPLES_TIMEOUT_MS);
  const answer = await response.json().catch(() => null);
  if (!response.ok) throw new ApiError(response.status, answer ?? {});
  return answer;
}
export const readAudit = (wanted) => call("GET", `/audit?${new URLSearchParams(wanted)}`);
/** `after` is the last row that is verified already; null for the beginning. */
export const verifyAudit = (after) => call("GET", `/audit/verify${after === null ? "" : `?after=${after}`}`);
export const auditExportUrl = `${ROOT}/audit/export`;
export const contractUrl = `${ROOT}/openapi.json`;
export const readContract = () => call("GET", "/openapi.json");
export const readMachine = () => call("GET", "/machine");
export const listDevices = () => call("GET", "/devices");
export const listAudit = (id, limit) => call("GET", `/audit?session_id=${encodeURIComponent(id)}&limit=${limit}`);

export const readMe = () => call("GET", "/me");
export const logIn = (request) => call("POST", "/login", request);
export const logOut = () => call("POST", "/logout", {});
export const readLogInWays = () => call("GET", "/login/ways");
/** URL that redirects to the hospital's identity provider. */
export const OIDC_URL = `${ROOT}/login/oidc`;
export const changePassword = (oldPassword, newPassword) =>
  call("POST", "/me/password", { old_password: oldPassword, new_password: newPassword });

const person = (name) => `/users/${encodeURIComponent(name)}`;
export const listPeople = () => call("GET", "/users");
export const addPerson = (request) => call("POST", "/users", request);
export const changePerson = (name, changes) => call("PATCH", person(name), changes);
export const listLogIns = (name) => call("GET", `${person(name)}/logins`);
export const endLogIn = (name, id) => call("POST", `${person(name)}/logins/${encodeURIComponent(id)}/end`, {});
export const listKeys = () => call("GET", "/keys");
export const createKey = (request) => call("POST", "/keys", request);
export const revokeKey = (id) => call("POST", `/keys/${encodeURIComponent(id)}/revoke`, {});

/** Hold, disarm and stop are sent without an operator: the controller uses the log-in, so no other name can make it refuse. */
const HALTS = new Set(["hold", "disarm", "stop"]);
/**
 * `action` is one of start, disarm, hold, release, acknowledge, stop. `operator` is the person the page
 * shows as logged in; if another person has logged in with the same browser, the controller refuses.
 */
export const act = (id, action, operator) => call("POST", `${session(id)}/${action}`, HALTS.has(action) ? {} : { operator });
/** `numbers` are those of the alarms that the person was shown. */
export const acknowledgeAlarms = (id, operator, numbers) => call("POST", `${session(id)}/acknowledge`, { operator, alarms: numbers });
/** `shown` is what the person was shown: level and movement of couch or camera, where there are any. */
export const setReference = (id, operator, at, shown, reason, isSetUp) =>
  call("POST", `${session(id)}/reference`, { operator, at, reason, ...(isSetUp ? { setup_confirmed: true } : {}), ...shown });
/** `number` is that of the reference whose position the person was shown. */
export const signPosition = (id, operator, number, reason) =>
  call("POST", `${session(id)}/position-check`, { operator, reference_number: number, reason });
/**
 * `head` is the side of the picture at which the page shows the patient's head, which the person confirms by arming; null if
 * unknown. `etag` and `state` are those of the summary the person looked at: refused if anything was decided since, or if the
 * engine would arm with another window, reference or model.
 */
export const arm = (id, operator, head, etag, state, reason) =>
  call("POST", `${session(id)}/arm`, { operator, state, ...(reason === "" ? {} : { reason }), ...(head === null ? {} : { head_direction: head }) }, { "If-Match": etag });
/** `name` and `password` are the second person's; empty where that person is the one who is logged in here. */
export const countersign = (id, operator, state, name, password) =>
  call("POST", `${session(id)}/countersign`, { operator, state, ...(name === "" ? {} : { name, password }) });
/** @returns {Promise<{answer: object, etag: string}>} what would be armed, and its ETag */
export async function readArming(id) {
  const response = await send("GET", `${session(id)}/arming`, undefined, {});
  const answer = await response.json().catch(() => null);
  if (!response.ok) throw new ApiError(response.status, answer ?? {});
  learnSentences(answer?.sentences);
  return { answer, etag: response.headers.get("ETag") };
}
/** `reason` may be empty; beyond the budget from the fraction's first armed window it may not. */
export const setWindow = (id, operator, window, reason) => call("POST", `${session(id)}/window`, { operator, window, ...(reason === "" ? {} : { reason }) });
export const retrain = (id, operator, keepsReference) =>
  call("POST", `${session(id)}/models/retrain`, { operator, keeps_reference: keepsReference });
/** `unit` is mm or l; `by` and `drift` are the displayed values that the person confirms; `reason` may be empty. */
export const correctBaseline = (id, operator, unit, by, drift, reason) =>
  call("POST", `${session(id)}/baseline-correction`, { operator, [`by_${unit}`]: by, [`drift_${unit}`]: drift, ...(reason === "" ? {} : { reason }) });
/** Report that a person who may arm is at this page, with a short time-out. */
export const notePresence = (id, operator) => send("POST", `${session(id)}/presence`, { operator }, {}, PRESENCE_TIMEOUT_MS);
export const applyModel = (id, operator) => call("POST", `${session(id)}/models/apply`, { operator });

export function uploadCalibration(text, operator) {
  return call("POST", `/calibrations?operator=${encodeURIComponent(operator)}`, text, once());
}

/** @returns {Promise<?{blob: Blob, frameIndex: number}>} the newest colour frame, or null when there is none */
export async function fetchPicture(id) {
  const response = await send("GET", `${session(id)}/picture`, undefined, { Accept: "image/jpeg" });
  if (!response.ok) return null;
  return { blob: await response.blob(), frameIndex: Number(response.headers.get("X-Frame-Index") ?? NaN) };
}

// The patient screen
export const readWatcher = () => call("GET", "/coach/me");
export const pairScreen = (code) => call("POST", "/coach/pair", { code });
export const openPairingCode = () => call("POST", "/coach/code", {});
export const listScreens = () => call("GET", "/coach/screens");
export const endScreen = (id) => call("POST", `/coach/screens/${encodeURIComponent(id)}/end`, {});
export const readCoaching = (id) => call("GET", `${session(id)}/coaching`);
export const setCoaching = (id, operator, settings) => call("PUT", `${session(id)}/coaching`, { operator, ...settings });
