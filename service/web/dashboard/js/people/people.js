/** The people panel: accounts, roles and API keys, for administrators. */

import { addPerson, changePerson, listPeople } from "../api.js";
import { byId, confirmButton, part, pushButton, say, setText, tick, ticked } from "../drawing/elements.js";
import { KeyList } from "./keys.js";
import { ROLES, rolesText } from "./permissions.js";
import { ShownOnce } from "./shown_once.js";
import { tr } from "../words/words.js";

export class PeoplePanel {
  /** @param {import("./access.js").Access} access the log-in */
  constructor(access) {
    this.access = access;
    this.panel = byId("people");
    this.toggle = byId("do-people");
    this.outcome = byId("people-outcome");
    this.once = new ShownOnce(byId("shown-once"));
    this.keys = new KeyList(this.once);
    this.form = byId("new-person");
    byId("new-person-roles").append(...ROLES.map((role) => tick(rolesText([role]), role)));
    this.toggle.addEventListener("click", () => this.show(this.panel.hidden));
    byId("people-close").addEventListener("click", () => this.show(false));
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#add();
    });
  }

  get isHidden() {
    return this.panel.hidden;
  }

  show(isShown) {
    if (isShown === !this.panel.hidden) return;
    this.panel.hidden = !isShown;
    this.toggle.setAttribute("aria-expanded", String(isShown));
    this.once.forget();
    say(this.outcome, "", "");
    if (isShown) {
      byId("people-heading").focus();
      this.refresh();
    } else this.#forget();
  }

  async refresh() {
    if (this.panel.hidden) return;
    await Promise.all([this.#load(), this.keys.load()]);
  }

  #forget() {
    byId("people-list").replaceChildren();
    this.keys.forget();
    this.form.reset();
  }

  async #load() {
    const empty = byId("people-empty");
    try {
      const { items } = await listPeople();
      if (this.panel.hidden) return;
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
    roles.addEventListener("change", () => this.#change(one.name, { roles: ticked(roles) }, tr("people.roles_of_changed", { name: one.name })));
    item.append(part("strong", one.name), part("span", this.#about(one), "small"), roles, this.#buttons(one));
    return item;
  }

  #about(one) {
    const isMe = one.name === this.access.person?.name ? tr("people.this_is_you") : "";
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
