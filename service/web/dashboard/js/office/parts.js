/** What the rooms of the office are made of: sections, tables, fields, and lists that go on by pages. */

import { part, setText } from "../drawing/elements.js";
import { tr } from "../words/words.js";

/** A section with a heading. */
export function section(heading, ...children) {
  const made = part("section", "");
  made.append(part("h2", heading), ...children);
  return made;
}

/** @param {{name: string, isNumber?: boolean, isLong?: boolean}[]} columns of numbers, or of texts that may wrap @param {(string|Node)[][]} rows */
export function table(columns, rows) {
  const made = part("table", "");
  const head = made.createTHead().insertRow();
  for (const { name, isNumber } of columns) {
    const cell = part("th", name, isNumber ? "number" : "");
    cell.scope = "col";
    head.append(cell);
  }
  const body = made.createTBody();
  for (const row of rows) body.append(line(columns, row));
  const wide = part("div", "", "wide");
  wide.tabIndex = 0;
  wide.append(made);
  return wide;
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

/** Rows page by page, with a button for the next one. */
export function pages(place, ended, columns, read, row, empty) {
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
  };
  next(null);
}
