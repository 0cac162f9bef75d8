/**
 * The gate panel: colour, word and shape of the gate's state, announced to screen readers, with a cover that closes if the
 * page stops drawing.
 */

import { setText } from "../drawing/elements.js";

/** Time without drawing after which the cover closes [ms]. */
const COVER_MS = 400;
/** Period of re-opening the cover [ms]; each time costs a frame of the compositor. */
const COVER_RENEW_MS = 80;

const ASSERTIVE_KINDS = new Set(["fault", "stale", "offline", "out"]);

export class GatePanel {
  constructor(root) {
    this.root = root;
    this.word = root.querySelector("#gate-word");
    this.reason = root.querySelector("#gate-reason");
    this.detail = root.querySelector("#gate-detail");
    this.age = root.querySelector("#gate-age");
    this.warning = root.querySelector("#gate-warning");
    this.politely = root.querySelector("#say-politely");
    this.now = root.querySelector("#say-now");
    this.said = "";
    this.renewedMs = -Infinity;
    this.cover = closingCover(root.querySelector("#gate-cover"));
  }

  render(view, nowMs) {
    this.#renewCover(nowMs);
    this.root.dataset.kind = view.kind;
    document.body.dataset.fresh = view.isCurrent ? "yes" : "no";
    setText(this.word, view.word);
    this.word.dataset.length = view.word.length <= 7 ? "short" : view.word.length <= 10 ? "long" : "longest";
    setText(this.reason, view.reason);
    setText(this.detail, view.detail);
    setText(this.warning, view.warning);
    setText(this.age, ageText(view));
    // Browsers freeze hidden tabs: the title must not show a state then.
    document.title = document.hidden ? "Tidegate (not watched)" : `${view.word.toUpperCase()} · Tidegate`;
    this.#say(view);
  }

  #say(view) {
    const text = `${view.word}. ${view.reason}`;
    const key = `${view.kind} ${view.word}`;
    if (key === this.said) return;
    this.said = key;
    (ASSERTIVE_KINDS.has(view.kind) ? this.now : this.politely).textContent = text;
  }

  #renewCover(nowMs) {
    if (nowMs - this.renewedMs < COVER_RENEW_MS) return;
    this.renewedMs = nowMs;
    this.cover.currentTime = 0;
  }
}

/**
 * A dead-man for the page: an animation in the browser's compositor that closes the cover and is restarted by every
 * drawing. If this script hangs, the cover closes, so an old green state cannot stay visible.
 */
function closingCover(element) {
  const animation = element.animate(
    [{ opacity: 0 }, { opacity: 0, offset: 0.98 }, { opacity: 1 }],
    { duration: COVER_MS, fill: "forwards" },
  );
  animation.pause();
  animation.play();
  return animation;
}

function ageText(view) {
  if (view.ageMs === null) return "";
  if (view.kind === "stale" || view.kind === "offline") return `Last message ${seconds(view.ageMs)} s ago`;
  return view.ageMs > 1000 ? `Camera data ${seconds(view.ageMs)} s old` : "";
}

function seconds(ms) {
  return (ms / 1000).toFixed(1);
}
