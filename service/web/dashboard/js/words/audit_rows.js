/** Rows of the audit log as sentences. */

import { said } from "../drawing/elements.js";
import { has, tr } from "./words.js";

/** The gate's state after a transition; undefined for any other event. */
export function stateAfter(entry) {
  return entry.detail?.to_state ?? entry.detail?.to;
}

export function sentence(entry) {
  const to = stateAfter(entry);
  const key = typeof to === "string" ? `event.to.${to}` : `event.${entry.action}`;
  const words = has(key) ? tr(key) : String(to ?? entry.action).replaceAll(/[._]/g, " ");
  return entry.outcome === "done" ? words : `${words}: ${has(`event.outcome.${entry.outcome}`) ? tr(`event.outcome.${entry.outcome}`) : entry.outcome}`;
}

/** Why: the sentence of a code of the gate, else what the service says. */
export function reason(entry) {
  const detail = entry.detail ?? {};
  const why = detail.reason ?? detail.code ?? detail.detail ?? "";
  if (typeof why !== "string" || stateAfter(entry) === "beam_on") return "";
  return has(`hold.${why}.what`) ? tr(`hold.${why}.what`) : said(why.replaceAll("_", " "));
}
