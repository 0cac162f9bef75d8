/** The theme of this workstation, dark or bright, and the colours of what is drawn: the page's own variables. */

import { tr } from "../words/words.js";

const STORED = "tidegate.theme";
const THEMES = ["dark", "bright"];
const inks = new Map();

apply(localStorage.getItem(STORED));

function apply(theme) {
  document.documentElement.dataset.theme = THEMES.includes(theme) ? theme : THEMES[0];
}

/** The colour of a variable of the page, in the present theme. */
export function ink(variable) {
  const key = `${document.documentElement.dataset.theme} ${variable}`;
  if (!inks.has(key)) inks.set(key, getComputedStyle(document.documentElement).getPropertyValue(variable).trim());
  return inks.get(key);
}

/** An object whose members are the present colours of variables. @param {Record<string, string>} variables by member */
export function palette(variables) {
  return Object.defineProperties({}, Object.fromEntries(Object.entries(variables).map(([name, variable]) => [name, { enumerable: true, get: () => ink(variable) }])));
}

/** Fill a list with the themes; a choice is kept for this workstation and shown at once. */
export function offerThemes(select) {
  const { theme: now } = document.documentElement.dataset;
  select.setAttribute("aria-label", tr("theme.choose"));
  select.append(...THEMES.map((theme) => new Option(tr(`theme.${theme}`), theme, false, theme === now)));
  select.addEventListener("change", () => {
    localStorage.setItem(STORED, select.value);
    apply(select.value);
  });
}
