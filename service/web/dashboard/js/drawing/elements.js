/** Creates DOM elements; text is inserted as text, never as markup. */

export const byId = (id) => document.getElementById(id);

export function part(name, text, className = "") {
  const element = document.createElement(name);
  element.textContent = text;
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
  element.textContent = text;
}

/** Set the text of an element; leaves the document untouched if it does not change. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
