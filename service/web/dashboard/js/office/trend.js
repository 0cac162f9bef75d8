/** A check over its runs: values against the expected one, with the limits that each run was judged by. */

import { part } from "../drawing/elements.js";
import { fixed } from "../drawing/numbers.js";
import { localTime } from "../drawing/local_time.js";
import { tr } from "../words/words.js";
import { picture, svg, table, text, verdict } from "./parts.js";

const [WIDTH, HEIGHT, LEFT, BELOW, ABOVE] = [1000, 260, 70, 30, 16];
const INKS = { pass: "var(--on)", warn: "var(--hold-text)", fail: "var(--bad)" };

/** @param {{title: string, unit: string, sidedness: string, items: object[]}} trend the newest run first or last */
export function trendPicture(trend) {
  const runs = trend.items.filter((one) => one.value !== null).toSorted((a, b) => a.at.localeCompare(b.at));
  if (runs.length === 0) return [part("p", tr("office.no_value_in_runs", { count: trend.items.length }))];
  const limits = runs.flatMap((one) => (trend.sidedness === "absolute" ? [middle(one) - one.fail, middle(one) + one.fail] : [0, one.fail]));
  const [low, high] = [Math.min(...limits, ...runs.map((one) => one.value)), Math.max(...limits, ...runs.map((one) => one.value))];
  const span = high - low || 1;
  const x = (i) => LEFT + ((WIDTH - LEFT - 20) * (runs.length === 1 ? 0.5 : i / (runs.length - 1)));
  const y = (value) => HEIGHT - BELOW - ((HEIGHT - BELOW - ABOVE) * (value - low)) / span;
  const made = picture(WIDTH, HEIGHT, tr("office.trend_of", { title: trend.title, count: runs.length }));
  const sides = trend.sidedness === "absolute" ? [-1, 1] : [1];
  for (const [name, ink, dash] of [["warn", INKS.warn, "6 5"], ["fail", INKS.fail, "none"]]) {
    for (const side of sides) made.append(path(runs.map((one, i) => [x(i), y((trend.sidedness === "absolute" ? middle(one) : 0) + side * one[name])]), ink, dash));
  }
  made.append(path(runs.map((one, i) => [x(i), y(one.value)]), "var(--faint)", "none"));
  runs.forEach((one, i) => made.append(svg("circle", { cx: x(i), cy: y(one.value), r: 5, fill: INKS[one.verdict] })));
  for (const value of [low, (low + high) / 2, high]) made.append(text(LEFT - 8, y(value) + 4, fixed(value, span < 10 ? 2 : 0), "end"));
  for (const i of new Set([0, runs.length - 1])) made.append(text(x(i), HEIGHT - 8, runs[i].at.slice(0, 10), i === 0 ? "start" : "end"));
  return [made, listed(trend, runs)];
}

const middle = (one) => one.expected ?? 0;

function path(points, stroke, dash) {
  return svg("polyline", { points: points.map((one) => one.map((value) => value.toFixed(1)).join(",")).join(" "), fill: "none", stroke, "stroke-width": 1.5, "stroke-dasharray": dash });
}

/** The same as numbers, for those who do not see the picture. */
function listed(trend, runs) {
  const details = part("details", "");
  const columns = [{ name: tr("office.time") }, { name: tr("office.value"), isNumber: true }, { name: tr("office.verdict") }];
  details.append(part("summary", tr("office.as_table")), table(columns, runs.toReversed().map((one) => [localTime(one.at), `${fixed(one.value, 3)} ${trend.unit}`, verdict(one.verdict)])));
  return details;
}
