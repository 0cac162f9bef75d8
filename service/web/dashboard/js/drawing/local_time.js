/** Times of the service in the time of the screen, with its zone, in the language of the page. */

import { LANGUAGE } from "../words/words.js";

const FORMAT = { day: "2-digit", month: "short", year: "numeric", hour: "2-digit", minute: "2-digit", second: "2-digit", timeZoneName: "short" };

/** "21 Nov 2026, 10:12:05 CET" for a time of the service; a dash without one. */
export function localTime(at) {
  const time = new Date(at ?? NaN);
  return Number.isNaN(time.getTime()) ? "–" : time.toLocaleString(LANGUAGE === "en" ? "en-GB" : LANGUAGE, FORMAT);
}
