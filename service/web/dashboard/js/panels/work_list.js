/** The work list: imported plans with the fraction that comes next, and the newest sessions; both are searched as one types. */

import { listPlans, listSessions } from "../api.js";
import { byId, part, pushButton, setText } from "../drawing/elements.js";
import { localTime } from "../drawing/local_time.js";
import { isOver } from "./summary.js";
import { tr } from "../words/words.js";

const SESSIONS = 12;
/** After the last key of a search [ms]. */
const PAUSE_MS = 250;

export class WorkList {
  /**
   * @param {{onPlan: (plan: object) => void, onSession: (session: object) => void, onAgain: (session: object) => void,
   *   onPlans: (plans: object[]) => void}} act what a row does: a plan to set up, a session to show or to take up, one whose
   *   values are entered again; and the plans that are offered
   */
  constructor(act) {
    Object.assign(this, { act, search: byId("work-search"), timer: 0, asked: 0, shown: {} });
    this.search.addEventListener("input", () => {
      clearTimeout(this.timer);
      this.timer = setTimeout(() => this.refresh(), PAUSE_MS);
    });
  }

  /** Remove all names and patients. */
  forget() {
    this.asked += 1;
    this.search.value = "";
    this.shown = {};
    byId("plan-list").replaceChildren();
    byId("session-list").replaceChildren();
  }

  /** Read both lists again; an answer that a later search has overtaken is dropped. */
  async refresh() {
    const asked = (this.asked += 1);
    const wanted = this.search.value.trim();
    const [plans, sessions] = await Promise.allSettled([listPlans(wanted), listSessions(SESSIONS, wanted)]);
    if (asked !== this.asked) return;
    this.#show("plan", plans, (plan) => this.#plan(plan), wanted === "" ? "" : tr("work.no_plan_found"));
    this.#show("session", sessions, (session) => this.#session(session), wanted === "" ? tr("setup.no_session_yet_create_the_first_one_here") : tr("work.no_session_found"));
    // A search narrows the list, not what the form offers.
    if (plans.status === "fulfilled" && wanted === "") this.act.onPlans(plans.value.items);
  }

  #show(name, { value, reason }, row, none) {
    const items = value?.items ?? [];
    const text = JSON.stringify(items);
    // Rows that are the same stay: a click that began on one would be lost with it.
    if (value !== undefined && text !== this.shown[name]) {
      this.shown[name] = text;
      byId(`${name}-list`).replaceChildren(...items.map(row));
    }
    const empty = byId(`${name}-empty`);
    setText(empty, reason?.message ?? (items.length > 0 ? "" : none));
    empty.hidden = empty.textContent === "";
  }

  #plan(plan) {
    const item = document.createElement("li");
    const { next_fraction: next, fractions_planned: planned, last_session: last } = plan;
    const isDone = planned !== null && next > planned;
    const fraction = isDone ? tr("work.all_done", { planned }) : planned === null ? tr("work.fraction", { next }) : tr("work.fraction_of", { next, planned });
    const before = last === null ? tr("work.never") : tr("work.last", { status: tr(`status.${last.status}`), at: localTime(last.started_at) });
    const button = pushButton(tr("work.set_up"), () => this.act.onPlan(plan));
    button.setAttribute("aria-label", tr("work.set_up_of", { patient_reference: plan.patient_reference, label: plan.label }));
    item.append(part("strong", plan.patient_reference), part("span", plan.label), part("b", fraction), part("small", `${before} · ${tr(`office.gating.${plan.gating}`)}`));
    if (!isDone) item.append(button);
    item.dataset.done = isDone ? "yes" : "no";
    item.dataset.last = last?.status ?? "";
    return item;
  }

  #session(session) {
    const item = document.createElement("li");
    const isPast = isOver(session);
    const choose = isPast ? Object.assign(part("a", ""), { href: `office/#session/${session.id}`, target: "_blank", rel: "noopener" }) : pushButton("", () => this.act.onSession(session));
    const status = part("em", tr(`status.${session.status}`));
    status.dataset.status = session.status;
    choose.append(part("strong", session.patient_reference), part("span", `${session.plan_id} · ${session.fraction_id}`), status);
    choose.append(part("time", localTime(session.started_at ?? session.created_at)));
    choose.className = isPast ? "open" : "";
    if (!isPast) choose.disabled = session.status !== "created";
    item.append(choose);
    if (session.status !== "created") item.append(this.#again(session));
    return item;
  }

  /** Offer a new session with an earlier one's values; its fraction is entered by hand. */
  #again(session) {
    const again = pushButton(tr("setup.new_as_in_this"), () => this.act.onAgain(session));
    again.className = "again";
    again.title = tr("setup.enter_the_values_of_for_a_new_fraction", { patient_reference: session.patient_reference, fraction_id: session.fraction_id });
    return again;
  }
}
