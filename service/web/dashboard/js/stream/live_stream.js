/**
 * The live stream: one WebSocket, reconnected with back-off, and the age of its newest message.
 *
 * Times are performance.now() [ms]: monotonic, so a set clock cannot make an old message look fresh.
 */

import { learnSentences, tr } from "../words/words.js";

export const SCHEMA = "tidegate.live/1";
/** A frame older than this is stale [ms], so that the page is grey within 300 ms of it: what is old is noticed with the next drawing. */
export const STALE_MS = 260;
/** Silence in which a latched fault is still shown [ms]: the beam was held, and only a named person ends a fault. */
export const FAULT_MS = 1500;
/** Limit for idle messages [ms], which come only twice a second. */
export const IDLE_STALE_MS = 1500;
/** Silence after which an open socket is closed, because it may be half open [ms]. */
const GIVE_UP_MS = 5000;
const FIRST_RETRY_MS = 250;
const LAST_RETRY_MS = 5000;
/** Messages that hold news, of the live stream; the others (pings, gaps) are ignored. */
const NEWS = new Set(["sample", "idle"]);
const NO_ALARMS = { active: [], ageMs: () => 0 };

export class LiveStream {
  /**
   * @param {(message: object) => void} onMessage called for every valid sample and idle message
   * @param {() => void} onEnd called when a connection ended, perhaps because the log-in ended
   * @param {string} schema version of the stream's messages
   * @param {Set<string>} news types of messages that hold news
   */
  constructor(url, onMessage, onEnd, schema = SCHEMA, news = NEWS) {
    this.url = url;
    this.schema = schema;
    this.news = news;
    this.onMessage = onMessage;
    this.onEnd = onEnd;
    this.isWanted = false;
    this.message = null;
    this.problem = "";
    this.hasConnectedOnce = false;
    this.lastNewsMs = null;
    this.retryMs = FIRST_RETRY_MS;
    this.retryAtMs = null;
    this.socket = null;
    this.hello = null;
    this.alarmMessage = null;
    this.alarmsArrivedMs = 0;
    this.arrivedMs = 0;
    this.lagMs = 0;
  }

  /** Connect, and discard all earlier messages. */
  connect() {
    this.#forget();
    this.isWanted = true;
    this.retryAtMs = null;
    this.connectedAtMs = performance.now();
    const socket = new WebSocket(this.url);
    this.socket = socket;
    socket.addEventListener("message", (event) => {
      if (socket === this.socket) this.#receive(event.data);
    });
    socket.addEventListener("close", () => {
      if (socket !== this.socket) return;
      this.#retryLater();
      this.onEnd();
    });
  }

  /** Disconnect and discard all messages, after a log-out. */
  stop() {
    const { socket } = this;
    this.#forget();
    this.isWanted = false;
    this.socket = null;
    this.retryAtMs = null;
    this.lastNewsMs = null;
    this.hasConnectedOnce = false;
    this.retryMs = FIRST_RETRY_MS;
    socket?.close();
  }

  /** Age of the newest message's content [ms], or null when there is none. */
  ageMs(nowMs) {
    if (this.message === null) return null;
    return this.#sentAgeMs() + (nowMs - this.arrivedMs);
  }

  /** Time since the newest message arrived [ms]. */
  silenceMs(nowMs) {
    return this.message === null ? null : this.lagMs + (nowMs - this.arrivedMs);
  }

  /** Reconnect when it is due, and close a silent socket; call it often. */
  tend(nowMs) {
    if (!this.isWanted) return;
    if (this.retryAtMs !== null && nowMs >= this.retryAtMs) this.connect();
    else if (this.retryAtMs === null && this.#quietMs(nowMs) > GIVE_UP_MS) {
      const socket = this.socket;
      this.#retryLater();
      socket.close();
    }
  }

  /** The active alarms as last received; null without a connection. */
  alarms(nowMs) {
    if (this.alarmMessage === null) return this.hello === null ? null : NO_ALARMS;
    const { active, sent_at: sentAt } = this.alarmMessage;
    const elapsedMs = nowMs - this.alarmsArrivedMs;
    return { active, ageMs: (since) => Date.parse(sentAt) - Date.parse(since) + elapsedMs };
  }

  #quietMs(nowMs) {
    // A persistent lag means queued old messages: only a new socket removes them.
    return this.message === null ? nowMs - this.connectedAtMs : this.silenceMs(nowMs);
  }

  #sentAgeMs() {
    const age = this.message.age_ms;
    return (Number.isFinite(age) ? Math.max(0, age) : 0) + this.lagMs;
  }

  #forget() {
    this.message = null;
    this.hello = null;
    this.alarmMessage = null;
    this.leastDelayMs = Infinity;
    this.lagMs = 0;
  }

  #retryLater() {
    this.#forget();
    this.socket = null;
    this.retryAtMs = performance.now() + this.retryMs * (0.75 + Math.random() / 2);
    this.retryMs = Math.min(this.retryMs * 2, LAST_RETRY_MS);
  }

  #receive(text) {
    const message = parse(text);
    if (message === null) return;
    if (message.type === "hello") {
      this.hello = message;
      this.problem = message.schema === this.schema ? "" : tr("live_stream.the_controller_speaks_this_page_reload_the_p", { schema: message.schema, schema2: this.schema });
      return;
    }
    for (const one of [message, ...(message.active ?? [])]) learnSentences(one.sentences);
    if (this.problem === "" && message.type === "alarms") {
      this.alarmMessage = message;
      this.alarmsArrivedMs = performance.now();
      return;
    }
    if (this.problem !== "" || !this.news.has(message.type)) return;
    const nowMs = performance.now();
    this.#measureLag(message.sent_at, nowMs);
    this.message = message;
    this.arrivedMs = nowMs;
    this.lastNewsMs = nowMs;
    this.hasConnectedOnce = true;
    this.retryMs = FIRST_RETRY_MS;
    this.onMessage(message, nowMs);
  }

  /**
   * Estimate the lag of messages that queue in buffers between controller and page. The offset of the two clocks is taken
   * from the fastest message of this connection; any additional delay is lag.
   */
  #measureLag(sentAt, nowMs) {
    const sentMs = Date.parse(sentAt);
    if (!Number.isFinite(sentMs)) return;
    const delayMs = performance.timeOrigin + nowMs - sentMs;
    this.leastDelayMs = Math.min(this.leastDelayMs, delayMs);
    this.lagMs = delayMs - this.leastDelayMs;
  }
}

function parse(text) {
  try {
    const message = JSON.parse(text);
    return typeof message === "object" && message !== null ? message : null;
  } catch {
    return null;
  }
}
