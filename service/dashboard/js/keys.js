/** API keys: what planning and record-and-verify software shows instead of a password. */

import { createKey, listKeys, revokeKey } from "./api.js";
import { askingButton, byId, part, say, tick, ticked } from "./elements.js";
import { KEY_SCOPES } from "./permissions.js";

const DAY_MS = 86_400_000;

export class KeyList {
  /** @param {import("./shown_once.js").ShownOnce} once where a new key's secret is shown */
  constructor(once) {
    this.once = once;
    this.list = byId("key-list");
    this.outcome = byId("key-outcome");
    this.form = byId("new-key");
    byId("new-key-scopes").append(...KEY_SCOPES.map((scope) => tick(scope, scope)));
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
      empty.textContent = items.length > 0 ? "" : "No key yet. Every program that calls gets one of its own.";
    } catch (error) {
      this.list.replaceChildren();
      empty.textContent = `Which keys there are cannot be told. ${error.message}`;
    }
    empty.hidden = empty.textContent === "";
  }

  forget() {
    this.list.replaceChildren();
    this.form.reset();
    say(this.outcome, "", "");
  }

  #row(one) {
    const item = document.createElement("li");
    const state = stateOf(one);
    item.dataset.disabled = state === "" ? "no" : "yes";
    const used = one.last_used_at ? `last used ${day(one.last_used_at)}` : "never used";
    item.append(part("strong", one.name), part("span", [state || `until ${day(one.expires_at)}`, used].join(" · "), "small"), part("span", one.scopes.join(", "), "small scopes"));
    const row = part("span", "", "row-buttons");
    if (state === "") row.append(askingButton("Revoke", "Really revoke?", () => this.#revoke(one)));
    item.append(row);
    return item;
  }

  async #revoke(one) {
    try {
      await revokeKey(one.id);
      say(this.outcome, "done", `${one.name} opens nothing any more.`);
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
      this.once.show(`Key of ${answer.name}`, answer.secret);
      say(this.outcome, "done", `The key of ${answer.name} is made.`);
      this.form.reset();
      await this.load();
    } catch (error) {
      say(this.outcome, "failed", error.message);
    } finally {
      submit.disabled = false;
    }
  }

  #lack(name, days, scopes) {
    if (name.value.trim() === "") return "Say which program the key is for.";
    if (scopes.length === 0) return "Choose what the key may do.";
    return days.checkValidity() ? "" : `A key ends after ${days.min} to ${days.max} days.`;
  }
}

function stateOf(one) {
  if (one.revoked_at) return `revoked ${day(one.revoked_at)}`;
  return Date.parse(one.expires_at) <= Date.now() ? `ended ${day(one.expires_at)}` : "";
}

function day(at) {
  return at.slice(0, 10);
}
