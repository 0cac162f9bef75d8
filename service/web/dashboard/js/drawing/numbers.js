/** Numbers as text. */

/** Return a number with a typographic minus, and without a sign if it rounds to zero. */
export function fixed(value, digits = 1) {
  const text = Math.abs(value).toFixed(digits);
  return value < 0 && Number(text) !== 0 ? `−${text}` : text;
}

/** Return a number with its sign, a typographic minus, and without a sign if it rounds to zero. */
export function signed(value, digits = 1) {
  const text = fixed(value, digits);
  return value > 0 && Number(text) !== 0 ? `+${text}` : text;
}
