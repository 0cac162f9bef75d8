/** Translates the document before any panel reads it, and offers the languages that the service has. */

import { keepLanguage, LANGUAGE, LANGUAGES, tr, translate } from "./words.js";

document.documentElement.lang = LANGUAGE;
translate(document);
for (const template of document.querySelectorAll("template")) translate(template.content);

/** Fill a list with the languages; the page is loaded again in the chosen one. */
export function offerLanguages(select) {
  select.setAttribute("aria-label", tr("language.choose"));
  select.append(...Object.entries(LANGUAGES).map(([name, words]) => new Option(words["language.name"] ?? name, name, false, name === LANGUAGE)));
  select.addEventListener("change", () => {
    keepLanguage(select.value);
    window.location.reload();
  });
}
