/**
 * The active alarms, the most urgent first: priority, text, time since, who acknowledged.
 *
 * The controller sends the whole list with every change, so the page holds no list of its own. Acknowledging ends a latched
 * alarm, and marks any other as seen until its cause is gone. The gate's own fault has its button below the gate.
 */

import { acknowledgeAlarms } from "../api.js";
import { part, said, setText } from "../drawing/elements.js";
import { adviceFor, whatIs } from "../words/reasons.js";
import { tr } from "../words/words.js";

/** Marks of IEC 60601-1-8: readable without colour. */
const MARKS = { high: "!!!", medium: "!!", low: "!" };
/** Only alarms that have been shown for this time are acknowledged by a click [ms]. */
const SEEN_MS = 700;

export class AlarmPanel {
  /** @param {import("./controls.js").Controls} controls shows the result of an acknowledgement */
  constructor(root, controls) {
    this.root = root;
    this.controls = controls;
    this.list = root.querySelector("ol");
    this.button = root.querySelector("button");
    this.note = root.querySelector("p");
    this.rows = new Map();
    this.open = [];
    this.button.addEventListener("click", () => this.#acknowledge());
  }

  /**
   * @param {?{active: object[], ageMs: (since: string) => number}} alarms as last received; null if the present ones are unknown
   * @param {boolean} isFault whether the gate has latched a fault
   */
  render(alarms, isFault, nowMs) {
    const active = alarms?.active ?? [];
    this.root.hidden = active.length === 0;
    for (const number of [...this.rows.keys()]) if (!active.some((one) => one.number === number)) this.#remove(number);
    active.forEach((alarm, place) => this.#show(alarm, place, alarms.ageMs(alarm.since), nowMs));
    this.open = active.filter((one) => one.acknowledged_by === null && !(one.latches && isFault));
    const why = this.controls.forbids("acknowledge");
    // While everything is latched, the fault's own button is the only one.
    this.button.hidden = this.open.length === 0;
    this.button.disabled = why !== "";
    this.button.title = why === "" ? "" : tr("alarms.not_now", { why });
    setText(this.note, isFault && active.some((one) => one.latches) ? tr("alarms.latched_acknowledge_the_fault") : "");
  }

  #show(alarm, place, ageMs, nowMs) {
    let row = this.rows.get(alarm.number);
    if (row === undefined) {
      row = makeRow(alarm, nowMs);
      this.rows.set(alarm.number, row);
    }
    if (this.list.children[place] !== row.item) this.list.insertBefore(row.item, this.list.children[place] ?? null);
    row.item.dataset.acknowledged = alarm.acknowledged_by === null ? "no" : "yes";
    setText(row.age, duration(ageMs));
    setText(row.who, [said(alarm.detail), alarm.acknowledged_by === null ? "" : tr("alarms.seen_by", { acknowledged_by: alarm.acknowledged_by })].filter(Boolean).join(" · "));
  }

  #remove(number) {
    this.rows.get(number).item.remove();
    this.rows.delete(number);
  }

  #acknowledge() {
    const nowMs = performance.now();
    const seen = this.open.filter((one) => nowMs - this.rows.get(one.number).shownMs >= SEEN_MS);
    if (seen.length === 0) return;
    const numbers = seen.map((one) => one.number);
    this.controls.run("alarms", () => acknowledgeAlarms(seen[0].session_id, this.controls.operatorName, numbers));
  }
}

function makeRow(alarm, nowMs) {
  const item = document.createElement("li");
  item.dataset.priority = alarm.priority;
  item.dataset.code = alarm.code;
  const mark = part("b", MARKS[alarm.priority] ?? "!!!");
  mark.title = alarm.priority in MARKS ? tr(`alarm.${alarm.priority}`) : String(alarm.priority);
  const age = part("time", "");
  const who = part("span", "");
  item.append(mark, part("strong", whatIs(alarm.code, alarm.text)), age, who);
  const { toDo, call } = adviceFor(alarm.code);
  item.title = `${toDo} ${call}`;
  return { item, age, who, shownMs: nowMs };
}

/** "0:07", "12:40", "1:02:03" */
function duration(ms) {
  const seconds = Math.max(0, Math.floor(ms / 1000));
  const two = (value) => String(value).padStart(2, "0");
  const hours = Math.floor(seconds / 3600);
  const minutes = Math.floor(seconds / 60) % 60;
  return hours > 0 ? `${hours}:${two(minutes)}:${two(seconds % 60)}` : `${minutes}:${two(seconds % 60)}`;
}

/** The text of a high-priority alarm that the gate itself does not show; empty if there is none. */
export function urgentText(alarms, holdReason) {
  const urgent = (alarms?.active ?? []).find((one) => one.priority === "high" && one.code !== holdReason);
  return urgent === undefined ? "" : tr("alarm.interlock", { text: whatIs(urgent.code, urgent.text) });
}
