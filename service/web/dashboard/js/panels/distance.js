/**
 * The view from a distance: the same page, the same panels and the same times, with all else hidden by the style sheet.
 *
 * It has its own address, `?view=distance`, for a screen that only shows. It can hold and disarm, and never arm: its
 * other buttons are hidden, and the keys of this page do nothing but hold and disarm.
 */

import { setText } from "../drawing/elements.js";
import { tr } from "../words/words.js";

const NAME = "distance";

export class DistanceView {
  /** @param {HTMLButtonElement} button switches the view */
  constructor(button) {
    this.button = button;
    this.show(new URLSearchParams(window.location.search).get("view") === NAME);
    button.addEventListener("click", () => this.show(!this.isShown));
  }

  get isShown() {
    return document.body.dataset.view === NAME;
  }

  show(isShown) {
    document.body.dataset.view = isShown ? NAME : "console";
    setText(this.button, tr(isShown ? "distance.leave" : "distance.show"));
    const address = new URL(window.location.href);
    if (isShown) address.searchParams.set("view", NAME);
    else address.searchParams.delete("view");
    window.history.replaceState(null, "", address);
  }
}
