/** Projective map from the region's grid to the colour picture. */

/**
 * Map the unit square to a quadrilateral, corners (0,0), (1,0), (1,1), (0,1) in that order.
 *
 * @param {number[][]} quad superior right, superior left, inferior left, inferior right of the patient [px]
 * @returns {?(u: number, v: number) => number[]} u from the patient's right to the left, v from superior to inferior;
 *   null for a degenerate quadrilateral
 */
export function projectiveMap(quad) {
  if (!Array.isArray(quad) || quad.length !== 4 || !quad.flat().every(Number.isFinite)) return null;
  const [[x0, y0], [x1, y1], [x2, y2], [x3, y3]] = quad;
  const [sx, sy] = [x0 - x1 + x2 - x3, y0 - y1 + y2 - y3];
  const [dx1, dx2, dy1, dy2] = [x1 - x2, x3 - x2, y1 - y2, y3 - y2];
  const area = dx1 * dy2 - dx2 * dy1;
  if (Math.abs(area) < 1) return null;
  const g = (sx * dy2 - dx2 * sy) / area;
  const h = (dx1 * sy - sx * dy1) / area;
  const [a, b] = [x1 - x0 + g * x1, x3 - x0 + h * x3];
  const [d, e] = [y1 - y0 + g * y1, y3 - y0 + h * y3];
  return (u, v) => {
    const w = g * u + h * v + 1;
    return [(a * u + b * v + x0) / w, (d * u + e * v + y0) / w];
  };
}
