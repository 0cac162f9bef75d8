/**
 * One moment of a session that is over: its values, the breathing surface in 3-D, and the motion of each cell.
 *
 * The surface is drawn to scale, each cell in the colour of its motion. It is turned by the pointer or the arrow keys.
 * `three` is loaded when the first surface is drawn; a browser without WebGL has the cells alone.
 */

import { readMoment } from "../api.js";
import { colorOf } from "../drawing/color_scale.js";
import { byId, part, setText } from "../drawing/elements.js";
import { fixed, signed } from "../drawing/numbers.js";
import { INK } from "../drawing/canvas.js";
import { shortReason } from "../words/reasons.js";
import { tr } from "../words/words.js";
import { GridPanel } from "../panels/motion_map.js";

const FIELD_DEG = 30;
/** From where the surface is looked at first: obliquely from the patient's left and from below [rad]. */
const FIRST_TURN = { azimuth: 0.5, height: 0.6 };
const TURN_PER_PX = 0.01;
const TURN_PER_KEY = 0.15;
const STEEPEST = 1.5;
/** What stands beside the surface: its sides, and a bar that shows its scale. */
const LABELS = [tr("review.head"), "R", "L", "5 cm"];
const BAR_MM = 50;
const BESIDE_MM = 25;

export class Moment {
  /**
   * @param {(t: number) => string} clock time of day of a time since the first frame [s]
   * @param {() => void} onFound called when another moment is shown: `found` has its values
   */
  constructor(id, clock, onFound) {
    /** `rangeMm`: motion at the ends of the colours, the same for all moments. */
    Object.assign(this, { id, clock, onFound, rangeMm: 5, found: null, wanted: null, isReading: false });
    this.root = byId("review-moment");
    this.frame = byId("review-surface");
    this.grid = new GridPanel(byId("review-grid"), byId("review-legend"), byId("review-readout"));
    this.turn = { ...FIRST_TURN };
    /** What draws in the frame, once it was needed: a promise, null without WebGL. */
    this.three = null;
    this.frame.addEventListener("pointermove", (event) => {
      if (event.buttons === 1) this.#turn(TURN_PER_PX * event.movementX, TURN_PER_PX * event.movementY);
    });
    this.frame.addEventListener("keydown", (event) => this.#key(event));
    this.frame.addEventListener("dblclick", () => this.#reset());
    for (const event of ["pointermove", "pointerleave"]) byId("review-grid").addEventListener(event, () => this.#drawCells());
    new ResizeObserver(() => this.draw()).observe(this.frame);
  }

  /** Show the moment nearest to a time since the session's first frame [s]; of several wanted at once the last one. */
  async show(atS) {
    this.wanted = atS;
    this.root.hidden = false;
    if (this.isReading) return;
    this.isReading = true;
    while (this.wanted !== null && this.frame.isConnected) {
      const at = this.wanted;
      this.wanted = null;
      try {
        this.found = await readMoment(this.id, at);
        if (!this.frame.isConnected) return;
        this.onFound();
        await this.draw();
      } catch (error) {
        if (this.frame.isConnected) setText(byId("review-moment-text"), error.message);
      }
    }
    this.isReading = false;
  }

  async draw() {
    const { found } = this;
    if (found === null) return;
    setText(byId("review-moment-text"), this.#text());
    this.#drawCells();
    const hasSurface = found.surface_mm.length > 0;
    setText(byId("review-surface-note"), hasSurface ? tr("review.turn") : tr("review.no_surface"));
    if (!hasSurface) {
      this.three?.then((made) => made?.clear());
      return;
    }
    this.three ??= drawn(this.frame);
    const made = await this.three;
    if (made === null) setText(byId("review-surface-note"), tr("review.no_webgl"));
    else made.draw(this.found, this.rangeMm, this.turn);
  }

  #text() {
    const { at_s: at, gate, hold_reason: reason, whole_mm: whole, thorax_mm: thorax, abdomen_mm: abdomen } = this.found;
    const values = { whole, thorax, abdomen };
    const motion = Object.entries(values).map(([name, mm]) => `${tr(`page.${name}`)} ${mm === null ? "–" : `${signed(mm)} mm`}`);
    return [this.clock(at), `${fixed(at, 2)} s`, gate === "beam_on" ? tr("review.beam_on") : shortReason(reason ?? gate), ...motion].join(" · ");
  }

  #drawCells() {
    if (this.found !== null) this.grid.draw(this.found.cells_mm, this.rangeMm, null, []);
  }

  #turn(azimuth, height) {
    this.turn.azimuth += azimuth;
    this.turn.height = Math.min(STEEPEST, Math.max(-STEEPEST, this.turn.height + height));
    this.draw();
  }

  #reset() {
    Object.assign(this.turn, FIRST_TURN);
    this.draw();
  }

  #key(event) {
    if (event.key === "Home") this.#reset();
    const turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const turn = turns[event.key];
    if (turn === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    this.#turn(TURN_PER_KEY * turn[0], TURN_PER_KEY * turn[1]);
  }
}

/** Load `three` and return what draws a surface in a frame; null without WebGL. */
async function drawn(frame) {
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("webgl2", { antialias: true, alpha: true });
  if (context === null) return null;
  const THREE = await import("../../vendor/three/three.module.js");
  const renderer = new THREE.WebGLRenderer({ canvas, context });
  renderer.setClearColor(0x000000, 0);
  frame.append(canvas);
  const labels = LABELS.map((text) => part("span", text, "side"));
  frame.append(...labels);
  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(FIELD_DEG, 1, 10, 10_000);
  const lamp = new THREE.DirectionalLight(0xffffff, 1.6);
  scene.add(lamp, new THREE.AmbientLight(0xffffff, 1.6));
  let shown = null;
  const clear = () => {
    if (shown === null) return;
    scene.remove(shown);
    shown.traverse((one) => { one.geometry?.dispose(); one.material?.dispose(); });
    shown = null;
    renderer.clear();
  };
  const draw = ({ surface_mm: nodes, cells_mm: cells }, rangeMm, turn) => {
    const { clientWidth: width, clientHeight: height } = frame;
    if (width === 0 || height === 0) return;
    clear();
    shown = surface(THREE, nodes, cells, rangeMm);
    scene.add(shown);
    renderer.setPixelRatio(window.devicePixelRatio);
    renderer.setSize(width, height, false);
    const box = new THREE.Box3().setFromObject(shown);
    const middle = box.getCenter(new THREE.Vector3());
    const away = box.getSize(new THREE.Vector3()).length() / 2.4 / Math.sin((FIELD_DEG * Math.PI) / 360);
    camera.aspect = width / height;
    camera.up.set(0, Math.cos(turn.height), Math.sin(turn.height));
    camera.position.set(Math.sin(turn.azimuth) * Math.cos(turn.height), -Math.sin(turn.height), Math.cos(turn.azimuth) * Math.cos(turn.height)).multiplyScalar(away).add(middle);
    camera.lookAt(middle);
    lamp.position.copy(camera.position).sub(middle);
    camera.updateProjectionMatrix();
    renderer.render(scene, camera);
    shown.updateMatrixWorld();
    shown.userData.places.forEach((at, i) => {
      const on = shown.localToWorld(new THREE.Vector3(...at)).project(camera);
      Object.assign(labels[i].style, { left: `${50 * (1 + on.x)}%`, top: `${50 * (1 - on.y)}%` });
    });
  };
  return { draw, clear };
}

/** Angle by which the picture of the camera is turned so that the patient's head is up [rad]. */
function uprightTurn(nodes) {
  const middle = (row) => row.filter(Boolean).reduce(([x, y, n], one) => [x + one[0], y + one[1], n + 1], [0, 0, 0]);
  const rows = nodes.map(middle).filter(([, , count]) => count > 0).map(([x, y, count]) => [x / count, y / count]);
  const [first, last] = [rows[0], rows.at(-1)];
  return Math.PI / 2 - Math.atan2(last[1] - first[1], first[0] - last[0]);
}

/** Two triangles for each cell whose nodes are known, in the cell's colour, grey where it was not measured, and the lines between the cells. The scene has x right, y superior, z towards the camera. */
function surface(THREE, nodes, cells, rangeMm) {
  const at = (row, column) => nodes[row][column] === null ? null : [nodes[row][column][0], -nodes[row][column][1], -nodes[row][column][2]];
  const [points, colors, edges] = [[], [], []];
  const color = new THREE.Color();
  for (const [r, row] of cells.entries()) {
    for (const [c, mm] of row.entries()) {
      const corners = [at(r, c), at(r, c + 1), at(r + 1, c), at(r + 1, c + 1)];
      if (corners.includes(null)) continue;
      const [one, two, three, four] = corners;
      color.setStyle(mm === null ? INK.faint : colorOf(mm, rangeMm));
      for (const corner of [one, three, two, two, three, four]) {
        points.push(...corner);
        colors.push(color.r, color.g, color.b);
      }
      edges.push(...one, ...two, ...two, ...four, ...four, ...three, ...three, ...one);
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
  geometry.setAttribute("color", new THREE.Float32BufferAttribute(colors, 3));
  geometry.computeVertexNormals();
  const places = sides(at, nodes);
  const [x, y, z] = places[3];
  edges.push(x - BAR_MM / 2, y + BESIDE_MM / 2, z, x + BAR_MM / 2, y + BESIDE_MM / 2, z);
  const lines = new THREE.BufferGeometry();
  lines.setAttribute("position", new THREE.Float32BufferAttribute(edges, 3));
  const group = new THREE.Group();
  group.rotation.z = uprightTurn(nodes);
  group.userData.places = places;
  group.add(
    new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ vertexColors: true, side: THREE.DoubleSide, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 })),
    new THREE.LineSegments(lines, new THREE.LineBasicMaterial({ color: INK.faint, transparent: true, opacity: 0.35 })),
  );
  return group;
}

/** Where the labels stand: beyond the first row, the first and the last column of the middle, and below the last row. */
function sides(at, nodes) {
  const known = (all) => all.filter((one) => one !== null);
  const mean = (all) => [0, 1, 2].map((axis) => all.reduce((sum, one) => sum + one[axis], 0) / Math.max(all.length, 1));
  const row = (r) => known(nodes[r].map((_, c) => at(r, c)));
  const rows = nodes.map((_, r) => row(r)).filter((one) => one.length > 0);
  const middle = rows[Math.floor(rows.length / 2)];
  const centre = mean(rows.flat());
  const beyond = (point) => {
    const away = point.map((value, axis) => value - centre[axis]);
    const length = Math.hypot(away[0], away[1]) || 1;
    return [point[0] + (BESIDE_MM * away[0]) / length, point[1] + (BESIDE_MM * away[1]) / length, point[2]];
  };
  return [mean(rows[0]), middle[0], middle.at(-1), mean(rows.at(-1))].map(beyond);
}
