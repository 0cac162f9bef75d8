/** The theme of this workstation, dark or bright, and the colours of what is drawn: the page's own variables. */

import { tr } from "../words/words.js";

const STORED = "tidegate.theme";
/** The first one is that of the workstation's own system. */
const THEMES = ["system", "dark", "bright"];
const ofSystem = window.matchMedia("(prefers-color-scheme: light)");
const inks = new Map();

apply();
ofSystem.addEventListener("change", apply);

function stored() {
  const theme = localStorage.getItem(STORED);
  return THEMES.includes(theme) ? theme : THEMES[0];
}

function apply() {
  const theme = stored();
  document.documentElement.dataset.theme = theme !== "system" ? theme : ofSystem.matches ? "bright" : "dark";
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
  select.setAttribute("aria-label", tr("theme.choose"));
  select.append(...THEMES.map((theme) => new Option(tr(`theme.${theme}`), theme, false, theme === stored())));
  select.addEventListener("change", () => {
    localStorage.setItem(STORED, select.value);
    apply();
  });
}
