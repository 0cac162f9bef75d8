/** The permission of each action of the page, for enabling buttons; the controller checks every call. */

import { tr } from "../words/words.js";

export const NEEDS = {
  watch: "sessions.read",
  create: "sessions.run",
  start: "sessions.run",
  window: "sessions.run",
  reference: "gate.reference",
  sign: "gate.reference",
  arm: "gate.arm",
  release: "gate.arm",
  correct: "gate.arm",
  hold: "gate.hold",
  disarm: "gate.hold",
  stop: "gate.hold",
  acknowledge: "gate.acknowledge",
  retrain: "models.write",
  apply: "models.write",
  upload: "calibrations.write",
  events: "audit.read",
  people: "users.manage",
  coach: "coach.manage",
};

/** The names of roles, in words. */
export const rolesText = (roles) => roles.map((role) => tr(`role.${role}`)).join(", ");

export const ROLES = ["viewer", "therapist", "physicist", "admin"];

/** Permissions that an API key may have; never the reference, acknowledging faults, starting QA, people or patient screens. */
export const KEY_SCOPES = [
  "sessions.read", "sessions.run", "gate.arm", "gate.hold", "models.write", "calibrations.read", "calibrations.write",
  "plans.write", "qa.read", "qa.baseline", "audit.read", "metrics.read", "coach.watch",
];

/** @returns {boolean} whether the person may do this; false without a person */
export function may(person, action) {
  return person !== null && person.permissions.includes(NEEDS[action]);
}

/** @returns {string} why the person may not do this, or an empty string */
export function obstacle(person, action) {
  if (person === null) return tr("permissions.log_in");
  return may(person, action) ? "" : tr("permissions.your_log_in_does_not_allow_it", { value: rolesText(person.roles) || tr("permissions.no_role") });
}
