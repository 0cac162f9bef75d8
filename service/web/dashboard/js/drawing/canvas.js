/** Canvas set-up for any pixel density, and the hatching that means "not measured". */

import { ink, palette } from "./theme.js";

export const INK = palette({ text: "--draw-text", faint: "--draw-faint", line: "--draw-grid", panel: "--panel" });

/**
 * Match a canvas to the box it is shown in and return its context, scaled to CSS pixels and cleared.
 *
 * @returns {{context: CanvasRenderingContext2D, width: number, height: number}}
 */
export function prepare(canvas) {
  const width = canvas.clientWidth;
  const height = canvas.clientHeight;
  const ratio = window.devicePixelRatio || 1;
  const wide = Math.max(1, Math.round(width * ratio));
  const high = Math.max(1, Math.round(height * ratio));
  if (canvas.width !== wide || canvas.height !== high) {
    canvas.width = wide;
    canvas.height = high;
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

/** The page's font; nothing is drawn smaller than 13 px. */
export function font(sizePx, weight = 400) {
  return `${weight} ${Math.max(sizePx, 13)}px Inter, system-ui, "DejaVu Sans", sans-serif`;
}

const hatches = new Map();

/** Return the pattern for areas that were not measured. */
export function hatch(context, color = ink("--draw-gap")) {
  let tile = hatches.get(color);
  if (tile === undefined) {
    tile = new OffscreenCanvas(8, 8);
    const pen = tile.getContext("2d");
    pen.strokeStyle = color;
    pen.lineWidth = 1.2;
    pen.beginPath();
    for (const shift of [-8, 0, 8]) {
      pen.moveTo(shift, 8);
      pen.lineTo(shift + 8, 0);
    }
    pen.stroke();
    hatches.set(color, tile);
  }
  return context.createPattern(tile, "repeat");
}

/** Ink of the hatching of cells that the camera does not see, over a picture or a colour. */
export const UNSEEN = "rgba(235, 240, 245, 0.55)";

/** Return whether a cell is among those the camera does not see. */
export function isUnseen(unseenCells, row, column) {
  return unseenCells.some(([r, c]) => r === row && c === column);
}

/** Draw a text in the centre of an empty canvas. */
export function note(context, width, height, text) {
  context.fillStyle = INK.faint;
  context.font = font(13);
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(text, width / 2, height / 2);
}
