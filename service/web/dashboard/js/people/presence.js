/**
 * Reports the presence of the operator who armed, every second; if the reports stop, the controller may hold the beam.
 *
 * Only the page they armed at reports, under the name they armed with, while it is visible.
 */

import { notePresence } from "../api.js";

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
      // A lost report: if it persists, the controller holds the beam, and the page shows that hold.
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
