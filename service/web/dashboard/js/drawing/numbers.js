/** Numbers as text, with the decimal mark of the page's language. */

let known = { language: "en", mark: "." };

/** The text of a number in English, with the decimal mark of the page's language. */
export function inMark(text) {
  const language = globalThis.document?.documentElement.lang || "en";
  if (language !== known.language) known = { language, mark: new Intl.NumberFormat(language).format(0.5)[1] };
  return text.replace(".", known.mark);
}

/** Return a number with a typographic minus, and without a sign if it rounds to zero. */
export function fixed(value, digits = 1) {
  const text = Math.abs(value).toFixed(digits);
  return `${value < 0 && Number(text) !== 0 ? "−" : ""}${inMark(text)}`;
}

/** Return a number with its sign, a typographic minus, and without a sign if it rounds to zero. */
export function signed(value, digits = 1) {
  return `${value > 0 && Number(value.toFixed(digits)) !== 0 ? "+" : ""}${fixed(value, digits)}`;
}
