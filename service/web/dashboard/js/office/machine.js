/** The machine: whether a session can run, versions, disk, certificate, and the settings in force with their source. */

import { readMachine } from "../api.js";
import { part, said } from "../drawing/elements.js";
import { localTime } from "../drawing/local_time.js";
import { tr } from "../words/words.js";
import { filled, section, table } from "./parts.js";

const HOUR_MS = 3_600_000;

export function machineRoom({ root, ended }) {
  const place = part("div", "");
  root.append(place);
  filled(place, ended, readMachine, (machine) => [state(machine), facts(machine), settings(machine.settings)]);
}

function state({ readiness }) {
  const list = part("ul", "");
  const lines = [...readiness.reasons.map((one) => ["bad", one]), ...readiness.warnings.map((one) => ["look", one])];
  list.append(...lines.map(([kind, one]) => part("li", said(one.detail), kind)));
  const word = readiness.is_ready ? part("p", tr("office.ready"), "good") : part("p", tr("office.not_ready"), "bad");
  return section(tr("office.state"), word, list);
}

function facts(machine) {
  const list = part("dl", "");
  const rows = [
    ["version", `${machine.version} · ${tr("office.method", { number: machine.method })}`],
    ["system", `${machine.system} · Python ${machine.python}`],
    ["runs_since", `${localTime(machine.started_at)} (${tr("office.hours", { hours: Math.floor((Date.parse(machine.now) - Date.parse(machine.started_at)) / HOUR_MS) })})`],
    ["clock", localTime(machine.now)],
    ["disk", tr("office.free", { free: gigabytes(machine.disk_free_mb), total: gigabytes(machine.disk_total_mb) })],
    ["backup", machine.backup_at === null ? tr("office.no_backup") : `${localTime(machine.backup_at)} (${tr("office.hours", { hours: Math.floor((Date.parse(machine.now) - Date.parse(machine.backup_at)) / HOUR_MS) })})`],
    ["certificate", machine.certificate_ends_at === null ? tr("office.no_certificate") : tr("office.until", { at: localTime(machine.certificate_ends_at) })],
  ];
  for (const one of machine.plug_ins) rows.push(["plug_in", one]);
  for (const [name, text] of rows) list.append(part("dt", tr(`office.${name}`)), part("dd", text));
  return section(tr("office.facts"), list);
}

const gigabytes = (mb) => (mb / 1024).toFixed(1);

/** Those that are not the default first: they are what this site decided. */
function settings(all) {
  const columns = ["setting", "value", "source"].map((one) => ({ name: tr(`office.${one}`), isLong: one === "value" }));
  const rows = (some) => some.map((one) => [one.name, one.value, one.source]);
  const own = all.filter((one) => one.source !== "default");
  const rest = part("details", "");
  rest.append(part("summary", tr("office.defaults", { count: all.length - own.length })), table(columns, rows(all.filter((one) => one.source === "default"))));
  return section(tr("office.settings"), own.length === 0 ? part("p", tr("office.all_default"), "note") : table(columns, rows(own)), rest);
}
