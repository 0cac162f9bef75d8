/**
 * The gate panel: colour, word and shape of the gate's state, announced to screen readers, with a cover that closes if the
 * page stops drawing.
 */

import { ClosingCover } from "../drawing/closing_cover.js";
import { setText } from "../drawing/elements.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

/** Time without drawing after which the cover closes [ms]. */
const COVER_MS = 400;

const ASSERTIVE_KINDS = new Set(["fault", "stale", "offline", "out"]);

export class GatePanel {
  constructor(root) {
    this.root = root;
    this.word = root.querySelector("#gate-word");
    this.reason = root.querySelector("#gate-reason");
    this.detail = root.querySelector("#gate-detail");
    this.toDo = root.querySelector("#gate-do");
    this.call = root.querySelector("#gate-call");
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
    this.word.dataset.length = view.word.length <= 7 ? "short" : view.word.length <= 9 ? "medium" : view.word.length <= 10 ? "long" : "longest";
    setText(this.reason, view.reason);
    setText(this.detail, view.detail);
    setText(this.toDo, view.toDo ?? "");
    setText(this.call, view.call ?? "");
    setText(this.warning, view.warning);
    setText(this.age, ageText(view));
    // Browsers freeze hidden tabs: the title must not show a state then.
    document.title = document.hidden ? tr("gate.tidegate_not_watched") : `${view.word.toUpperCase()} · Tidegate`;
    this.#say(view);
  }

  #say(view) {
    const text = [`${view.word}. ${view.reason}`, view.toDo].filter(Boolean).join(" ");
    const key = `${view.kind} ${view.word}`;
    if (key === this.said) return;
    this.said = key;
    (ASSERTIVE_KINDS.has(view.kind) ? this.now : this.politely).textContent = text;
  }
}

function ageText(view) {
  if (view.ageMs === null) return "";
  if (view.kind === "stale" || view.kind === "offline") return tr("gate.last_message_s_ago", { ageMs: seconds(view.ageMs) });
  return view.ageMs > 1000 ? tr("gate.camera_data_s_old", { ageMs: seconds(view.ageMs) }) : "";
}

function seconds(ms) {
  return fixed(ms / 1000, 1);
}
