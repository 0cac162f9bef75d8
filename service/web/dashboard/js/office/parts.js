/** What the rooms of the office are made of: sections, tables, fields, and lists that go on by pages. */

import { part, pushButton, setText } from "../drawing/elements.js";
import { localTime } from "../drawing/local_time.js";
import { tr } from "../words/words.js";

/** A section with a heading. */
export function section(heading, ...children) {
  const made = part("section", "");
  made.append(...(heading === "" ? [] : [part("h2", heading)]), ...children);
  return made;
}

/**
 * A table that a column's head sorts by, and the other way at the second press.
 *
 * @param {{name: string, isNumber?: boolean, isLong?: boolean}[]} columns of numbers, or of texts that may wrap @param {(string|Node)[][]} rows
 */
export function table(columns, rows) {
  const made = part("table", "");
  const head = made.createTHead().insertRow();
  columns.forEach(({ name, isNumber }, place) => {
    const cell = part("th", "", isNumber ? "number" : "");
    cell.scope = "col";
    cell.append(name === "" ? "" : pushButton(name, () => sort(made, cell, place)));
    head.append(cell);
  });
  const body = made.createTBody();
  for (const row of rows) body.append(line(columns, row));
  const wide = part("div", "", "wide");
  wide.tabIndex = 0;
  wide.append(made);
  return wide;
}

/** Sort by a column: numbers by their value, times by theirs where the cell states it, texts as the language has them. */
function sort(made, head, place) {
  const way = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
  for (const one of made.tHead.rows[0].cells) one.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", way === 1 ? "ascending" : "descending");
  const isNumber = head.className === "number";
  const keys = new Map([...made.tBodies[0].rows].map((row) => [row, keyOf(row.cells[place], isNumber)]));
  const { compare } = new Intl.Collator(document.documentElement.lang, { numeric: true });
  const order = isNumber ? (one, other) => one - other : compare;
  made.tBodies[0].append(...[...keys.keys()].sort((one, other) => way * order(keys.get(one), keys.get(other))));
}

function keyOf(cell, isNumber) {
  const words = cell.querySelector("time")?.dateTime ?? cell.textContent;
  const digits = words.replace("−", "-").replace(",", ".").match(/-?[\d.]+/);
  return isNumber ? Number(digits ?? -Infinity) : words;
}

/** A time that a table sorts by. */
export function timed(at) {
  return Object.assign(part("time", localTime(at)), { dateTime: at ?? "" });
}

function line(columns, row) {
  const made = part("tr", "");
  row.forEach((content, i) => {
    const cell = part("td", "", columns[i].isNumber ? "number" : columns[i].isLong ? "long" : "");
    if (content instanceof Node) cell.append(content);
    else setText(cell, content);
    made.append(cell);
  });
  return made;
}

export function link(text, href, isDownload = false) {
  const made = part("a", text);
  made.href = href;
  if (isDownload) made.download = "";
  return made;
}

/** A labelled input or select. */
export function field(text, input, name) {
  const made = part("label", text);
  input.name = name;
  made.append(input);
  return made;
}

export function typed(type, maxLength = 80) {
  const made = document.createElement("input");
  made.type = type;
  if (type === "text" || type === "search") Object.assign(made, { maxLength, spellcheck: false });
  return made;
}

/** @param {[string, string][]} options value and text */
export function chosen(options) {
  const made = document.createElement("select");
  made.append(...options.map(([value, text]) => new Option(text, value)));
  return made;
}

/** A form whose fields are sent as an object of what is not empty. */
export function form(fields, button, onSubmit) {
  const made = part("form", "");
  const submit = part("button", button, "go");
  submit.type = "submit";
  made.append(...fields, submit);
  made.addEventListener("submit", (event) => {
    event.preventDefault();
    onSubmit(Object.fromEntries([...new FormData(made)].filter(([, value]) => value !== "")), submit);
  });
  return made;
}

/** Words for a verdict, in its colour. */
export function verdict(name) {
  return part("strong", tr(`qa.verdict.${name}`), { pass: "good", warn: "look", fail: "bad" }[name] ?? "look");
}

/**
 * A place that shows what a call answers: "reading", then what `made` makes of it, or why there is nothing.
 *
 * @param {AbortSignal} ended no answer is shown after it
 */
export async function filled(place, ended, read, made) {
  setText(place, tr("office.reading"));
  try {
    const answer = await read();
    if (!ended.aborted) place.replaceChildren(...[made(answer)].flat());
  } catch (error) {
    if (!ended.aborted) setText(place, error.message);
  }
}

/** A time's bounds from two dates of this screen: from the beginning of the first to the end of the last. */
export function between(since, until) {
  const day = (date, later) => new Date(`${date}T00:00`).setDate(Number(date.slice(8)) + later);
  return Object.fromEntries([["since", since, 0], ["until", until, 1]].filter(([, date]) => date).map(([name, date, later]) => [name, new Date(day(date, later)).toISOString()]));
}

/** Rows page by page, with a button for the next one. @param {() => void} onShown called after each page */
export function pages(place, ended, columns, read, row, empty, onShown = () => {}) {
  const rows = [];
  const next = async (cursor) => {
    await filled(place, ended, () => read(cursor), ({ items, next_cursor: following }) => {
      rows.push(...items.map(row));
      if (rows.length === 0) return part("p", empty, "note");
      if (following === null) return table(columns, rows);
      const more = part("button", tr("office.more"));
      more.type = "button";
      more.addEventListener("click", () => next(following));
      return [table(columns, rows), more];
    });
    if (!ended.aborted) onShown();
  };
  next(null);
}

const SVG = "http://www.w3.org/2000/svg";

export function svg(name, attributes) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

/** An empty picture with a name for those who do not see it. */
export function picture(width, height, title) {
  const made = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img" });
  made.append(Object.assign(svg("title", {}), { textContent: title }));
  return made;
}

export function text(x, y, words, anchor) {
  return Object.assign(svg("text", { x, y, "text-anchor": anchor }), { textContent: words });
}
