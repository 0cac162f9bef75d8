/** The panel for log-in and change of password: beside the gate, never over it. */

import { changePassword, logIn, OIDC_URL, readLogInWays } from "../api.js";
import { byId, say } from "../drawing/elements.js";
import { tr } from "../words/words.js";

const COUNT_MS = 250;
const MIN_PASSWORD = 12;

export class LogIn {
  /** @param {import("./access.js").Access} access notified of every log-in */
  constructor(access) {
    this.access = access;
    this.panel = byId("access");
    this.form = byId("log-in");
    this.change = byId("change-password");
    this.outcome = byId("log-in-outcome");
    this.wait = byId("log-in-wait");
    this.isAsked = false;
    this.freeAtMs = 0;
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#logIn();
    });
    this.change.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#change();
    });
    byId("log-in-oidc").addEventListener("click", () => window.location.assign(OIDC_URL));
    byId("change-cancel").addEventListener("click", () => this.ask(false));
  }

  /** Open or close the form to change the password. */
  ask(isAsked) {
    this.isAsked = isAsked;
    this.show();
  }

  /** Show the form for the state of the log-in, and focus its first field. */
  show() {
    const { state } = this.access;
    const isChange = state === "change" || (state === "in" && this.isAsked);
    const wasHidden = this.panel.hidden;
    this.panel.hidden = !(state === "out" || isChange);
    const isOther = this.form.hidden !== isChange || wasHidden;
    this.form.hidden = isChange;
    this.change.hidden = !isChange;
    byId("change-cancel").hidden = state === "change";
    byId("change-why").textContent = state === "change" ? tr("login.this_password_was_for_one_log_in_choose_a_ne") : "";
    byId("access-reason").textContent = state === "out" ? this.access.reason : "";
    byId("access-reason").hidden = byId("access-reason").textContent === "";
    if (this.panel.hidden) return this.#clear();
    if (isOther) this.#begin(isChange);
  }

  #begin(isChange) {
    const form = isChange ? this.change : this.form;
    say(byId("change-outcome"), "", "");
    if (isChange) form.elements.name.value = this.access.person.name;
    else this.#offerWays();
    [...form.elements].find((one) => one.matches("input:not([hidden])") && one.value === "")?.focus();
  }

  #clear() {
    this.form.reset();
    this.change.reset();
    say(this.outcome, "", "");
  }

  /** Offer the hospital's log-in first, if there is one; passwords may then be for break-glass accounts only. */
  async #offerWays() {
    let ways = { password: true, oidc: null };
    try {
      ways = (await readLogInWays()) ?? ways; // an answer without content is none
    } catch {
      // The methods are unknown: offer name and password.
    }
    const { oidc } = ways;
    const isGlass = oidc !== null && ways.local_accounts === "break-glass";
    byId("log-in-oidc").hidden = oidc === null;
    byId("log-in-oidc").textContent = oidc === null ? "" : tr("login.log_in_with", { label: oidc.label });
    byId("log-in-fields").hidden = ways.password === false;
    byId("log-in-why").hidden = !isGlass;
    const away = oidc?.is_reachable === false ? tr("login.does_not_answer", { label: oidc.label }) : "";
    const note = `${away}${isGlass ? tr("login.the_form_below_is_for_break_glass_accounts_o") : ""}`;
    byId("log-in-note").textContent = note;
    byId("log-in-note").hidden = note === "";
  }

  async #logIn() {
    const { name, password, reason, submit } = this.form.elements;
    const asksWhy = !byId("log-in-why").hidden;
    const missing = [name, password, ...(asksWhy ? [reason] : [])].find((one) => one.value.trim() === "");
    if (missing) {
      say(this.outcome, "failed", missing === reason ? tr("login.enter_a_reason") : tr("login.enter_your", { name: missing.name }));
      return missing.focus();
    }
    submit.disabled = true;
    say(this.outcome, "busy", tr("login.asking"));
    try {
      const typed = password.value;
      const why = asksWhy ? { reason: reason.value.trim() } : {};
      const person = await logIn({ name: name.value.trim(), password: typed, ...why });
      this.form.reset();
      say(this.outcome, "", "");
      // The name is known; do not ask for it again.
      if (person.must_change_password) this.change.elements.old_password.value = typed;
      this.access.accept(person);
      this.#goToOffice();
    } catch (error) {
      this.#refuse(error);
    }
    submit.disabled = performance.now() < this.freeAtMs;
  }

  /**
   * A log-in leads back to the part of the office that it was asked for, and to people for a person who manages them and
   * cannot run sessions.
   */
  #goToOffice() {
    const wanted = new URLSearchParams(window.location.search).get("office");
    if (wanted !== null) window.location.assign(`office/#${wanted}`);
    else if (this.access.may("people") && !this.access.may("create")) window.location.assign("office/#people");
  }

  #refuse(error) {
    const { password } = this.form.elements;
    password.value = "";
    say(this.outcome, "failed", error.status === 401 ? tr("login.name_or_password_is_wrong") : error.message);
    if (error.retryAfterS > 0) this.#lock(error.retryAfterS);
    else password.focus();
  }

  /** Count down the seconds until the next log-in is accepted. */
  #lock(seconds) {
    this.freeAtMs = performance.now() + 1000 * seconds;
    clearInterval(this.counting);
    const count = () => {
      const leftS = Math.ceil((this.freeAtMs - performance.now()) / 1000);
      this.form.elements.submit.disabled = leftS > 0;
      this.wait.textContent = leftS > 0 ? tr("login.try_again_in", { leftS: clock(leftS) }) : "";
      if (leftS > 0) return;
      clearInterval(this.counting);
      say(this.outcome, "", "");
      this.form.elements.password.focus();
    };
    this.counting = setInterval(count, COUNT_MS);
    count();
  }

  async #change() {
    const { old_password: old, new_password: chosen, repeated, submit } = this.change.elements;
    const outcome = byId("change-outcome");
    const wrong = this.#mistake(old, chosen, repeated);
    if (wrong !== null) {
      say(outcome, "failed", wrong.text);
      return wrong.input.focus();
    }
    submit.disabled = true;
    try {
      await changePassword(old.value, chosen.value);
      this.change.reset();
      this.isAsked = false;
      await this.access.ask();
      this.show();
      this.#goToOffice();
    } catch (error) {
      say(outcome, "failed", error.message);
      if (error.status === 401) this.access.ask();
    } finally {
      submit.disabled = false;
    }
  }

  #mistake(old, chosen, repeated) {
    if (old.value === "") return { input: old, text: tr("login.enter_your_present_password") };
    if ([...chosen.value].length < MIN_PASSWORD) return { input: chosen, text: tr("login.the_new_password_has_characters_it_needs", { length: [...chosen.value].length, MIN_PASSWORD }) };
    if (chosen.value === old.value) return { input: chosen, text: tr("login.the_new_password_is_the_old_one") };
    return chosen.value === repeated.value ? null : { input: repeated, text: tr("login.the_two_new_passwords_differ") };
  }
}

function clock(seconds) {
  return seconds < 60 ? `${seconds} s` : `${Math.floor(seconds / 60)} min ${seconds % 60} s`;
}
