/** Fills tables of text in place, so that a reader keeps its place. */

import { part, setText } from "./elements.js";

/** Put rows into a table, the first row and the first column as headings; a table without rows is not shown. */
export function fillTable(table, rows) {
  table.hidden = rows.length < 2;
  while (table.rows.length > rows.length) table.deleteRow(-1);
  for (const [r, texts] of rows.entries()) {
    const line = table.rows[r] ?? table.insertRow();
    while (line.cells.length > texts.length) line.deleteCell(-1);
    for (const [c, text] of texts.entries()) setText(line.cells[c] ?? line.appendChild(cell(r, c)), text);
  }
}

function cell(row, column) {
  const isHeading = row === 0 || column === 0;
  const element = part(isHeading ? "th" : "td", "");
  if (isHeading) element.scope = row === 0 ? "col" : "row";
  return element;
}
