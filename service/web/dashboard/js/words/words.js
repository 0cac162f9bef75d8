/** The words of the page in its languages: one file a language, the same keys in each. */

import de from "./de.js";
import en from "./en.js";

export const LANGUAGES = { en, de };

/** @returns {string} the words of a key; English where the language is unknown */
export function word(language, key, values = {}) {
  const text = (LANGUAGES[language] ?? en)[key] ?? key;
  return text.replace(/\{(\w+)\}/g, (_, name) => String(values[name] ?? ""));
}

/** The language of the browser, if there are words in it. */
export function browserLanguage() {
  const wanted = navigator.language.slice(0, 2);
  return wanted in LANGUAGES ? wanted : "en";
}
