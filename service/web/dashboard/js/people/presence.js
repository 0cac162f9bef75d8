/**
 * Reports every second that a person who may arm is at this page; if the reports stop, the controller holds the beam.
 *
 * Only a visible page reports. While a person's gate is armed, only the page they armed or released it at, under their
 * name; while no gate is armed, or a program armed it, the page of everybody who may arm. A page in the distance
 * view may be on a wall of an empty room: it reports only if a person armed the gate from that page.
 */

import { notePresence } from "../api.js";

const ARMED_KEY = "tidegate.armed";
const PERIOD_MS = 1000;

/** Names of programs have a colon, those of people never. */
const isProgram = (name) => name?.includes(":") ?? false;

export function rememberArming(sessionId, operator) {
  sessionStorage.setItem(ARMED_KEY, JSON.stringify({ sessionId, operator }));
}

/** Whether this person armed the gate at another page, so that this one does not speak for them. */
export function isArmedElsewhere(sample, operatorName) {
  return sample !== null && sample.is_armed && operatorName !== "" && sample.armed_by === operatorName && !isArmedHere(sample, operatorName);
}

export class Presence {
  constructor() {
    this.nextMs = 0;
    this.isBusy = false;
  }

  /**
   * @param {?object} sample the fresh sample of a running session, or null
   * @param {string} operatorName the person who is logged in and may arm; empty if there is none
   * @param {boolean} isDistant whether the page is drawn to be seen from afar
   */
  async tend(sample, operatorName, nowMs, isDistant) {
    if (sample === null || operatorName === "" || !counts(sample, operatorName, isDistant)) return;
    if (document.hidden || this.isBusy || nowMs < this.nextMs) return;
    this.isBusy = true;
    this.nextMs = nowMs + PERIOD_MS;
    try {
      await notePresence(sample.session_id, operatorName);
    } catch {
      // A lost report: if it persists, the controller holds the beam, and the page shows that hold.
    } finally {
      this.isBusy = false;
    }
  }
}

/** Whether this page's presence means something to the controller now. */
function counts(sample, operatorName, isDistant) {
  if (!sample.is_armed || isProgram(sample.armed_by)) return !isDistant;
  return sample.armed_by === operatorName && isArmedHere(sample, operatorName);
}

function isArmedHere(sample, operatorName) {
  const armed = armedHere();
  return armed?.sessionId === sample.session_id && armed.operator === operatorName;
}

function armedHere() {
  try {
    return JSON.parse(sessionStorage.getItem(ARMED_KEY));
  } catch {
    return null;
  }
}
