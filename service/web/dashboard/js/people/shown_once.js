/** A secret that the controller returns once: shown until it is closed, never stored. */

import { byId } from "../drawing/elements.js";
import { tr } from "../words/words.js";

export class ShownOnce {
  constructor(root) {
    this.root = root;
    this.code = byId("once-secret");
    this.copied = byId("once-copied");
    byId("once-done").addEventListener("click", () => this.forget());
    byId("once-copy").addEventListener("click", () => this.#copy());
  }

  show(title, secret) {
    byId("once-title").textContent = title;
    this.code.textContent = secret;
    this.copied.textContent = "";
    this.root.hidden = false;
    this.root.focus();
  }

  forget() {
    this.code.textContent = "";
    this.copied.textContent = "";
    this.root.hidden = true;
  }

  async #copy() {
    try {
      await navigator.clipboard.writeText(this.code.textContent);
      this.copied.textContent = tr("shown_once.copied");
    } catch {
      window.getSelection().selectAllChildren(this.code);
      this.copied.textContent = tr("shown_once.selected_copy_it_with_the_keyboard");
    }
  }
}
