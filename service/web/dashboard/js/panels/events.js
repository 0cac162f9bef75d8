/** The events panel: the newest rows of the session's audit log, with actor and reason. */

import { listAudit } from "../api.js";
import { has, tr } from "../words/words.js";

/** The actor of events that the system itself caused. */
const SYSTEM = "tidegate";
const SHOWN = 40;
const PERIOD_MS = 2000;
/** The audit log is written after the gate's decision: delay before reading it after a change [ms]. */
const SOON_MS = 400;

export class EventList {
  constructor(list, empty) {
    this.list = list;
    this.empty = empty;
    this.sessionId = null;
    this.nextMs = 0;
    this.isBusy = false;
    this.newest = "";
  }

  follow(sessionId) {
    if (sessionId === this.sessionId) return;
    this.sessionId = sessionId;
    this.newest = "";
    this.list.replaceChildren();
    this.#sayEmpty(tr("events.no_events_yet"));
    this.nextMs = 0;
  }

  /** Show why the list is empty. */
  tell(text) {
    if (this.list.childElementCount === 0) this.#sayEmpty(text);
  }

  /** Refresh soon, after a change. */
  hurry(nowMs) {
    this.nextMs = Math.min(this.nextMs, nowMs + SOON_MS);
  }

  async tend(nowMs) {
    if (this.sessionId === null || this.isBusy || document.hidden || nowMs < this.nextMs) return;
    this.isBusy = true;
    this.nextMs = nowMs + PERIOD_MS;
    const sessionId = this.sessionId;
    try {
      const page = await listAudit(sessionId, SHOWN);
      if (sessionId === this.sessionId) this.#show(page.items);
    } catch (error) {
      if (this.list.childElementCount === 0) this.#sayEmpty(error.message);
    } finally {
      this.isBusy = false;
    }
  }

  #show(entries) {
    const newest = entries.length > 0 ? `${entries[0].sequence} ${entries.length}` : "";
    if (newest === this.newest) return;
    this.newest = newest;
    // A request and its effect are shown as one event, and the dwell before the beam as none; the log has a row for each.
    this.list.replaceChildren(...entries.filter((entry) => entry.outcome !== "requested" && stateAfter(entry) !== "dwell").map(row));
    this.#sayEmpty(entries.length > 0 ? "" : tr("events.no_events_yet"));
  }

  #sayEmpty(text) {
    this.empty.textContent = text;
    this.empty.hidden = text === "";
  }
}

/** One line: what happened, why or by whom. */
function row(entry) {
  const item = document.createElement("li");
  item.dataset.outcome = entry.outcome;
  item.dataset.state = stateAfter(entry) ?? "";
  item.append(part("time", clock(entry.at)), part("strong", sentence(entry)), part("span", [reason(entry), by(entry)].filter(Boolean).join(" · ")));
  return item;
}

/** The gate's state after a transition; undefined for any other event. */
function stateAfter(entry) {
  return entry.detail?.to_state ?? entry.detail?.to;
}

function sentence(entry) {
  const to = stateAfter(entry);
  const key = typeof to === "string" ? `event.to.${to}` : `event.${entry.action}`;
  const words = has(key) ? tr(key) : String(to ?? entry.action).replaceAll(/[._]/g, " ");
  return entry.outcome === "done" ? words : `${words}: ${has(`event.outcome.${entry.outcome}`) ? tr(`event.outcome.${entry.outcome}`) : entry.outcome}`;
}

/** Why: the sentence of a code of the gate, else what the service says. */
function reason(entry) {
  const detail = entry.detail ?? {};
  const why = detail.reason ?? detail.code ?? detail.detail ?? "";
  if (typeof why !== "string" || stateAfter(entry) === "beam_on") return "";
  return has(`hold.${why}.what`) ? tr(`hold.${why}.what`) : why.replaceAll("_", " ");
}

function by(entry) {
  return entry.actor === SYSTEM ? "" : tr("event.by", { actor: entry.actor });
}

function clock(at) {
  const time = new Date(at);
  return Number.isNaN(time.getTime()) ? "" : time.toLocaleTimeString("en-GB");
}

function part(name, text) {
  const element = document.createElement(name);
  element.textContent = text;
  return element;
}
