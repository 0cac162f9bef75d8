/** The patient's position against the plan's: six figures with their tolerance, and the signature of a person. */

import { setText } from "../drawing/elements.js";
import { signed } from "../drawing/numbers.js";

const SHORT = { lateral: "Lat", longitudinal: "Long", vertical: "Vert", pitch: "Pitch", roll: "Roll", yaw: "Yaw" };
const DIRECTIONS = {
  lateral: "positive to the patient's left",
  longitudinal: "positive to the head",
  vertical: "positive towards the camera",
  pitch: "about the lateral axis",
  roll: "about the longitudinal axis",
  yaw: "about the vertical axis",
};

/** Why a session cannot be armed as long as its position is not signed; empty if it can. */
export function positionObstacle(check) {
  if (!check || check.status === "first_fraction" || check.status === "signed" || check.status === "no_reference") return "";
  return check.status === "lapsed" ? "set the reference again, and sign the position" : "sign the position first";
}

/** Why the position cannot be signed now; empty if it can. */
export function signObstacle(check, reason) {
  if (check?.status === "lapsed") return "the patient may have moved: set the reference again";
  if (check?.status !== "unsigned") return "nothing is to be signed";
  return check.is_within || reason !== "" ? "" : "beyond the tolerance or not determined: give a reason";
}

/**
 * Show the position of the reference in use, or of the proposed one while none is set.
 *
 * @param {?object} check the session's position check
 * @param {?object} proposal the position that would become the reference
 * @param {string} name the person who is logged in
 */
export function renderPosition(check, proposal, name) {
  const panel = document.getElementById("position");
  panel.hidden = !check || check.status === "first_fraction";
  if (panel.hidden) return;
  const isProposed = check.status === "no_reference" || check.status === "lapsed";
  const degrees = isProposed ? (proposal?.position ?? []) : check.degrees;
  panel.dataset.status = check.status;
  setText(document.getElementById("position-text"), textOf(check, isProposed && degrees.length > 0));
  const list = document.getElementById("position-degrees");
  list.hidden = degrees.length === 0;
  if (list.children.length !== degrees.length) list.replaceChildren(...degrees.map(cell));
  degrees.forEach((one, index) => fill(list.children[index], one));
  const button = document.getElementById("do-sign");
  button.hidden = check.status === "signed";
  setText(button, name === "" ? "Sign position" : `Sign position as ${name}`);
}

function textOf(check, isProposed) {
  if (check.status === "signed") return `Position signed by ${check.signed_by}${check.reason === "" ? "" : `: ${check.reason}`}`;
  if (check.status === "unsigned") return check.is_within ? "Position within tolerance of the plan's" : `Position not within tolerance: ${check.shortcomings.join(", ")}`;
  const present = isProposed ? " Proposed:" : "";
  return check.status === "lapsed" ? `Position to be taken again: ${check.lapse}.${present}` : `Position against the plan's: set the reference.${present}`;
}

function cell() {
  const part = document.createElement("div");
  part.append(document.createElement("dt"), document.createElement("dd"));
  return part;
}

function fill(part, one) {
  const unit = one.unit === "deg" ? "°" : "";
  part.dataset.within = one.is_within ? "yes" : "no";
  setText(part.firstChild, SHORT[one.name]);
  setText(part.lastChild, one.value === null ? "?" : `${signed(one.value, 1)}${unit}${one.is_within ? " ✓" : " ✗"}`);
  const limit = `tolerance ${one.tolerance} ${one.unit}`;
  const known = one.uncertainty === null ? "not known" : `uncertainty ${one.uncertainty.toFixed(1)} ${one.unit}`;
  part.title = `${one.name}, ${DIRECTIONS[one.name]}: ${one.value === null ? "not determined by the surface" : `${signed(one.value, 2)} ${one.unit}`}; ${known}, ${limit}`;
}
