/**
 * The gate panel: colour, word and shape of the gate's state, announced to screen readers, with a cover that closes if the
 * page stops drawing.
 */

import { ClosingCover } from "../drawing/closing_cover.js";
import { setText } from "../drawing/elements.js";

/** Time without drawing after which the cover closes [ms]. */
const COVER_MS = 400;

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
    this.cover = new ClosingCover(root.querySelector("#gate-cover"), COVER_MS);
  }

  render(view, nowMs) {
    this.cover.keepOpen(nowMs);
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
}

function ageText(view) {
  if (view.ageMs === null) return "";
  if (view.kind === "stale" || view.kind === "offline") return `Last message ${seconds(view.ageMs)} s ago`;
  return view.ageMs > 1000 ? `Camera data ${seconds(view.ageMs)} s old` : "";
}

function seconds(ms) {
  return (ms / 1000).toFixed(1);
}
