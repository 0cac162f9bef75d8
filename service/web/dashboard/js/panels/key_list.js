/** The list of the keys, opened with "?" outside of fields. */

import { byId } from "../drawing/elements.js";

const FIELDS = "input:not([type=radio], [type=checkbox]), select, textarea";

export class KeyList {
  constructor() {
    this.root = byId("keys");
    byId("keys-close").addEventListener("click", () => this.close());
    byId("do-keys").addEventListener("click", () => this.show(this.root.hidden));
    document.addEventListener("keydown", (event) => {
      if (event.key !== "?" || event.ctrlKey || event.metaKey || event.altKey || event.target.closest?.(FIELDS)) return;
      event.preventDefault();
      if (!event.repeat) this.show(this.root.hidden);
    });
  }

  show(isShown) {
    this.root.hidden = !isShown;
    byId("do-keys").setAttribute("aria-expanded", String(isShown));
    if (isShown) byId("keys-heading").focus();
  }

  /** @returns {boolean} whether it was open */
  close() {
    const wasOpen = !this.root.hidden;
    this.show(false);
    return wasOpen;
  }
}
