/**
 * The quality of the model in use: its deepest breath, measured beside reconstructed, the map of their difference, the
 * spectrum and the figures of the training. Opened by a button; read once for each model.
 */

import { readModel, readQualityMaps, readSpectrum } from "../api.js";
import { prepare, hatch, note } from "../drawing/canvas.js";
import { colorOf, stepFor } from "../drawing/color_scale.js";
import { byId, part, setText } from "../drawing/elements.js";
import { fillTable } from "../drawing/table.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

const CELL_ROWS = 14;
const CELL_COLUMNS = 8;
const SHOWN_COMPONENTS = 4;

export class ModelQuality {
  constructor() {
    Object.assign(this, { root: byId("quality"), openers: [...document.querySelectorAll(".to-quality")], opener: null, modelId: null, maps: null });
    for (const opener of this.openers) opener.addEventListener("click", () => this.#open(opener));
    byId("quality-close").addEventListener("click", () => this.close());
    window.addEventListener("resize", () => this.#draw());
  }

  /** Follow the model in use; null for none, which closes the panel. */
  follow(modelId) {
    if (modelId === this.modelId) return;
    Object.assign(this, { modelId, maps: null });
    for (const opener of this.openers) opener.hidden = modelId === null;
    if (modelId === null) this.close();
    else if (!this.root.hidden) this.#read(modelId);
  }

  #open(opener) {
    if (this.modelId === null) return;
    this.opener = opener;
    this.root.hidden = false;
    byId("quality-heading").focus();
    this.#read(this.modelId);
  }

  /** @returns {boolean} whether it was open */
  close() {
    const wasOpen = !this.root.hidden;
    this.root.hidden = true;
    this.#clear("");
    if (wasOpen) this.#focusOpener();
    return wasOpen;
  }

  /** The panel covered the one with the button, which was inert and could not have the focus. */
  #focusOpener() {
    this.opener.closest(".panel").inert = false;
    if (this.opener.checkVisibility()) this.opener.focus();
  }

  #clear(text) {
    this.maps = null;
    setText(byId("quality-note"), text);
    byId("quality-figures").replaceChildren();
    fillTable(byId("quality-table"), []);
    byId("quality-maps").hidden = true;
  }

  async #read(id) {
    this.#clear(tr("quality.reading"));
    try {
      const [model, spectrum, maps] = await Promise.all([readModel(id), readSpectrum(id), readQualityMaps(id)]);
      if (this.modelId === id && !this.root.hidden) this.#show(model, spectrum.share, maps);
    } catch (error) {
      if (this.modelId === id && !this.root.hidden) setText(byId("quality-note"), tr("quality.not_read", { reason: error.message }));
    }
  }

  #show(model, share, maps) {
    byId("quality-figures").replaceChildren(...figures(model, share).flatMap(([name, value]) => [part("dt", name), part("dd", value)]));
    const hasMaps = maps.measured_mm !== null && maps.reconstructed_mm !== null && maps.residual_mm !== null;
    byId("quality-maps").hidden = !hasMaps;
    setText(byId("quality-note"), hasMaps ? "" : tr("quality.no_maps"));
    if (!hasMaps) return;
    this.maps = maps;
    fillTable(byId("quality-table"), cells(maps.residual_mm));
    this.#draw();
  }

  #draw() {
    if (this.maps === null || this.root.hidden) return;
    const { measured_mm: measured, reconstructed_mm: reconstructed, residual_mm: residual } = this.maps;
    const heightMm = stepFor(quantile(reconstructed.flat().map(Math.abs), 0.98));
    const residualMm = stepFor(quantile(residual.flat().filter(Number.isFinite), 0.95));
    draw(byId("quality-measured"), measured, heightMm);
    draw(byId("quality-reconstructed"), reconstructed, heightMm);
    draw(byId("quality-residual"), residual, residualMm);
    setText(byId("quality-height-range"), tr("quality.height_range", { range: heightMm }));
    setText(byId("quality-reconstructed-range"), tr("quality.height_range", { range: heightMm }));
    setText(byId("quality-residual-range"), tr("quality.residual_range", { range: residualMm }));
  }
}

function figures(model, shares) {
  const { quality } = model;
  const found = [[tr("quality.number"), String(model.number)]];
  if (model.training_frames !== null) found.push([tr("quality.trained_on"), tr("count.frames", { n: model.training_frames })]);
  if (quality !== null) {
    found.push([tr("quality.breathing"), `${fixed(quality.amplitude_mm, 1)} mm`], [tr("quality.noise"), `${fixed(quality.noise_mm, 2)} mm`]);
    found.push([tr("quality.explained"), `${fixed(100 * quality.explained_share, 1)} %`], [tr("quality.misfit"), `${fixed(quality.residual_mm, 2)} mm`]);
    found.push([tr("quality.left_out"), `${fixed(100 * quality.outlier_share, 0)} %`]);
  }
  const spectrum = shares.slice(0, SHOWN_COMPONENTS).map((one) => fixed(100 * one, 1)).join(", ");
  return [...found, [tr("quality.spectrum"), `${spectrum} %`]];
}

/** The value below which this share of the values lies. */
function quantile(values, share) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))] ?? 0;
}

/** Draw a map in its box, keeping its proportions; what was not measured is hatched. */
function draw(canvas, map, rangeMm) {
  const { context, width, height } = prepare(canvas);
  const [rows, columns] = [map.length, map[0]?.length ?? 0];
  if (rows === 0 || columns === 0) return note(context, width, height, tr("motion_map.not_measured"));
  const step = Math.min(width / columns, height / rows);
  const [left, top] = [(width - step * columns) / 2, (height - step * rows) / 2];
  context.fillStyle = hatch(context);
  context.fillRect(left, top, step * columns, step * rows);
  for (const [row, values] of map.entries()) {
    for (const [column, value] of values.entries()) {
      if (value === null) continue;
      context.fillStyle = colorOf(value, rangeMm);
      const [x, y] = [Math.round(left + column * step), Math.round(top + row * step)];
      context.fillRect(x, y, Math.round(left + (column + 1) * step) - x, Math.round(top + (row + 1) * step) - y);
    }
  }
  return undefined;
}

/** Root mean square of the difference in each cell, as rows of text. */
function cells(residual) {
  const [rows, columns] = [residual.length, residual[0].length];
  const sums = Array.from({ length: CELL_ROWS }, () => Array.from({ length: CELL_COLUMNS }, () => ({ square: 0, count: 0 })));
  for (const [row, values] of residual.entries()) {
    for (const [column, value] of values.entries()) {
      if (value === null) continue;
      const cell = sums[Math.floor((row * CELL_ROWS) / rows)][Math.floor((column * CELL_COLUMNS) / columns)];
      cell.square += value ** 2;
      cell.count += 1;
    }
  }
  const head = [tr("tables.row"), ...Array.from({ length: CELL_COLUMNS }, (_, column) => String(column))];
  const text = ({ square, count }) => (count === 0 ? tr("motion_map.not_measured") : fixed(Math.sqrt(square / count), 2));
  return [head, ...sums.map((line, row) => [String(row), ...line.map(text)])];
}
