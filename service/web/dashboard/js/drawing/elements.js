/** Creates DOM elements; text is inserted as text, never as markup. */

import { inLanguage } from "../words/words.js";

export const byId = (id) => document.getElementById(id);

/** What the service says in its own language is set off by the isolates of Unicode, and shown in an element that says so. */
const [OPEN, CLOSE] = ["\u2068", "\u2069"];
const QUOTED = new RegExp(`${OPEN}([^${CLOSE}]*)${CLOSE}`);
const shown = new WeakMap();

/** A sentence of the service in the page's language; marked as the service's own where the language has none for it. */
export function said(text) {
  return text ? inLanguage(text) ?? `${OPEN}${text}${CLOSE}` : "";
}

/** A sentence's text with a capital letter at its beginning. */
export function capitalized(text) {
  return text.replace(/^\u2068?./u, (first) => first.toUpperCase());
}

export function part(name, text, className = "") {
  const element = document.createElement(name);
  setText(element, text);
  if (className !== "") element.className = className;
  return element;
}

export function pushButton(text, onClick) {
  const button = part("button", text);
  button.type = "button";
  button.addEventListener("click", () => onClick(button));
  return button;
}

/** A button that acts on the second click; the first asks for confirmation, for `patienceMs` [ms]. */
export function confirmButton(text, question, onClick, patienceMs = 4000) {
  return pushButton(text, (button) => {
    const isSecond = button.dataset.asks === "yes";
    button.dataset.asks = isSecond ? "no" : "yes";
    button.textContent = isSecond ? text : question;
    if (isSecond) onClick(button);
    else setTimeout(() => { button.dataset.asks = "no"; button.textContent = text; }, patienceMs);
  });
}

export function tick(text, value, isChecked = false) {
  const label = part("label", "", "tick");
  const input = document.createElement("input");
  input.type = "checkbox";
  input.value = value;
  input.checked = isChecked;
  label.append(input, part("span", text));
  return label;
}

/** Return the values of the ticked boxes below an element. */
export function ticked(root) {
  return [...root.querySelectorAll("input[type=checkbox]:checked")].map((one) => one.value);
}

export function say(element, kind, text) {
  element.dataset.kind = kind;
  setText(element, text);
}

/** Set the text of an element; leaves the document untouched if it does not change. */
export function setText(element, text) {
  if (!text.includes?.(OPEN)) {
    shown.delete(element);
    if (element.textContent !== text) element.textContent = text;
    return;
  }
  if (shown.get(element) === text) return;
  shown.set(element, text);
  // Every second piece is the service's.
  element.replaceChildren(...text.split(QUOTED).map((piece, i) => (i % 2 === 0 ? piece : inEnglish(piece))));
}

function inEnglish(text) {
  const element = document.createElement("span");
  element.lang = "en";
  element.textContent = text;
  return element;
}
