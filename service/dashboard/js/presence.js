/**
 * Tells the controller, every second, that the person who armed still looks at this page: their silence may hold the beam.
 *
 * Only the page they armed at speaks for them, under the name they armed with, while it is in view.
 */

import { notePresence } from "./api.js";

const ARMED_KEY = "tidegate.armed";
const PERIOD_MS = 1000;

export function rememberArming(sessionId, operator) {
  sessionStorage.setItem(ARMED_KEY, JSON.stringify({ sessionId, operator }));
}

export class Presence {
  constructor() {
    this.nextMs = 0;
    this.isBusy = false;
  }

  /** @param {?object} sample the fresh sample of a running session, or null */
  async tend(sample, operatorName, nowMs) {
    const armed = armedHere();
    const isTheirs = sample?.is_armed === true && armed?.sessionId === sample.session_id && armed.operator === operatorName;
    if (!isTheirs || document.hidden || this.isBusy || nowMs < this.nextMs) return;
    this.isBusy = true;
    this.nextMs = nowMs + PERIOD_MS;
    try {
      await notePresence(armed.sessionId, armed.operator);
    } catch {
      // Not heard: the controller holds the beam if that lasts, and the page says so as for any other hold.
    } finally {
      this.isBusy = false;
    }
  }
}

function armedHere() {
  try {
    return JSON.parse(sessionStorage.getItem(ARMED_KEY));
  } catch {
    return null;
  }
}
