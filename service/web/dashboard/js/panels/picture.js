/** The camera's colour picture with the outline of the region and its motion as a colour overlay. */

import { fetchPicture } from "../api.js";
import { font, hatch, INK, isUnseen, note, prepare, UNSEEN } from "../drawing/canvas.js";
import { projectiveMap } from "../drawing/projection.js";
import { colorOf } from "../drawing/color_scale.js";
import { fixed } from "../drawing/numbers.js";
import { tr } from "../words/words.js";

/** Period of fetching pictures [ms]: fast enough to see a hand or a sheet, slow enough for the live stream. */
const PERIOD_MS = 250;
const OLD_MS = 1500;
const REMEMBERED = 90;

export class PicturePanel {
  constructor(canvas, overlay) {
    this.canvas = canvas;
    this.overlay = overlay;
    this.sessionId = null;
    this.isWanted = false;
    this.reset();
  }

  reset() {
    this.picture = null;
    this.recent = [];
  }

  /** Show the pictures of this session; null for none. Nothing is fetched while the controller does not answer. */
  follow(sessionId, isWanted) {
    this.isWanted = isWanted;
    if (sessionId === this.sessionId) return;
    this.sessionId = sessionId;
    this.reset();
  }

  /** Keep the outlines of the last seconds: a picture arrives later than the frame it belongs to. */
  add(sample) {
    this.recent.push(sample);
    if (this.recent.length > REMEMBERED) this.recent.shift();
  }

  /** Fetch pictures in an endless loop; pause while the page is hidden or there is no session. */
  async run() {
    for (;;) {
      const startedMs = performance.now();
      if (this.sessionId !== null && this.isWanted && !document.hidden) await this.#fetchOne(this.sessionId);
      await pause(Math.max(50, PERIOD_MS - (performance.now() - startedMs)));
    }
  }

  async #fetchOne(sessionId) {
    try {
      const answer = await fetchPicture(sessionId);
      if (answer === null) return;
      const bitmap = await createImageBitmap(answer.blob);
      if (sessionId !== this.sessionId) return;
      this.picture?.bitmap.close();
      this.picture = { bitmap, frameIndex: answer.frameIndex, atMs: performance.now() };
    } catch {
      // No picture this time. The panel shows the age of the last one; the gate does not depend on it.
    }
  }

  /** @param {?string} head side of the picture at which the patient's head lies; null if unknown */
  draw(nowMs, rangeMm, isFresh, head) {
    const { context, width, height } = prepare(this.canvas);
    if (this.picture === null) {
      note(context, width, height, this.sessionId === null ? tr("picture.no_session") : tr("picture.waiting_for_the_camera_s_picture"));
      return;
    }
    const { bitmap } = this.picture;
    const zoom = Math.min(width / bitmap.width, height / bitmap.height);
    const [left, top] = [(width - bitmap.width * zoom) / 2, (height - bitmap.height * zoom) / 2];
    const isOld = nowMs - this.picture.atMs > OLD_MS || !isFresh;
    context.save();
    context.globalAlpha = isOld ? 0.3 : 0.85;
    context.drawImage(bitmap, left, top, bitmap.width * zoom, bitmap.height * zoom);
    context.restore();
    if (isOld) {
      banner(context, left, top, bitmap.width * zoom, isFresh ? tr("picture.picture_is_old_s", { value: fixed((nowMs - this.picture.atMs) / 1000, 1) }) : tr("picture.not_the_present_picture"));
      return;
    }
    drawHead(context, { left, top, width: bitmap.width * zoom, height: bitmap.height * zoom }, head);
    const sample = this.#sampleOf(this.picture.frameIndex);
    const map = sample && projectiveMap(sample.roi_px);
    if (!map) {
      banner(context, left, top, bitmap.width * zoom, tr("picture.region_not_found"));
      return;
    }
    const place = (u, v) => {
      const [px, py] = map(u, v);
      // Pixel centres are at integers, a canvas counts from the corner of the first pixel.
      return [left + (px + 0.5) * zoom, top + (py + 0.5) * zoom];
    };
    if (this.overlay.checked && sample.regions_mm) drawCells(context, place, sample.regions_mm, rangeMm, sample.unseen_cells ?? []);
    drawOutline(context, place, head !== null);
  }

  #sampleOf(frameIndex) {
    if (!Number.isFinite(frameIndex)) return this.recent.at(-1) ?? null;
    const nearest = this.recent.reduce((best, sample) => (gap(sample, frameIndex) < gap(best, frameIndex) ? sample : best), this.recent[0]);
    return nearest && gap(nearest, frameIndex) <= 3 ? nearest : null;
  }
}

function gap(sample, frameIndex) {
  return Math.abs(sample.frame_index - frameIndex);
}

function drawCells(context, place, regionsMm, rangeMm, unseenCells) {
  const blind = hatch(context, UNSEEN);
  const rows = regionsMm.length;
  for (const [r, row] of regionsMm.entries()) {
    for (const [c, value] of row.entries()) {
      path(context, [place(c / row.length, r / rows), place((c + 1) / row.length, r / rows), place((c + 1) / row.length, (r + 1) / rows), place(c / row.length, (r + 1) / rows)]);
      context.fillStyle = Number.isFinite(value) && !isUnseen(unseenCells, r, c) ? colorOf(value, rangeMm, 0.62) : blind;
      context.fill();
    }
  }
}

/** Name the side of the head; the person who arms confirms it. */
function drawHead(context, { left, top, width, height }, head) {
  if (head === null) {
    label(context, tr("picture.head_direction_unknown"), [left + width / 2, top + height - 12], [0, 0]);
    return;
  }
  const edge = { top: [left + width / 2, top + 14], bottom: [left + width / 2, top + height - 14], left: [left + 28, top + height / 2], right: [left + width - 28, top + height / 2] };
  label(context, "HEAD", edge[head], [0, 0], 16);
}

/** @param {boolean} isOriented whether the head direction is known: otherwise the region's ends and sides are not */
function drawOutline(context, place, isOriented) {
  const corners = [place(0, 0), place(1, 0), place(1, 1), place(0, 1)];
  path(context, corners);
  context.strokeStyle = "#e9f3fb";
  context.lineWidth = 1.5;
  context.stroke();
  for (const [x, y] of corners) {
    context.beginPath();
    context.arc(x, y, 5, 0, 2 * Math.PI);
    context.stroke();
  }
  if (!isOriented) return;
  label(context, tr("picture.superior"), between(corners[0], corners[1]), [0, -10]);
  label(context, "R", between(corners[0], corners[3]), [-12, 0]);
  label(context, "L", between(corners[1], corners[2]), [12, 0]);
}

function between([ax, ay], [bx, by]) {
  return [(ax + bx) / 2, (ay + by) / 2];
}

function label(context, text, [x, y], [dx, dy], size = 12) {
  context.font = font(size, 600);
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.lineWidth = 3;
  context.strokeStyle = "rgba(0, 0, 0, 0.75)";
  context.strokeText(text, x + dx, y + dy);
  context.fillStyle = "#ffffff";
  context.fillText(text, x + dx, y + dy);
}

function path(context, corners) {
  context.beginPath();
  for (const [x, y] of corners) context.lineTo(x, y);
  context.closePath();
}

function banner(context, x, y, width, text) {
  context.fillStyle = "rgba(8, 12, 16, 0.78)";
  context.fillRect(x, y, width, 28);
  context.fillStyle = "#e9f3fb";
  context.font = font(13, 600);
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(text, x + width / 2, y + 14);
}

function pause(ms) {
  return new Promise((resolve) => {
    setTimeout(resolve, ms);
  });
}
