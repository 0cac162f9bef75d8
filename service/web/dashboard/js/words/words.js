/**
 * The words of the page: one file a language, `lang/*.json`, with the same keys in each.
 *
 * All of them are read before anything is drawn, and kept: a page that shows a treatment asks for none. A word that a
 * language lacks is shown in English and marked; one that no language has, as its key. No text is ever empty for that.
 */

import { inMark } from "../drawing/numbers.js";

const FOLDER = new URL("../../lang/", import.meta.url);
const STORED = "tidegate.language";
const FALLBACK = "en";
const RETRY_MS = 1000;
const MARK = "[en] ";
/** A decimal number, with its unit or without: no address and no version. */
const MEASURE = /^[+-]?\d+\.\d+( ?[a-z%°²/]+)?$/i;

/** Whether the documentation is served beside the page. */
export let hasDocs = false;
export const LANGUAGES = await load();
/** The language of this page: it changes with the next load only. */
export const LANGUAGE = chosen();

/** Read all languages that the service has; without English again and again, because nothing can be shown without it. */
async function load() {
  for (;;) {
    try {
      const { languages: names, has_docs: isThere } = await read("index.json");
      hasDocs = isThere === true;
      const found = await Promise.all(names.map(async (name) => [name, await read(`${name}.json`).catch(() => null)]));
      const languages = Object.fromEntries(found.filter(([, words]) => words !== null));
      if (FALLBACK in languages) return languages;
    } catch {
      // Tried again.
    }
    await new Promise((resolve) => { setTimeout(resolve, RETRY_MS); });
  }
}

async function read(name) {
  const response = await fetch(new URL(name, FOLDER));
  if (!response.ok) throw new Error(`${name}: ${response.status}`);
  return response.json();
}

function chosen() {
  const stored = localStorage.getItem(STORED);
  return stored !== null && stored in LANGUAGES ? stored : browserLanguage();
}

/** The language of the browser, if there are words in it. */
export function browserLanguage() {
  const wanted = navigator.language.slice(0, 2);
  return wanted in LANGUAGES ? wanted : FALLBACK;
}

/** Store the language of this workstation; the page shows it with its next load. */
export function keepLanguage(language) {
  localStorage.setItem(STORED, language);
}

const SENTENCES_KEPT = 500;
/** Sentences within sentences are followed so far. */
const DEEPEST = 6;
/** What the controller's sentences were made from, the newest last: by the sentence in English, its template and values. */
const sentences = new Map();

/** Keep what sentences of an answer were made from. */
export function learnSentences(parts) {
  for (const { text, template, values } of parts ?? []) {
    sentences.delete(text);
    sentences.set(text, { template, values });
  }
  for (const text of sentences.keys()) {
    if (sentences.size <= SENTENCES_KEPT) break;
    sentences.delete(text);
  }
}

/** @returns {string|null} a sentence of the controller in the page's language; null where the language has none for it */
export function inLanguage(text, depth = 0) {
  if (LANGUAGE === FALLBACK) return null;
  const words = LANGUAGES[LANGUAGE];
  const parts = sentences.get(text);
  if (parts === undefined || depth > DEEPEST) return words[`say: ${text}`] ?? null;
  const own = /\p{L}/u.test(parts.template.replace(/\{\w+\}/g, "")) ? words[`say: ${parts.template}`] : parts.template;
  return own === undefined ? null : own.replace(/\{(\w+)\}/g, (_, name) => valueOf(String(parts.values[name] ?? ""), depth + 1));
}

/** A value of a sentence: a number, a sentence, a word or a code that has words, or a name as it is. */
function valueOf(text, depth) {
  if (/^[+-]?\d/.test(text) && !sentences.has(text)) return (MEASURE.test(text) ? inMark(text) : text).replace(/^-/, "−");
  return inLanguage(text, depth) ?? (has(`hold.${text}.what`) ? tr(`hold.${text}.what`).replace(/\.$/, "") : text);
}

/** Whether the page's language, or English, has this key. */
export function has(key) {
  return typeof LANGUAGES[FALLBACK][key] === "string" || typeof LANGUAGES[LANGUAGE][key] === "string";
}

/** @returns {string} the words of a key in the page's language */
export function tr(key, values = {}) {
  return word(LANGUAGE, key, values);
}

/** @returns {string} the words of a key in this language; those of English, marked, where it has none */
export function word(language, key, values = {}) {
  const own = LANGUAGES[language]?.[key];
  const text = own || marked(LANGUAGES[FALLBACK][key], language) || `[${key}]`;
  return text.replace(/\{(\w+)\}/g, (_, name) => String(values[name] ?? ""));
}

function marked(text, language) {
  return text && language in LANGUAGES && language !== FALLBACK ? `${MARK}${text}` : text;
}

/** Put the words into what the document itself shows: `data-t` is the text, `data-t-title` and so on an attribute. */
export function translate(root) {
  for (const element of root.querySelectorAll("[data-t]")) element.textContent = tr(element.dataset.t);
  for (const name of ["title", "aria-label", "placeholder"]) {
    for (const element of root.querySelectorAll(`[data-t-${name}]`)) element.setAttribute(name, tr(element.getAttribute(`data-t-${name}`)));
  }
}
