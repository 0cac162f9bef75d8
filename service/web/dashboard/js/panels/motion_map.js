/** The motion map and its legend: one cell per region, superior at the top, the patient's right on the left. */

import { font, hatch, INK, isUnseen, note, prepare, UNSEEN } from "../drawing/canvas.js";
import { signed } from "../drawing/numbers.js";
import { colorOf } from "../drawing/color_scale.js";
import { tr } from "../words/words.js";

const LABEL_PX = 16;

export class GridPanel {
  constructor(canvas, legend, readout) {
    this.canvas = canvas;
    this.legend = legend;
    this.readout = readout;
    this.pointer = null;
    canvas.addEventListener("pointermove", (event) => {
      this.pointer = [event.offsetX, event.offsetY];
    });
    canvas.addEventListener("pointerleave", () => {
      this.pointer = null;
    });
  }

  /** @param {number[][]} unseenCells [row, column] of cells that the camera does not see: their motion is extrapolated */
  draw(regionsMm, rangeMm, window, unseenCells) {
    this.#drawLegend(rangeMm);
    const { context, width, height } = prepare(this.canvas);
    if (!regionsMm || regionsMm.length === 0) {
      note(context, width, height, tr("motion_map.not_measured"));
      this.readout.textContent = "\u00a0";
      return;
    }
    const box = layout(width, height, regionsMm);
    for (const [r, row] of regionsMm.entries()) for (const [c, value] of row.entries()) drawCell(context, box, r, c, value, rangeMm, isUnseen(unseenCells, r, c));
    if (window?.signal === "region") outline(context, box, window.row, window.column);
    drawSides(context, box);
    this.#readOut(box, regionsMm, unseenCells);
  }

  #readOut(box, regionsMm, unseenCells) {
    const column = this.pointer ? Math.floor((this.pointer[0] - box.left) / box.cell) : -1;
    const row = this.pointer ? Math.floor((this.pointer[1] - box.top) / box.cell) : -1;
    const value = regionsMm[row]?.[column];
    const legend = unseenCells.length > 0 ? tr("motion_map.hatched_not_seen") : "\u00a0";
    this.readout.textContent = value === undefined ? legend : tr("motion_map.row_column", { row, column, value: reading(value, isUnseen(unseenCells, row, column)) });
  }

  #drawLegend(rangeMm) {
    const { context, width } = prepare(this.legend);
    const [left, right] = [10, width - 10];
    for (let x = left; x < right; x += 1) {
      context.fillStyle = colorOf((2 * (x - left)) / (right - left) - 1, 1);
      context.fillRect(x, 2, 1.5, 9);
    }
    context.fillStyle = INK.text;
    context.font = font(11);
    context.textBaseline = "top";
    for (const [x, text, align] of [[left, `−${rangeMm}`, "left"], [width / 2, "0 mm", "center"], [right, `+${rangeMm}`, "right"]]) {
      context.textAlign = align;
      context.fillText(text, x, 14);
    }
  }
}

function layout(width, height, regionsMm) {
  const rows = regionsMm.length;
  const columns = regionsMm[0].length;
  const cell = Math.min((width - 2 * LABEL_PX) / columns, (height - LABEL_PX) / rows);
  return { cell, rows, columns, left: (width - cell * columns) / 2, top: LABEL_PX + (height - LABEL_PX - cell * rows) / 2 };
}

function drawCell(context, box, row, column, value, rangeMm, isHidden) {
  const [x, y] = [box.left + column * box.cell, box.top + row * box.cell];
  const fills = Number.isFinite(value) ? [colorOf(value, rangeMm, isHidden ? 0.35 : 1)] : [hatch(context)];
  if (Number.isFinite(value) && isHidden) fills.push(hatch(context, UNSEEN));
  for (const fill of fills) {
    context.fillStyle = fill;
    context.fillRect(x + 0.5, y + 0.5, box.cell - 1, box.cell - 1);
  }
}

function outline(context, box, row, column) {
  context.strokeStyle = INK.text;
  context.lineWidth = 2;
  context.strokeRect(box.left + column * box.cell, box.top + row * box.cell, box.cell, box.cell);
}

function drawSides(context, box) {
  context.fillStyle = INK.faint;
  context.font = font(11);
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(tr("picture.superior"), box.left + (box.cell * box.columns) / 2, box.top - 9);
  context.fillText("R", box.left - 9, box.top + (box.cell * box.rows) / 2);
  context.fillText("L", box.left + box.cell * box.columns + 9, box.top + (box.cell * box.rows) / 2);
}

function reading(value, isHidden) {
  if (!Number.isFinite(value)) return tr("motion_map.not_measured");
  return isHidden ? tr("motion_map.not_seen_mm_extrapolated", { value: signed(value) }) : `${signed(value)} mm`;
}
