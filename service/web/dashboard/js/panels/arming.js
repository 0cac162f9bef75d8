/**
 * What would be armed, looked at before it is: patient, plan, camera, reference, window and what is missing. One button
 * arms, and only what is shown: the controller refuses if anything was decided since the summary was read.
 */

import { arm, countersign, readArming } from "../api.js";
import { byId, part, said, setText } from "../drawing/elements.js";
import { rememberArming } from "../people/presence.js";
import { conditionsOf, hasEdges, signalName } from "../stream/gating_window.js";
import { ClickGuard } from "./click_guard.js";
import { TwoPresses } from "./two_presses.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

/** Time after which the summary is read again [ms]: a model that is fitted meanwhile has to be seen before it is armed. */
const READ_MS = 500;
/** Time after which the summary closes: what was looked at longer ago is looked at again [ms]. */
const CLOSE_MS = 60000;
const TITLES = {
  patient: tr("arming.patient"), plan: tr("arming.plan"), camera: tr("arming.camera"), head_direction: tr("arming.head"), view: tr("arming.view"), model: tr("arming.model"),
  reference: tr("arming.reference"), window: tr("arming.window"), position: tr("arming.position"), checks: tr("arming.checks"), countersignature: tr("arming.second_person"), site: "QA", gate: tr("arming.gate"),
};
/** What a person compares with the patient, whatever its state; of the rest each line that needs a look is shown too. */
const GROUPS = { who: ["plan", "countersignature"], what: ["window", "reference"], where: ["head_direction", "position"] };
const MARKS = { ok: "✓", attention: "!", missing: "✕" };
const WORDS = { ok: "", attention: tr("arming.look"), missing: tr("arming.missing") };

export class ArmingPanel {
  /** @param {object} controls runs the call and shows its result */
  constructor(root, controls) {
    this.root = root;
    this.controls = controls;
    this.button = byId("do-arm-now");
    this.reason = byId("arming-reason");
    this.countersigning = byId("countersign");
    this.guard = new ClickGuard([this.button]);
    this.presses = new TwoPresses(this.button, tr("arming.press_again_to_arm"));
    this.#forget();
    this.button.addEventListener("click", (event) => this.#press(event));
    byId("arming-close").addEventListener("click", () => this.close());
    // Typing a password takes time: the summary stays, and is read again every two seconds as before.
    this.countersigning.addEventListener("input", () => { this.openedMs = performance.now(); });
    this.countersigning.addEventListener("submit", (event) => { event.preventDefault(); this.#countersign(); });
  }

  get isOpen() {
    return !this.root.hidden;
  }

  open(sessionId, headDirection) {
    if (this.isOpen && this.id === sessionId) return;
    this.#forget();
    Object.assign(this, { id: sessionId, head: headDirection, openedMs: performance.now() });
    this.root.hidden = false;
    byId("arming-heading").focus();
    this.#read();
  }

  /** @returns {boolean} whether it was open */
  close() {
    const wasOpen = this.isOpen;
    this.root.hidden = true;
    this.#forget();
    return wasOpen;
  }

  /**
   * Close where another session runs, or this one is armed; a late picture disables. Call it whenever the page is drawn.
   *
   * @param {?object} sample null while the picture is late
   * @param {boolean} isOver whether no session runs, which is known
   */
  update(sample, isOver, nowMs) {
    if (!this.isOpen) return;
    if (isOver || (sample !== null && (sample.session_id !== this.id || sample.is_armed)) || nowMs - this.openedMs > CLOSE_MS) {
      this.close();
      return;
    }
    if (sample !== null && nowMs - this.readMs > READ_MS) this.#read();
    if (sample !== null) setText(byId("arming-edges"), edgesText(sample.window));
    // What was late is looked at again: another content for the guard.
    if (sample === null) this.lates += this.isLate ? 0 : 1;
    this.isLate = sample === null;
    // Seen once, a list stays so until another one is shown.
    this.isSeen ||= byId("arming-items").getBoundingClientRect().bottom <= byId("arming-foot").getBoundingClientRect().top + 1;
    const isIgnored = this.guard.update(nowMs, this.#looked);
    const obstacle = this.#obstacle();
    this.button.disabled = this.summary?.is_ready !== true || obstacle !== "" || this.controls.isBusy;
    if (isIgnored && !this.button.disabled) this.button.setAttribute("aria-disabled", "true");
    else this.button.removeAttribute("aria-disabled");
    const why = this.summary === null ? "" : this.summary.is_ready ? (isIgnored ? tr("arming.look_at_each_line_first") : "") : tr("arming.something_is_missing");
    setText(byId("arming-why"), this.trouble || obstacle || why);
  }

  /** What was looked at: the summary, and how often the picture was late since it was opened. */
  get #looked() {
    return `${this.lates} ${this.key}`;
  }

  /** Why this person may not arm what is shown yet, though it is complete; empty if they may. */
  #obstacle() {
    if (this.controls.isWindowEdited) return tr("controls.apply_the_window_or_cancel_it");
    if (this.isLate) return tr("arming.the_picture_is_late_look_again");
    if (!this.isSeen) return tr("arming.scroll_to_the_last_line");
    return this.summary?.needs_reason === true && this.reason.value.trim() === "" ? tr("arming.give_the_reason") : "";
  }

  #forget() {
    Object.assign(this, { id: null, head: null, summary: null, etag: null, key: "", trouble: "", openedMs: 0, readMs: -Infinity, lates: 0, isLate: false, isSeen: false });
    byId("arming-items").replaceChildren();
    byId("arming-reason-field").hidden = true;
    this.countersigning.hidden = true;
    this.countersigning.reset();
    setText(byId("countersign-result"), "");
    this.reason.value = "";
    setText(byId("arming-patient"), "");
    setText(byId("arming-edges"), "");
    setText(byId("arming-why"), "");
    this.button.disabled = true;
    this.presses.reset();
    // Reopened before the next drawing, the summary would keep the button's old waiting time.
    this.guard.update(performance.now());
  }

  async #read() {
    const id = this.id;
    this.readMs = performance.now();
    try {
      const { answer, etag } = await readArming(id);
      if (id === this.id) this.#show(answer, etag);
    } catch (error) {
      if (id !== this.id) return;
      // What was read before may have changed: nothing is armed by it.
      this.summary = null;
      this.trouble = error.message;
    }
  }

  #show(summary, etag) {
    const key = JSON.stringify([etag, summary.state, summary.items.map((one) => [one.code, one.state, one.code === "position" ? "" : one.text])]);
    this.trouble = "";
    if (key === this.key && this.summary !== null) return;
    Object.assign(this, { summary, etag, key, isSeen: false });
    byId("arming-reason-field").hidden = summary.needs_reason !== true;
    this.countersigning.hidden = !summary.items.some((one) => one.code === "countersignature" && one.state === "missing");
    this.presses.reset();
    setText(byId("arming-patient"), summary.items.find((one) => one.code === "patient")?.text ?? "");
    byId("arming-items").replaceChildren(...groupsOf(summary.items.filter((one) => one.code !== "patient")));
  }

  /** Sign what is shown, as the second person; the password leaves the page's fields in any case. */
  async #countersign() {
    const { id, summary } = this;
    if (summary === null) return;
    const [name, password] = ["countersign-name", "countersign-password"].map((field) => byId(field).value);
    byId("countersign-password").value = "";
    try {
      await countersign(id, this.controls.operatorName, summary.state, name.trim(), password);
      if (id === this.id) { setText(byId("countersign-result"), ""); this.#read(); }
    } catch (error) {
      if (id === this.id) setText(byId("countersign-result"), error.message);
    }
  }

  #press(event) {
    // A click that was meant for the button at this place before, or the second one of two.
    if (this.guard.refusal(event, this.#looked) !== "" || this.button.disabled) return;
    if (!this.presses.isConfirmed(event)) return;
    const { id, head, etag } = this;
    const { state } = this.summary;
    const reason = this.reason.value.trim();
    const operator = this.controls.operatorName;
    this.close();
    // Where it is refused, the way to the summary is the next step again.
    this.controls.leaveFields("");
    this.controls.run("arm", async () => {
      await arm(id, operator, head, etag, state, reason);
      rememberArming(id, operator);
    });
  }
}

/** First what needs a look, then what a person compares, and the rest as one line that opens. */
function groupsOf(items) {
  const look = items.filter((one) => one.state !== "ok");
  const fine = items.filter((one) => one.state === "ok");
  const named = Object.entries(GROUPS).map(([name, codes]) => [name, codes.flatMap((code) => fine.filter((one) => one.code === code))]);
  const groups = [["look", look], ...named].filter(([, own]) => own.length > 0).map(([name, own]) => group(part("h3", tr(`arming.group.${name}`)), own));
  const rest = fine.filter((one) => !Object.values(GROUPS).flat().includes(one.code));
  if (rest.length === 0) return groups;
  const details = part("details", "");
  const names = rest.map((one) => TITLES[one.code] ?? one.code).join(", ");
  details.append(part("summary", tr("arming.in_order", { count: rest.length, names })), group("", rest));
  return [...groups, details];
}

function group(heading, items) {
  const made = part("section", "");
  const list = part("dl", "");
  list.append(...items.map(itemLine));
  made.append(heading, list);
  return made;
}

function itemLine({ code, state, text }) {
  const line = part("div", "");
  line.dataset.code = code;
  line.dataset.state = state;
  const mark = part("span", MARKS[state], "mark-of");
  mark.setAttribute("aria-hidden", "true");
  const words = part("dd", "");
  if (WORDS[state] !== "") words.append(part("strong", WORDS[state]));
  words.append(part("span", said(text)));
  line.append(mark, part("dt", TITLES[code] ?? code), words);
  return line;
}

function edgesText(window) {
  return conditionsOf(window)
    .map((one) => {
      if (one.kind === "phase") return tr("arming.to_of_the_breath", { one: signalName(one), from_percent: one.from_percent, to_percent: one.to_percent });
      const digits = one.unit === "l" ? 2 : 1;
      const name = one.kind === "breath_hold" ? tr("arming.breath_hold") : "";
      if (!Number.isFinite(one.lower)) return tr("window_editor.held_first");
      return hasEdges(one) ? tr("arming.to", { one: signalName(one), name, value: fixed(one.lower, digits), value2: fixed(one.upper, digits), unit: one.unit }) : tr("arming.to_2", { one: signalName(one), name, lower: one.lower, upper: one.upper });
    })
    .join(window?.join === "or" ? tr("signal.or") : tr("signal.and"))
    .replaceAll("-", "−");
}
