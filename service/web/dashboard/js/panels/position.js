/** The patient's position against the plan's: six figures with their tolerance, and the signature of a person. */

import { said, setText } from "../drawing/elements.js";
import { fixed, signed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

const SHORT = { lateral: tr("position.lat"), longitudinal: tr("position.long"), vertical: tr("position.vert"), pitch: tr("position.pitch"), roll: tr("position.roll"), yaw: tr("position.yaw") };
const DIRECTIONS = {
  lateral: tr("position.positive_to_the_patient_s_left"),
  longitudinal: tr("position.positive_to_the_head"),
  vertical: tr("position.positive_towards_the_camera"),
  pitch: tr("position.about_the_lateral_axis"),
  roll: tr("position.about_the_longitudinal_axis"),
  yaw: tr("position.about_the_vertical_axis"),
};

/** Why a session cannot be armed as long as its position is not signed; empty if it can. */
export function positionObstacle(check) {
  if (!check || check.status === "first_fraction" || check.status === "signed" || check.status === "no_reference") return "";
  return check.status === "lapsed" ? tr("position.set_the_reference_again_and_sign_the_positio") : tr("position.sign_the_position_first");
}

/** Why the position cannot be signed now; empty if it can. */
export function signObstacle(check, reason) {
  if (check?.status === "lapsed") return tr("position.the_patient_may_have_moved_set_the_reference");
  if (check?.status !== "unsigned") return tr("position.nothing_is_to_be_signed");
  return check.is_within || reason !== "" ? "" : tr("position.beyond_the_tolerance_or_not_determined_give");
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
  setText(button, name === "" ? tr("position.sign_position") : tr("position.sign_position_as", { name }));
}

function textOf(check, isProposed) {
  if (check.status === "signed") return tr("position.position_signed_by", { signed_by: check.signed_by, value: check.reason === "" ? "" : `: ${check.reason}` });
  if (check.status === "unsigned") return check.is_within ? tr("position.position_within_tolerance_of_the_plan_s") : tr("position.position_not_within_tolerance", { value: said(check.shortcomings.join(", ")) });
  const present = isProposed ? tr("position.proposed") : "";
  return check.status === "lapsed" ? tr("position.position_to_be_taken_again", { lapse: said(check.lapse), present }) : tr("position.position_against_the_plan_s_set_the_referenc", { present });
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
  const limit = tr("position.tolerance", { value: fixed(one.tolerance, 1), unit: one.unit });
  const known = one.uncertainty === null ? tr("position.not_known") : tr("position.uncertainty", { value: fixed(one.uncertainty, 1), unit: one.unit });
  part.title = `${one.name}, ${DIRECTIONS[one.name]}: ${one.value === null ? tr("position.not_determined_by_the_surface") : `${signed(one.value, 2)} ${one.unit}`}; ${known}, ${limit}`;
}
