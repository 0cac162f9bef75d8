/** What the controller asks for each thing the page can do: only to offer what will be allowed. The controller decides. */

export const NEEDS = {
  watch: "sessions.read",
  create: "sessions.run",
  start: "sessions.run",
  reference: "sessions.run",
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
};

export const ROLES = ["viewer", "therapist", "physicist", "admin"];

/** What an API key can be allowed; never to acknowledge a fault or to manage people. */
export const KEY_SCOPES = [
  "sessions.read", "sessions.run", "gate.arm", "gate.hold", "models.write", "calibrations.read", "calibrations.write",
  "plans.write", "qa.read", "qa.run", "qa.baseline", "audit.read", "metrics.read",
];

/** @returns {boolean} whether this person may do this; nobody may do anything */
export function may(person, action) {
  return person !== null && person.permissions.includes(NEEDS[action]);
}

/** @returns {string} why this person may not do this, or nothing */
export function obstacle(person, action) {
  if (person === null) return "log in";
  return may(person, action) ? "" : `your log-in (${person.roles.join(", ") || "no role"}) does not allow it`;
}
