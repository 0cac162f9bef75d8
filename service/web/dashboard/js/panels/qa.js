/** QA: the newest run of each kind with its report, and a badge while overdue QA prevents arming. */

import { qaReportUrl, readQaStatus } from "../api.js";
import { part, said, setText } from "../drawing/elements.js";
import { tr } from "../words/words.js";

const ASK_MS = 20_000;
const KINDS = ["daily", "monthly", "annual"];

const byId = (id) => document.getElementById(id);

export class QaPanel {
  constructor() {
    this.list = byId("qa-list");
    this.badge = byId("badge-qa");
    this.nextMs = 0;
  }

  /** Refresh periodically, and at once when the panel opens. */
  tend(nowMs) {
    if (document.hidden || nowMs < this.nextMs) return;
    this.nextMs = nowMs + ASK_MS;
    this.refresh();
  }

  /** Clear the panel after a log-out. */
  forget() {
    this.list.replaceChildren();
    this.badge.hidden = true;
    setText(byId("qa-note"), "");
    this.nextMs = 0;
  }

  async refresh() {
    try {
      this.#show(await readQaStatus());
    } catch (error) {
      // An unknown status is not replaced by the last known one: an old verdict would mislead.
      this.list.replaceChildren();
      setText(byId("qa-note"), tr("qa.the_qa_status_is_unknown", { message: error.message }));
    }
  }

  #show(status) {
    this.list.replaceChildren(...KINDS.map((kind) => row(kind, status.newest[kind])));
    this.badge.hidden = status.is_arming_allowed;
    this.badge.title = status.refusal ? tr("qa.arming_is_refused", { refusal: said(status.refusal) }) : "";
    setText(this.badge, isFailed(status) ? tr("qa.qa_failed") : tr("qa.qa_due"));
    setText(byId("qa-note"), note(status));
  }
}

function isFailed(status) {
  return status.refusal !== null && KINDS.some((kind) => status.newest[kind]?.verdict === "fail");
}

function note(status) {
  if (!status.is_arming_allowed) return tr("qa.arming_is_refused", { refusal: said(status.refusal) });
  if (status.required_daily_h > 0) return tr("qa.arming_requires_a_passed_qa_within_the_last", { required_daily_h: status.required_daily_h });
  return "";
}

function row(kind, run) {
  const item = document.createElement("li");
  item.append(part("strong", tr(`qa.${kind}`)));
  if (run === null) {
    item.append(part("em", tr("qa.never")));
    return item;
  }
  const verdict = part("em", tr(`qa.verdict.${run.verdict ?? run.status}`));
  verdict.dataset.verdict = run.verdict ?? run.status;
  item.append(verdict, part("time", `${run.created_at.slice(0, 16).replace("T", " ")} UTC`));
  if (run.status === "finished") {
    const link = part("a", tr("qa.report"));
    link.href = qaReportUrl(run.id);
    link.target = "_blank";
    link.rel = "noopener";
    item.append(link);
  }
  return item;
}
