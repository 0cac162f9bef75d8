/** The events panel: the newest rows of the session's audit log as sentences, one a pulse; a click shows the trace at that time. */

import { listAudit } from "../api.js";
import { part, setText } from "../drawing/elements.js";
import { fixed } from "../drawing/numbers.js";
import { reason, sentence, stateAfter } from "../words/audit_rows.js";
import { tr } from "../words/words.js";

/** The actor of events that the system itself caused. */
const SYSTEM = "tidegate";
/** The reason of a hold that ends a pulse as it should. */
const PASSED = "outside_window";
const SHOWN = 40;
const PERIOD_MS = 2000;
/** The audit log is written after the gate's decision: delay before reading it after a change [ms]. */
const SOON_MS = 400;

export class EventList {
  /** @param {(atMs: number) => void} onChoose called with the time of the event that a person chose */
  constructor(list, empty, onChoose) {
    Object.assign(this, { list, empty, onChoose });
    list.addEventListener("click", (event) => {
      event.preventDefault();
      this.#choose(event.target.closest("li"));
    });
    list.addEventListener("keydown", (event) => this.#step(event));
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
    const shown = entries.filter((entry) => entry.outcome !== "requested" && stateAfter(entry) !== "dwell");
    this.list.replaceChildren(...byPulse(shown).map(row));
    this.#sayEmpty(entries.length > 0 ? "" : tr("events.no_events_yet"));
  }

  #choose(item) {
    const atMs = Date.parse(item?.dataset.at ?? "");
    if (Number.isFinite(atMs)) this.onChoose(atMs);
  }

  /** The list is one stop of Tab; within it the arrow keys go from event to event. */
  #step(event) {
    const way = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (way === undefined) return;
    event.preventDefault();
    const links = [...this.list.querySelectorAll("a")];
    const at = links.indexOf(document.activeElement);
    links[Math.max(0, Math.min(links.length - 1, at + way))]?.focus();
  }

  #sayEmpty(text) {
    setText(this.empty, text);
    this.empty.hidden = text === "";
  }
}

/** Join a beam on with the end of the window's passage that follows it, the newest first: one line a pulse. */
function byPulse(entries) {
  const lines = [];
  for (let i = 0; i < entries.length; i += 1) {
    const [entry, before] = [entries[i], entries[i + 1]];
    const isPulse = stateAfter(entry) === "hold" && entry.detail.reason === PASSED && before !== undefined && stateAfter(before) === "beam_on";
    const seconds = isPulse ? (Date.parse(entry.at) - Date.parse(before.at)) / 1000 : NaN;
    if (Number.isFinite(seconds) && seconds >= 0) {
      lines.push({ entry: before, seconds, end: entry });
      i += 1;
    } else lines.push({ entry, seconds: null, end: null });
  }
  return lines;
}

/** One line: when and what happened, why or by whom. */
function row({ entry, seconds, end }) {
  const item = document.createElement("li");
  item.dataset.outcome = entry.outcome;
  item.dataset.state = stateAfter(entry) ?? "";
  item.dataset.at = entry.at;
  const time = part("a", clock(entry.at));
  Object.assign(time, { href: "#trace-frame", tabIndex: -1, title: tr("event.look") });
  const what = seconds === null ? sentence(entry) : tr("event.pulse", { seconds: fixed(seconds, 1) });
  item.append(time, part("strong", what), part("span", [reason(end ?? entry), by(entry)].filter(Boolean).join(" · ")));
  return item;
}

function by(entry) {
  return entry.actor === SYSTEM ? "" : tr("event.by", { actor: entry.actor });
}

function clock(at) {
  const time = new Date(at);
  return Number.isNaN(time.getTime()) ? "" : time.toLocaleTimeString("en-GB");
}
