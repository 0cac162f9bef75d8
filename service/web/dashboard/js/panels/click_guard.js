/**
 * Protects Acknowledge, Arm and Release from clicks that were meant for another button, after the page was laid out
 * again: a message above them, another size of the window, a keyboard on a touch screen. Each has a place of its own, but
 * all may move together. Hold, Disarm and Stop are not protected: they never wait.
 */

/** How long clicks are ignored after one of the buttons appeared, disappeared or moved [ms]. */
export const IGNORE_MS = 2000;

export class ClickGuard {
  /** @param {HTMLElement[]} buttons the buttons of one area of the page: when one moves, clicks on all are ignored */
  constructor(buttons) {
    this.buttons = buttons;
    this.layout = null;
    this.changedMs = null;
    for (const button of buttons) button.addEventListener("keydown", ignoreRepeat);
  }

  /**
   * Compare the layout with the last one. Call it whenever the page is drawn.
   *
   * @param {number} nowMs on the clock of `performance.now()` and `event.timeStamp`
   * @param {string} content what has to be looked at before the click; another one counts as another layout
   * @returns {boolean} whether clicks are ignored now
   */
  update(nowMs, content = "") {
    const layout = [...this.buttons.map(placeOf), content].join("; ");
    if (layout !== this.layout) {
      this.layout = layout;
      this.changedMs = nowMs;
    }
    return !this.#isStill(nowMs);
  }

  /** @returns {string} why this click is ignored; "repeated" needs no message, the first click was accepted */
  refusal(event, content = "") {
    if (event.detail > 1) return "repeated";
    // The layout may have changed since the page was drawn last.
    this.update(performance.now(), content);
    // The time of the click itself: it may have waited while the page was busy.
    return this.#isStill(event.timeStamp) ? "" : "moved";
  }

  #isStill(atMs) {
    return atMs - this.changedMs >= IGNORE_MS;
  }
}

/** Enter that is held down repeats its clicks; Space that is held down may have been pressed on another button. */
function ignoreRepeat(event) {
  if (event.repeat && (event.key === "Enter" || event.key === " ")) event.preventDefault();
}

/** Position and size of a button on the page, without scrolling [px]; "hidden" if it is not shown. */
function placeOf(button) {
  if (button.offsetParent === null) return "hidden";
  let [left, top] = [0, 0];
  for (let element = button; element !== null; element = element.offsetParent) {
    left += element.offsetLeft;
    top += element.offsetTop;
  }
  return [left, top, button.offsetWidth, button.offsetHeight].join(",");
}
