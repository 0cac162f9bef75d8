/** Numbers as text. */

/** Return a number with its sign, a typographic minus, and without a sign if it rounds to zero. */
export function signed(value, digits = 1) {
  const text = Math.abs(value).toFixed(digits);
  if (Number(text) === 0) return text;
  return (value < 0 ? "−" : "+") + text;
}
