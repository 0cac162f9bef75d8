/** The audit log: who did what, filtered; whether its chain is intact; and the whole of it to take away. */

import { auditExportUrl, readAudit, verifyAudit } from "../api.js";
import { part } from "../drawing/elements.js";
import { reason, sentence } from "../words/audit_rows.js";
import { tr } from "../words/words.js";
import { between, chosen, field, filled, form, link, pages, section, timed, typed } from "./parts.js";

const OUTCOMES = ["done", "requested", "refused", "failed"];
const LIMIT = 50;

export function auditRoom({ root, ended }) {
  const list = part("div", "");
  const chain = part("div", "");
  const outcomes = [["", tr("office.any")], ...OUTCOMES.map((one) => [one, tr(`office.outcome.${one}`)])];
  const fields = [
    field(tr("office.actor"), typed("text"), "actor"),
    field(tr("office.action"), typed("text"), "action"),
    field(tr("office.outcome"), chosen(outcomes), "outcome"),
    field(tr("office.since"), typed("date"), "since"),
    field(tr("office.to"), typed("date"), "until"),
  ];
  const show = (wanted) => rows(list, ended, wanted);
  const verify = part("button", tr("office.verify"));
  verify.type = "button";
  verify.addEventListener("click", () => filled(chain, ended, verified, result));
  const away = part("div", "", "row");
  away.append(verify, link(tr("office.export"), auditExportUrl, true));
  root.append(section(tr("office.chain"), away, chain), section(tr("office.rows"), form(fields, tr("office.filter"), show), list));
  show({});
}

function rows(list, ended, { since, until, ...wanted }) {
  const columns = ["number", "time", "actor", "outcome", "what"].map((name) => ({ name: tr(`office.${name}`), isNumber: name === "number", isLong: name === "what" }));
  const read = (cursor) => readAudit({ ...wanted, ...between(since, until), limit: LIMIT, ...(cursor === null ? {} : { cursor }) });
  const row = (one) => [String(one.sequence), timed(one.at), one.actor, tr(`office.outcome.${one.outcome}`), rowText(one)];
  pages(list, ended, columns, read, row, tr("office.no_rows"));
}

/** What happened, with the whole row for those who ask for it. */
function rowText(entry) {
  const made = part("details", "");
  made.append(part("summary", [sentence(entry), reason(entry)].filter(Boolean).join(": ")), part("p", `${entry.action} ${JSON.stringify(entry.detail)}`, "note"));
  return made;
}

/** Verify from the first row to the last, one call after another. */
async function verified() {
  let rowsSoFar = 0;
  let answer = await verifyAudit(null);
  for (;;) {
    rowsSoFar += answer.rows;
    if (!answer.is_intact || answer.is_complete) return { ...answer, rows: rowsSoFar };
    answer = await verifyAudit(answer.checked_to);
  }
}

function result(answer) {
  if (answer.is_intact) return part("p", tr("office.intact", { rows: answer.rows, hash: answer.head_hash.slice(0, 12) }), "good");
  return part("p", tr("office.broken", { row: answer.first_broken_sequence ?? "?", detail: answer.detail }), "bad");
}
