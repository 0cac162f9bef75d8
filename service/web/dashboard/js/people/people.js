/** The people panel: accounts, roles and API keys, for administrators. */

import { addPerson, changePerson, listPeople } from "../api.js";
import { confirmButton, byId, part, pushButton, say, tick, ticked } from "../drawing/elements.js";
import { KeyList } from "./keys.js";
import { ROLES } from "./permissions.js";
import { ShownOnce } from "./shown_once.js";

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
    byId("new-person-roles").append(...ROLES.map((role) => tick(role, role)));
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
      empty.textContent = `The people cannot be read. ${error.message}`;
    }
    empty.hidden = empty.textContent === "";
  }

  #row(one) {
    const item = document.createElement("li");
    item.dataset.disabled = one.is_disabled ? "yes" : "no";
    const roles = part("fieldset", "");
    roles.append(part("legend", `Roles of ${one.name}`, "unseen"), ...ROLES.map((role) => tick(role, role, one.roles.includes(role))));
    roles.addEventListener("change", () => this.#change(one.name, { roles: ticked(roles) }, `Roles of ${one.name} changed.`));
    item.append(part("strong", one.name), part("span", this.#about(one), "small"), roles, this.#buttons(one));
    return item;
  }

  #about(one) {
    const isMe = one.name === this.access.person?.name ? "this is you" : "";
    const state = one.is_disabled ? "disabled" : one.must_change_password ? "must change the password" : "";
    return [isMe, state].filter(Boolean).join(" · ");
  }

  #buttons(one) {
    const row = part("span", "", "row-buttons");
    row.append(confirmButton("New password", "Confirm reset", () => this.#change(one.name, { reset_password: true }, `The old password of ${one.name} is invalid.`)));
    if (one.is_disabled) row.append(pushButton("Enable", () => this.#change(one.name, { is_disabled: false }, `${one.name} may log in again.`)));
    else row.append(confirmButton("Disable", "Confirm disable", () => this.#change(one.name, { is_disabled: true }, `${one.name} is logged out and may not log in.`)));
    return row;
  }

  async #change(name, changes, done) {
    try {
      const answer = await changePerson(name, changes);
      if (answer.one_time_password) this.once.show(`One-time password of ${name}`, answer.one_time_password);
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
      say(this.outcome, "failed", "Enter the person's name.");
      return name.focus();
    }
    submit.disabled = true;
    try {
      const answer = await addPerson({ name: wanted, roles: ticked(byId("new-person-roles")) });
      this.once.show(`One-time password of ${wanted}`, answer.one_time_password);
      say(this.outcome, "done", `${wanted} can log in with the one-time password, and must then change it.`);
      this.form.reset();
      await this.#load();
    } catch (error) {
      say(this.outcome, "failed", error.message);
    } finally {
      submit.disabled = false;
    }
  }
}
