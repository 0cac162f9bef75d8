/** What a hold, a fault or an alarm is, what to do and whom to call: a sentence each for each code of the controller. */

import { said } from "../drawing/elements.js";
import { has, LANGUAGE, tr } from "./words.js";

/** What the reason is; the controller's own sentence where this page does not know the code, and never nothing. */
export function whatIs(code, sentence) {
  if (has(`hold.${code}.what`)) return tr(`hold.${code}.what`);
  return said(sentence) || tr("reason.unknown", { code: String(code ?? "?").slice(0, 40) });
}

/** What to do, and whom to call, where anyone has to be; of an unknown code what is right for the worst one. */
export function adviceFor(code) {
  const key = has(`hold.${code}.do`) ? `hold.${code}` : "reason.unknown";
  return { toDo: tr(`${key}.do`), call: has(`${key}.call`) ? tr(`${key}.call`) : "" };
}

/** A reason in a few words, for lists and for the trace: its code in English, else its sentence. */
export function shortReason(code) {
  return LANGUAGE !== "en" && has(`hold.${code}.what`) ? tr(`hold.${code}.what`) : String(code).replaceAll("_", " ");
}
