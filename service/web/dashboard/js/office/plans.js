/** Plans: import a treatment planning system's file, and see where each plan's fractions stand. */

import { importPlan, listPlans } from "../api.js";
import { part } from "../drawing/elements.js";
import { localTime } from "../drawing/local_time.js";
import { tr } from "../words/words.js";
import { field, filled, form, link, section, table, typed } from "./parts.js";

const COLUMNS = ["patient", "plan", "technique", "next_fraction", "last_session", "imported"];

export function plansRoom({ root, person, ended }) {
  const list = part("div", "");
  const outcome = part("p", "", "note");
  outcome.setAttribute("role", "status");
  const show = (search) => filled(list, ended, () => listPlans(search), ({ items }) => shown(items));
  if (person.permissions.includes("plans.write")) {
    const file = typed("file");
    file.accept = ".dcm,application/dicom";
    file.required = true;
    const importing = form([field(tr("office.plan_file"), file, "file")], tr("office.import"), async (given, button) => {
      button.disabled = true;
      try {
        const plan = await importPlan(given.file);
        Object.assign(outcome, { className: "good", textContent: tr("office.imported_plan", { label: plan.label, patient: plan.patient_reference }) });
        show("");
      } catch (error) {
        Object.assign(outcome, { className: "bad", textContent: error.message });
      }
      button.disabled = false;
    });
    root.append(section(tr("office.import_plan"), importing, outcome));
  }
  root.append(section(tr("office.plans"), form([field(tr("office.search"), typed("search"), "search")], tr("office.find"), ({ search }) => show(search ?? "")), list));
  show("");
}

function shown(items) {
  if (items.length === 0) return part("p", tr("office.no_plans"), "note");
  const columns = COLUMNS.map((one) => ({ name: tr(`office.${one}`) }));
  return table(columns, items.map((one) => [
    one.patient_reference,
    link(one.label, `#sessions/${encodeURIComponent(one.patient_reference)}`),
    tr(`office.gating.${one.gating}`),
    `${one.next_fraction}${one.fractions_planned === null ? "" : ` / ${one.fractions_planned}`}`,
    one.last_session === null ? "–" : link(`${localTime(one.last_session.started_at)} · ${tr(`status.${one.last_session.status}`)}`, `#session/${one.last_session.id}`),
    `${localTime(one.created_at)} · ${one.imported_by}`,
  ]));
}
