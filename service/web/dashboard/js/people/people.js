/** Accounts with their roles and log-ins, and API keys, for administrators. */

import { addPerson, changePerson, endLogIn, listLogIns, listPeople } from "../api.js";
import { byId, confirmButton, part, pushButton, say, setText, tick, ticked } from "../drawing/elements.js";
import { localTime } from "../drawing/local_time.js";
import { filled, table } from "../office/parts.js";
import { KeyList } from "./keys.js";
import { ROLES, rolesText } from "./permissions.js";
import { ShownOnce } from "./shown_once.js";
import { tr } from "../words/words.js";

export class People {
  /**
   * Fills the elements of the office's template, which are in the document.
   *
   * @param {object} person who is logged in
   * @param {AbortSignal} ended nothing is shown after it, and a secret is removed
   */
  constructor(person, ended) {
    Object.assign(this, { person, ended, outcome: byId("people-outcome"), form: byId("new-person") });
    this.once = new ShownOnce(byId("shown-once"));
    this.keys = new KeyList(this.once);
    byId("new-person-roles").append(...ROLES.map((role) => tick(rolesText([role]), role)));
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#add();
    });
    ended.addEventListener("abort", () => this.once.forget());
    this.#load();
    this.keys.load();
  }

  async #load() {
    const empty = byId("people-empty");
    try {
      const { items } = await listPeople();
      if (this.ended.aborted) return;
      byId("people-list").replaceChildren(...items.map((one) => this.#row(one)));
      byId("people-next").hidden = items.length > 1;
      empty.textContent = "";
    } catch (error) {
      byId("people-list").replaceChildren();
      setText(empty, tr("people.the_people_cannot_be_read", { message: error.message }));
    }
    empty.hidden = empty.textContent === "";
  }

  #row(one) {
    const item = document.createElement("li");
    item.dataset.disabled = one.is_disabled ? "yes" : "no";
    const roles = part("fieldset", "");
    roles.append(part("legend", tr("people.roles_of", { name: one.name }), "unseen"), ...ROLES.map((role) => tick(rolesText([role]), role, one.roles.includes(role))));
    roles.addEventListener("change", () => this.#offerRoles(one, roles));
    item.append(part("strong", one.name), part("span", this.#about(one), "small"), roles, this.#buttons(one), this.#logIns(one.name));
    return item;
  }

  /** Roles that are ticked take effect with a click of their own, which names them. */
  #offerRoles(one, roles) {
    roles.querySelector("button")?.remove();
    const wanted = ticked(roles);
    if (JSON.stringify(wanted) === JSON.stringify(ROLES.filter((role) => one.roles.includes(role)))) return;
    const button = pushButton(tr("people.change_roles", { roles: rolesText(wanted) || tr("roles.none") }), () => this.#change(one.name, { roles: wanted }, tr("people.roles_of_changed", { name: one.name })));
    button.className = "go";
    roles.append(button);
  }

  /** The open log-ins of a person; each can be ended. */
  #logIns(name) {
    const details = part("details", "");
    const place = part("div", "");
    const columns = ["since", "seen", "until_when", "address", "way", "end"].map((one) => ({ name: tr(`office.${one}`) }));
    const read = () => filled(place, this.ended, () => listLogIns(name), ({ items }) => (items.length === 0
      ? part("p", tr("office.no_log_in"), "note")
      : table(columns, items.map((one) => [localTime(one.created_at), localTime(one.seen_at), localTime(one.expires_at), one.address, one.way, one.is_this ? tr("office.this_one") : this.#end(name, one.id, read)]))));
    details.append(part("summary", tr("office.log_ins")), place);
    details.addEventListener("toggle", () => { if (details.open) read(); });
    return details;
  }

  #end(name, id, again) {
    return confirmButton(tr("office.end"), tr("office.confirm_end"), () => endLogIn(name, id).then(again, (error) => say(this.outcome, "failed", `${name}: ${error.message}`)));
  }

  #about(one) {
    const isMe = one.name === this.person.name ? tr("people.this_is_you") : "";
    const state = one.is_disabled ? tr("people.disabled") : one.must_change_password ? tr("people.must_change_the_password") : "";
    return [isMe, state].filter(Boolean).join(" · ");
  }

  #buttons(one) {
    const row = part("span", "", "row-buttons");
    row.append(confirmButton(tr("people.new_password"), tr("people.confirm_reset"), () => this.#change(one.name, { reset_password: true }, tr("people.the_old_password_of_is_invalid", { name: one.name }))));
    if (one.is_disabled) row.append(pushButton(tr("people.enable"), () => this.#change(one.name, { is_disabled: false }, tr("people.may_log_in_again", { name: one.name }))));
    else row.append(confirmButton(tr("people.disable"), tr("people.confirm_disable"), () => this.#change(one.name, { is_disabled: true }, tr("people.is_logged_out_and_may_not_log_in", { name: one.name }))));
    return row;
  }

  async #change(name, changes, done) {
    try {
      const answer = await changePerson(name, changes);
      if (answer.one_time_password) this.once.show(tr("people.one_time_password_of", { name }), answer.one_time_password);
      say(this.outcome, "done", done);
    } catch (error) {
      say(this.outcome, "failed", `${name}: ${error.message}`);
    }
    await this.#load();
  }

  async #add() {
    const { name, submit } = this.form.elements;
    const wanted = name.value.trim();
    if (wanted === "") {
      say(this.outcome, "failed", tr("people.enter_the_person_s_name"));
      return name.focus();
    }
    submit.disabled = true;
    try {
      const answer = await addPerson({ name: wanted, roles: ticked(byId("new-person-roles")) });
      this.once.show(tr("people.one_time_password_of_2", { wanted }), answer.one_time_password);
      say(this.outcome, "done", tr("people.can_log_in_with_the_one_time_password_and_mu", { wanted }));
      this.form.reset();
      await this.#load();
    } catch (error) {
      say(this.outcome, "failed", error.message);
    } finally {
      submit.disabled = false;
    }
  }
}
