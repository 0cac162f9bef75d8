/** API keys, with which planning and record-and-verify software authenticates. */

import { createKey, listKeys, revokeKey } from "../api.js";
import { byId, confirmButton, part, say, setText, tick, ticked } from "../drawing/elements.js";
import { KEY_SCOPES } from "./permissions.js";
import { has, tr } from "../words/words.js";

const DAY_MS = 86_400_000;

export class KeyList {
  /** @param {import("./shown_once.js").ShownOnce} once panel that shows a new key's secret */
  constructor(once) {
    this.once = once;
    this.list = byId("key-list");
    this.outcome = byId("key-outcome");
    this.form = byId("new-key");
    byId("new-key-scopes").append(...KEY_SCOPES.map((scope) => tick(scopeText(scope), scope)));
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#create();
    });
  }

  async load() {
    const empty = byId("key-empty");
    try {
      const { items } = await listKeys();
      this.list.replaceChildren(...items.map((one) => this.#row(one)));
      empty.textContent = items.length > 0 ? "" : tr("keys.no_key_yet_create_one_key_per_program");
    } catch (error) {
      this.list.replaceChildren();
      setText(empty, tr("keys.the_keys_cannot_be_read", { message: error.message }));
    }
    empty.hidden = empty.textContent === "";
  }

  #row(one) {
    const item = document.createElement("li");
    const state = stateOf(one);
    item.dataset.disabled = state === "" ? "no" : "yes";
    const used = one.last_used_at ? tr("keys.last_used", { last_used_at: day(one.last_used_at) }) : tr("keys.never_used");
    item.append(part("strong", one.name), part("span", [state || tr("keys.until", { day: day(one.expires_at) }), used].join(" · "), "small"), part("span", one.scopes.map(scopeText).join(", "), "small scopes"));
    const row = part("span", "", "row-buttons");
    if (state === "") row.append(confirmButton(tr("keys.revoke"), tr("keys.confirm_revoke"), () => this.#revoke(one)));
    item.append(row);
    return item;
  }

  async #revoke(one) {
    try {
      await revokeKey(one.id);
      say(this.outcome, "done", tr("keys.the_key_of_is_revoked", { name: one.name }));
    } catch (error) {
      say(this.outcome, "failed", `${one.name}: ${error.message}`);
    }
    await this.load();
  }

  async #create() {
    const { name, days, submit } = this.form.elements;
    const scopes = ticked(byId("new-key-scopes"));
    const lack = this.#lack(name, days, scopes);
    if (lack !== "") return say(this.outcome, "failed", lack);
    submit.disabled = true;
    try {
      const expires_at = new Date(Date.now() + days.valueAsNumber * DAY_MS).toISOString();
      const answer = await createKey({ name: name.value.trim(), scopes, expires_at });
      this.once.show(tr("keys.key_of", { name: answer.name }), answer.secret);
      say(this.outcome, "done", tr("keys.the_key_of_is_created", { name: answer.name }));
      this.form.reset();
      await this.load();
    } catch (error) {
      say(this.outcome, "failed", error.message);
    } finally {
      submit.disabled = false;
    }
  }

  #lack(name, days, scopes) {
    if (name.value.trim() === "") return tr("keys.enter_the_program_s_name");
    if (scopes.length === 0) return tr("keys.choose_the_key_s_permissions");
    return days.checkValidity() ? "" : tr("keys.a_key_expires_after_to_days", { min: days.min, max: days.max });
  }
}

/** What a permission is, in words; its code where there are none. */
function scopeText(scope) {
  return has(`scope.${scope}`) ? tr(`scope.${scope}`) : scope;
}

function stateOf(one) {
  if (one.revoked_at) return tr("keys.revoked", { day: day(one.revoked_at) });
  return Date.parse(one.expires_at) <= Date.now() ? tr("keys.expired", { day: day(one.expires_at) }) : "";
}

function day(at) {
  return at.slice(0, 10);
}
