/** The fractions of a plan beside each other: window, breath and level of each, with its duty cycle. */

import { part } from "../drawing/elements.js";
import { fixed } from "../drawing/numbers.js";
import { localTime } from "../drawing/local_time.js";
import { tr } from "../words/words.js";
import { link, picture, svg, table, text } from "./parts.js";

const [WIDTH, HEIGHT, LEFT, BELOW, ABOVE] = [1000, 240, 50, 40, 12];
const MOST_PX = 70;

/** @param {object[]} reports of sessions that are over @param {string} id of the one that is looked at */
export function fractionsPicture(reports, id) {
  const all = reports.toSorted((one, other) => one.session.started_at.localeCompare(other.session.started_at)).map(drawn);
  const values = all.flatMap((one) => [one.lower, one.upper, one.level, one.top]).filter(Number.isFinite);
  const [low, high] = [Math.min(0, ...values) - 1, Math.max(1, ...values) + 1];
  const step = Math.min((WIDTH - LEFT) / all.length, 2 * MOST_PX);
  const y = (value) => HEIGHT - BELOW - ((HEIGHT - BELOW - ABOVE) * (value - low)) / (high - low);
  const made = picture(WIDTH, HEIGHT, tr("review.fractions_of", { count: all.length }));
  made.append(svg("line", { x1: LEFT, x2: WIDTH, y1: y(0), y2: y(0), stroke: "var(--draw-zero)" }), text(LEFT - 8, y(0) + 4, "0 mm", "end"));
  all.forEach((one, i) => {
    const x = LEFT + step * (i + 0.5);
    const width = step / 3;
    if (one.id === id) made.append(svg("rect", { x: x - step / 2, y: 0, width: step, height: HEIGHT, fill: "var(--chosen)" }));
    if (Number.isFinite(one.lower)) made.append(svg("rect", { x: x - width, y: y(one.upper), width: 2 * width, height: y(one.lower) - y(one.upper), fill: "var(--draw-inside)", stroke: "var(--draw-window)" }));
    if (Number.isFinite(one.level)) made.append(svg("rect", { x: x - width / 3, y: y(one.top), width: (2 * width) / 3, height: Math.max(y(one.level) - y(one.top), 1), fill: "var(--draw-gated)" }));
    made.append(text(x, HEIGHT - 22, one.name, "middle"), text(x, HEIGHT - 6, one.duty, "middle"));
  });
  const columns = ["fraction", "started", "duty"].map((name) => ({ name: tr(`office.${name}`) }));
  const numbers = ["review.window_mm", "office.amplitude", "review.level"].map((name) => ({ name: tr(name), isNumber: true }));
  const rows = all.map((one) => [one.id === id ? one.name : link(one.name, `#session/${one.id}`), one.started, one.duty, Number.isFinite(one.lower) ? tr("review.to", { lower: fixed(one.lower), upper: fixed(one.upper) }) : "–", number(one.top - one.level), number(one.level)]);
  return [made, part("p", tr("review.fractions_note"), "note"), table([...columns, ...numbers], rows)];
}

const number = (value) => (Number.isFinite(value) ? fixed(value) : "–");

/** What is drawn of a report: the last window, the level at the end of the session, and the top of its breath. */
function drawn({ session, windows, figures }) {
  const { lower, upper } = windows.at(-1) ?? {};
  const level = figures.baseline_last ?? NaN;
  return {
    id: session.id, name: session.fraction_id, started: localTime(session.started_at),
    lower: lower ?? NaN, upper: upper ?? NaN, level, top: level + (figures.amplitude?.median ?? NaN),
    duty: figures.duty_percent === null ? "–" : `${fixed(figures.duty_percent, 0)} %`,
  };
}
