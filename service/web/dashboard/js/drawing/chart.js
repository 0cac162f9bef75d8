/**
 * The trace's chart: scales, axes, pointer and selection are uPlot's; what lies below and above the lines is drawn by the
 * caller, in CSS pixels. uPlot sets positions through the elements' style objects, which the page's policy permits.
 */

import uPlot from "../../vendor/uplot/uPlot.esm.js";
import { fixed } from "./numbers.js";
import { font, INK } from "./canvas.js";

/** Space around the plot [px]: left for the values, below for the times. */
const LEFT_PX = 58;
const BELOW_PX = 24;
/** Height of the lane for labels, between the plot and the times [px]. */
export const LANE_PX = 18;
const ABOVE_PX = 12;
const RIGHT_PX = 14;
const VALUE_STEPS = [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100];
const VALUE_SPACE_PX = 32;
const MIN_SIZE_PX = 40;

/**
 * @typedef {{x0: number, x1: number, y0: number, y1: number}} Box the plot [CSS px of the canvas]
 * @typedef {{context: CanvasRenderingContext2D, box: Box, x: (t: number) => number, y: (value: number) => number}} Pen
 */

export class Chart {
  /**
   * @param {HTMLElement} host filled by the chart
   * @param {(() => string)[]} colors of the lines, as they are when drawn, the first one in front
   * @param {{below: (pen: Pen) => void, above: (pen: Pen) => void, times: (from: number, to: number) => {at: number, text: string}[],
   *   hasLabels: () => boolean,
   *   isJoined: (index: number) => boolean, onPress: () => boolean, onSelect: (from: number, to: number) => void, onRelease: () => void}} given
   *   `hasCursor: false` draws no line at the pointer; `onPress` returns false where the pointer is used for something else
   */
  constructor(host, colors, given) {
    Object.assign(this, { host, given, marks: [] });
    this.plot = new uPlot(this.#options(colors), [[], ...colors.map(() => [])], host);
    this.canvas = this.plot.ctx.canvas;
    this.over = this.plot.over;
    new ResizeObserver(() => this.#fit()).observe(host);
    this.#fit();
  }

  /** @param {number[][]} data times [s] and one list of values for each line, null where there is none */
  draw(data, times, values) {
    this.plot.batch(() => {
      this.plot.setData(data, false);
      this.plot.setScale("x", { min: times[0], max: times[1] });
      this.plot.setScale("y", { min: values[0], max: values[1] });
    });
  }

  /** Forget the data, also for a drawing after a change of size, and remove the picture. */
  clear() {
    this.plot.setData(this.plot.data.map(() => []), false);
    this.plot.ctx.clearRect(0, 0, this.canvas.width, this.canvas.height);
  }

  show(isShown) {
    this.plot.root.hidden = !isShown;
  }

  /** Height of a value in the plot [px]. */
  yOf(value) {
    return this.plot.valToPos(value, "y");
  }

  valueAt(y) {
    return this.plot.posToVal(y, "y");
  }

  timeAt(x) {
    return this.plot.posToVal(x, "x");
  }

  /** Distance of the plot from the canvas' upper edge [px]. */
  get top() {
    return ABOVE_PX;
  }

  /** Where the pointer is in the plot [px]; null if it is elsewhere. */
  get pointerX() {
    const { left } = this.plot.cursor;
    return Number.isFinite(left) && left >= 0 ? left : null;
  }

  #fit() {
    const { clientWidth: width, clientHeight: height } = this.host;
    if (width < LEFT_PX + MIN_SIZE_PX || height < MIN_SIZE_PX) return;
    if (width !== this.plot.width || height !== this.plot.height) this.plot.setSize({ width, height });
  }

  #options(colors) {
    const axis = { stroke: () => INK.text, font: font(12), grid: { stroke: () => INK.line, width: 1 }, ticks: { show: false } };
    const lines = colors.map((stroke, i) => ({ stroke, width: i === 0 ? 2 : 1.5, points: { show: false }, spanGaps: true, paths: (...where) => this.#path(...where) }));
    return {
      width: 600,
      height: 200,
      pxAlign: 0,
      padding: [ABOVE_PX, RIGHT_PX, 0, 0],
      legend: { show: false },
      scales: { x: { time: false, auto: false }, y: { auto: false } },
      // uPlot draws later series in front.
      series: [{}, ...lines.toReversed()],
      axes: [
        {
          ...axis, stroke: () => INK.faint, size: BELOW_PX + LANE_PX, gap: 6 + LANE_PX, grid: { show: false }, ticks: { show: true, stroke: () => INK.line, width: 1, size: 4 },
          splits: (_, __, from, to) => (this.marks = this.given.times(from, to)).map(({ at }) => at),
          values: () => this.marks.map(({ text }) => text),
        },
        {
          ...axis, size: LEFT_PX, gap: 7, incrs: VALUE_STEPS, space: VALUE_SPACE_PX,
          values: (_, values, __, ___, step) => values.map((value) => (this.given.hasLabels() ? fixed(value, step < 0.1 ? 2 : step < 1 ? 1 : 0) : "")),
        },
      ],
      cursor: { x: this.given.hasCursor !== false, y: false, points: { show: false }, drag: { x: true, y: false, setScale: false, dist: 6 }, bind: this.#bindings() },
      hooks: {
        drawAxes: [() => this.#with(this.given.below)],
        draw: [() => this.#with(this.given.above)],
        setSelect: [(plot) => this.#select(plot)],
      },
    };
  }

  #bindings() {
    return {
      dblclick: () => null,
      mousedown: (_, __, handle) => (event) => {
        if (event.button === 0 && this.given.onPress()) handle(event);
      },
      mouseup: (_, __, handle) => (event) => {
        handle(event);
        this.given.onRelease();
      },
    };
  }

  #select(plot) {
    const { left, width } = plot.select;
    if (width <= 0) return;
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.given.onSelect(this.timeAt(left), this.timeAt(left + width));
  }

  /** Call `paint` with a pen in CSS pixels, clipped to the plot. */
  #with(paint) {
    const { ctx: context, bbox } = this.plot;
    const ratio = uPlot.pxRatio;
    const [left, top, width, height] = [bbox.left, bbox.top, bbox.width, bbox.height].map((one) => one / ratio);
    context.save();
    context.scale(ratio, ratio);
    const box = { x0: left, x1: left + width, y0: top, y1: top + height };
    paint({ context, box, x: (t) => left + this.plot.valToPos(t, "x"), y: (value) => top + this.yOf(value) });
    context.restore();
  }

  /**
   * A line that joins two samples only if they are joined: each piece begins with a new point, so that nothing is ever
   * drawn across a gap. More than four samples a pixel are drawn as their extremes.
   */
  #path(plot, series, first, last) {
    const stroke = new Path2D();
    const [times, values] = [plot.data[0], plot.data[series]];
    const { left, width } = plot.bbox;
    const { min, max } = plot.scales.x;
    const perSecond = width / (max - min);
    const x = (i) => left + (times[i] - min) * perSecond;
    const y = (value) => plot.valToPos(value, "y", true);
    const isDense = last - first > 4 * width;
    let column = null;
    const flush = () => {
      if (column !== null && column.low !== column.high) {
        stroke.lineTo(column.x, y(column.low));
        stroke.lineTo(column.x, y(column.high));
        stroke.lineTo(column.x, y(column.end));
      }
      column = null;
    };
    for (let i = first; i <= last; i += 1) {
      const value = values[i];
      if (!Number.isFinite(value)) continue;
      const isOpen = i > first && Number.isFinite(values[i - 1]) && this.given.isJoined(i);
      const at = isDense ? Math.round(x(i)) : x(i);
      if (isOpen && isDense && column?.x === at) {
        column.low = Math.min(column.low, value);
        column.high = Math.max(column.high, value);
        column.end = value;
        continue;
      }
      flush();
      if (isOpen) stroke.lineTo(at, y(value));
      else {
        stroke.moveTo(at - 0.5, y(value));
        stroke.lineTo(at + 0.5, y(value));
      }
      if (isDense) column = { x: at, low: value, high: value, end: value };
    }
    flush();
    return { stroke, fill: null, clip: null, band: null, gaps: null, flags: 0 };
  }
}
