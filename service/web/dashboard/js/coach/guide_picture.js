/**
 * Draws the guidance into an SVG: bar or curve, comfort band, word and countdown. The patient's page and the console's mirror
 * draw with this module, so that they show the same.
 *
 * States differ in shape as well as in colour: inside the band its border is solid, outside dashed.
 */

import { word } from "../words/words.js";
import { CURVE_MS } from "./guidance.js";

const SVG = "http://www.w3.org/2000/svg";
/** The picture's size, and where things are in it [units of the viewBox]. */
const WIDTH = 1600;
const HEIGHT = 900;
const BAR = { left: 140, width: 250, top: 60, bottom: 840, bandLeft: 60, bandWidth: 410 };
const CURVE = { left: 60, right: 1540, now: 1420, top: 50, bottom: 590 };
const PLACES = {
  bar: { word: [1040, 400], ring: [1040, 650], radius: 140 },
  curve: { word: [640, 790], ring: [1380, 745], radius: 115 },
};
/** A gap in the frames is a gap in the curve [ms]. */
const GAP_MS = 300;
const INSTRUCTIONS = new Set(["breathe_in", "hold", "breathe_out", "breathe_freely"]);

export class GuidePicture {
  /** @param {HTMLElement} root element that the picture fills; its data-show says what is shown */
  constructor(root) {
    this.root = root;
    this.drawn = "";
    this.calm = window.matchMedia("(prefers-reduced-motion: reduce)");
    const svg = make("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, "aria-hidden": "true" });
    this.band = make("rect", { class: "band", rx: 10 });
    this.track = make("rect", { class: "track", x: BAR.left, width: BAR.width, y: BAR.top, height: BAR.bottom - BAR.top, rx: 20 });
    this.fill = make("rect", { class: "fill", x: BAR.left + 20, width: BAR.width - 40 });
    this.mark = make("rect", { class: "mark", x: BAR.left - 30, width: BAR.width + 60, height: 18, rx: 9 });
    this.line = make("polyline", { class: "line" });
    this.dot = make("circle", { class: "mark", cx: CURVE.now, r: 26 });
    this.word = make("text", { class: "word" });
    this.rail = make("circle", { class: "rail" });
    this.ring = make("circle", { class: "ring", pathLength: 1 });
    this.seconds = make("text", { class: "seconds" });
    this.practice = make("text", { class: "practice", x: WIDTH - 30, y: 80 });
    this.wait = make("text", { class: "wait", x: WIDTH / 2, y: HEIGHT / 2 });
    this.guide = make("g", { class: "guide" });
    this.guide.append(this.track, this.band, this.fill, this.line, this.mark, this.dot, this.word, this.rail, this.ring, this.seconds, this.practice);
    svg.append(this.guide, this.wait);
    root.replaceChildren(svg);
    root.dataset.show = "blank";
  }

  /** @param {{show: string, guide: ?object, curve: object[]}} view as `Guidance.view` returns it */
  draw(view, language, nowMs) {
    const key = `${view.show} ${view.guide?.sequence ?? ""} ${language} ${this.calm.matches}`;
    if (key === this.drawn) return;
    this.drawn = key;
    this.#text(this.wait, view.show === "wait" ? word(language, "patient.wait") : "");
    if (view.show === "guide") this.#drawGuide(view, nowMs);
    else this.#clear();
    this.root.dataset.show = view.show;
    this.root.dataset.sequence = String(view.guide?.sequence ?? "");
  }

  #drawGuide({ guide, curve }, nowMs) {
    const isBar = guide.display === "bar" || this.calm.matches;
    const { word: [x, y], ring, radius } = PLACES[isBar ? "bar" : "curve"];
    this.root.dataset.display = isBar ? "bar" : "curve";
    this.#drawBand(guide, isBar);
    if (isBar) this.#drawBar(guide.level);
    else this.#drawCurve(curve, guide.level, nowMs);
    const text = INSTRUCTIONS.has(guide.instruction) ? word(guide.language, `patient.${guide.instruction}`) : "";
    this.root.dataset.instruction = guide.instruction;
    set(this.word, { x, y });
    this.#text(this.word, text);
    this.#drawCountdown(guide.countdown_s, ring, radius);
    this.#text(this.practice, guide.is_practice ? word(guide.language, "patient.practice") : "");
  }

  #drawBand({ band, level }, isBar) {
    this.root.dataset.band = band === null ? "none" : level >= band.lower && level <= band.upper ? "inside" : "outside";
    if (band === null) return;
    const [x, width] = isBar ? [BAR.bandLeft, BAR.bandWidth] : [CURVE.left, CURVE.right - CURVE.left];
    const area = isBar ? BAR : CURVE;
    const top = heightOf(band.upper, area);
    set(this.band, { x, width, y: top, height: Math.max(heightOf(band.lower, area) - top, 8) });
  }

  #drawBar(level) {
    const y = heightOf(level, BAR);
    set(this.fill, { y, height: Math.max(BAR.bottom - y, 0) });
    set(this.mark, { y: y - 9 });
  }

  #drawCurve(curve, level, nowMs) {
    const newestMs = curve.at(-1)?.atMs ?? nowMs;
    const xOf = (atMs) => CURVE.now - ((newestMs - atMs) / CURVE_MS) * (CURVE.now - CURVE.left);
    const afterGap = curve.findLastIndex((point, index) => index > 0 && point.atMs - curve[index - 1].atMs > GAP_MS);
    const whole = curve.slice(Math.max(afterGap, 0));
    set(this.line, { points: whole.map((point) => `${xOf(point.atMs).toFixed(1)},${heightOf(point.level, CURVE).toFixed(1)}`).join(" ") });
    set(this.dot, { cy: heightOf(level, CURVE) });
  }

  #drawCountdown(seconds, [cx, cy], r) {
    this.longest = seconds === null ? 0 : Math.max(this.longest ?? 0, seconds);
    this.root.dataset.counts = seconds === null ? "no" : "yes";
    if (seconds === null) {
      this.#text(this.seconds, "");
      return;
    }
    set(this.rail, { cx, cy, r });
    set(this.ring, { cx, cy, r, transform: `rotate(-90 ${cx} ${cy})`, "stroke-dasharray": `${(seconds / (this.longest || 1)).toFixed(4)} 2` });
    set(this.seconds, { x: cx, y: cy });
    this.#text(this.seconds, String(Math.ceil(seconds)));
  }

  /** Remove every trace of the patient's breath from the document, not only from view. */
  #clear() {
    this.longest = 0;
    for (const element of [this.word, this.seconds, this.practice]) this.#text(element, "");
    set(this.line, { points: "" });
    this.root.dataset.instruction = "none";
    this.root.dataset.counts = "no";
  }

  #text(element, text) {
    if (element.textContent !== text) element.textContent = text;
  }
}

function heightOf(place, { top, bottom }) {
  return bottom - Math.min(Math.max(place, 0), 1) * (bottom - top);
}

function make(name, attributes) {
  return set(document.createElementNS(SVG, name), attributes);
}

function set(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, String(value));
  return element;
}
