/**
 * The window's part of the form: one to four conditions, each with the fields that its kind, signal and unit need.
 *
 * Every input has the name of its request field (`window.upper_mm`, `window.further.0.upper_mm`), so that a refusal can be
 * shown beside its input.
 */

import { tr } from "../words/words.js";

const MOST = 4;

export class Conditions {
  /** @param {() => void} onChange called after a condition was added, removed or changed; the list is empty at first */
  constructor(root, template, add, onChange) {
    this.root = root;
    this.template = template;
    this.add = add;
    this.onChange = onChange;
    add.addEventListener("click", () => this.append());
    root.addEventListener("change", ({ target }) => {
      if (target.dataset.name === "kind") suggestEdges(target.closest("fieldset"));
      this.show();
    });
  }

  append() {
    if (this.#all().length >= MOST) return;
    const copy = this.template.content.cloneNode(true);
    const condition = copy.querySelector("fieldset");
    condition.querySelector(".remove").addEventListener("click", () => {
      condition.remove();
      this.#renumber();
    });
    this.root.append(copy);
    this.#renumber();
  }

  /** Replace all conditions by those of a session's window, or by one with the form's own values. */
  reset(conditions = [null]) {
    this.root.replaceChildren();
    for (const condition of conditions) {
      this.append();
      if (condition !== null) fill(this.root.lastElementChild, condition);
    }
    this.show();
  }

  get count() {
    return this.#all().length;
  }

  /** Whether any condition uses a named region of the session. */
  get asksForRegions() {
    return this.#all().some((one) => value(one, "signal") === "named");
  }

  show() {
    for (const one of this.#all()) showFields(one);
    this.onChange();
  }

  #all() {
    return [...this.root.children];
  }

  #renumber() {
    const all = this.#all();
    for (const [place, one] of all.entries()) {
      const path = place === 0 ? "window" : `window.further.${place - 1}`;
      for (const input of one.querySelectorAll("[data-name]")) input.name = `${path}.${input.dataset.name}`;
      one.querySelector("legend").textContent = all.length === 1 ? "" : tr("conditions.condition", { value: place + 1 });
      one.querySelector(".remove").hidden = place === 0;
    }
    this.add.disabled = all.length >= MOST;
    this.show();
  }
}

function showFields(condition) {
  const [kind, signal] = [value(condition, "kind"), value(condition, "signal")];
  const length = signal === "volume" ? "l" : "mm";
  const edges = condition.querySelector("[data-edges]");
  edges.options[0].textContent = length;
  const unit = edges.value === "percent" ? "percent" : length;
  const chosen = { kinds: kind, signals: signal, units: unit, lengths: length };
  for (const field of condition.querySelectorAll(".field")) {
    field.hidden = Object.entries(chosen).some(([asked, is]) => asked in field.dataset && !field.dataset[asked].split(" ").includes(is));
  }
  // A breath hold may be without edges, and has no hysteresis then.
  const own = edgesOf(condition, unit);
  for (const edge of own) {
    edge.placeholder = kind === "breath_hold" ? tr("conditions.from_a_held_breath") : "";
    if (kind === "breath_hold" && own.every((one) => one.value === "")) edge.dataset.optional = "";
    else delete edge.dataset.optional;
  }
  const hysteresis = condition.querySelector(`[data-name="hysteresis_${unit}"]`).closest(".field");
  hysteresis.hidden ||= "optional" in own[0].dataset;
}

/**
 * The form's own edges are those of the end of exhale: a breath hold has none before a breath was held, and none is
 * suggested. What a person typed stays.
 */
function suggestEdges(condition) {
  const isHold = value(condition, "kind") === "breath_hold";
  for (const edge of condition.querySelectorAll('[data-name^="lower_"], [data-name^="upper_"]')) {
    if (isHold && edge.value === edge.defaultValue) edge.value = "";
    else if (!isHold && edge.value === "") edge.value = edge.defaultValue;
  }
}

function edgesOf(condition, unit) {
  return ["lower", "upper"].map((edge) => condition.querySelector(`[data-name="${edge}_${unit}"]`));
}

/** Enter a condition as the controller describes it; what it leaves out keeps the form's value. */
function fill(fieldset, condition) {
  if (condition.kind === "breath_hold") {
    fieldset.querySelector('[data-name="kind"]').value = condition.kind;
    suggestEdges(fieldset);
  }
  for (const input of fieldset.querySelectorAll("[data-name]")) {
    const found = condition[input.dataset.name];
    if (found !== null && found !== undefined) input.value = found;
  }
  const inPercent = condition.lower_percent !== null && condition.lower_percent !== undefined;
  fieldset.querySelector("[data-edges]").value = inPercent ? "percent" : "length";
}

function value(condition, name) {
  return condition.querySelector(`[data-name="${name}"]`).value;
}
