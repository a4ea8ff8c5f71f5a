/** What is drawn over the picture: outline, pivot, hint, the tool's own, axes. */

import { add, sub } from "../camera.js";
import { outline } from "./outline.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../state.js").Vec3} Vec3
 */

/** Canvas whose width the options of a tool take, CSS pixels. */
const NARROW = 480;

/** Everything over the picture. @param {App} app */
export function drawOverlay(app) {
  const { store, stage } = app;
  const g = stage.overlay.getContext("2d");
  if (!g) return;
  const pixels = stage.overlay.width / Math.max(1, stage.box.clientWidth);
  g.setTransform(1, 0, 0, 1, 0, 0);
  g.clearRect(0, 0, stage.overlay.width, stage.overlay.height);
  g.lineJoin = "round";
  g.lineCap = "round";
  if (stage.ids && store.hover) drawOutline(app, g, store.hover);
  g.setTransform(pixels, 0, 0, pixels, 0, 0);
  const turning = stage.drag?.moved === true && !stage.drag.tool;
  if (turning || stage.pivotShown > performance.now()) drawPivot(app, g);
  const { hint } = store;
  if (hint?.view && store.tool === "click" && app.views.here() === hint.view) {
    const at = stage.photograph.css(hint.view, hint);
    if (at) ring(g, at.x, at.y, 9, app.accent);
  }
  stage.tool.draw?.(g, stage.ratio);
  if (document.activeElement === stage.overlay && !stage.byPointer) {
    const { x, y } = stage.middle();
    cross(g, x, y);
  }
  drawAxes(app, g);
}

/** @param {App} app @param {CanvasRenderingContext2D} g @param {number} code */
function drawOutline({ stage }, g, code) {
  if (!stage.ids) return;
  let path = stage.outlines.get(code);
  if (!path) {
    path = outline(stage.ids, code);
    stage.outlines.set(code, path);
  }
  const scale = stage.overlay.width / stage.ids.width;
  const tall = stage.overlay.height / stage.ids.height;
  g.setTransform(scale, 0, 0, tall, 0, 0);
  const pixel = (devicePixelRatio || 1) / scale;
  g.strokeStyle = "rgb(0 0 0 / 0.55)";
  g.lineWidth = 4 * pixel;
  g.stroke(path);
  g.strokeStyle = "#ffffff";
  g.lineWidth = 1.75 * pixel;
  g.stroke(path);
}

/** @param {App} app @param {CanvasRenderingContext2D} g */
function drawPivot({ stage, camera }, g) {
  const at = stage.css(camera.pivot);
  if (at.depth <= 0 || stage.movement === "fly") return;
  ring(g, at.x, at.y, 4, "#ffffff");
}

/** The world's axes, small, in a corner. @param {App} app
 * @param {CanvasRenderingContext2D} g */
function drawAxes({ stage, camera }, g) {
  const size = 20;
  const { clientWidth: width } = stage.box;
  // On a narrow page below the options of the tool, which are as wide.
  const at = { x: width - size - 18, y: size + (width < NARROW ? 62 : 18) };
  /** @type {{name: string, x: number, y: number, depth: number, colour: string}[]} */
  const axes = [];
  const world = /** @type {const} */ ([
    ["X", [1, 0, 0], "#ff6b6b"],
    ["Y", [0, 1, 0], "#5bd66f"],
    ["Z", [0, 0, 1], "#6ea8ff"],
  ]);
  const here = camera.position;
  for (const [name, axis, colour] of world) {
    const local = sub(add(here, [axis[0], axis[1], axis[2]]), here);
    const part = (/** @type {Vec3} */ v) => local[0] * v[0] + local[1] * v[1] + local[2] * v[2];
    const [x, y] = [part(camera.right), part(camera.down)];
    axes.push({ name, x: x * size, y: y * size, depth: part(camera.forward), colour });
  }
  g.save();
  g.translate(at.x, at.y);
  g.font = "600 9px system-ui, sans-serif";
  g.textAlign = "center";
  g.textBaseline = "middle";
  g.fillStyle = "rgb(16 18 22 / 0.62)";
  g.beginPath();
  g.arc(0, 0, size + 10, 0, 7);
  g.fill();
  for (const axis of axes.sort((a, b) => b.depth - a.depth)) {
    g.globalAlpha = axis.depth > 0.2 ? 0.55 : 1;
    g.strokeStyle = axis.colour;
    g.fillStyle = axis.colour;
    g.lineWidth = 1.75;
    g.beginPath();
    g.moveTo(0, 0);
    g.lineTo(axis.x * 0.8, axis.y * 0.8);
    g.stroke();
    g.fillText(axis.name, axis.x * 1.2, axis.y * 1.2);
  }
  g.restore();
}

/** @param {CanvasRenderingContext2D} g @param {number} x @param {number} y @param {number} size
 * @param {string} colour */
export function ring(g, x, y, size, colour) {
  g.beginPath();
  g.arc(x, y, size, 0, 7);
  g.strokeStyle = "rgb(0 0 0 / 0.6)";
  g.lineWidth = 4;
  g.stroke();
  g.strokeStyle = colour;
  g.lineWidth = 2;
  g.stroke();
}

/** @param {CanvasRenderingContext2D} g @param {number} x @param {number} y */
function cross(g, x, y) {
  for (const [colour, width] of /** @type {const} */ ([
    ["rgb(0 0 0 / 0.6)", 4],
    ["#fff", 1.5],
  ])) {
    g.strokeStyle = colour;
    g.lineWidth = width;
    g.beginPath();
    g.moveTo(x - 9, y);
    g.lineTo(x + 9, y);
    g.moveTo(x, y - 9);
    g.lineTo(x, y + 9);
    g.stroke();
  }
}

/**
 * The way of a brush, seen on dark, light and selected things.
 * @param {CanvasRenderingContext2D} g @param {readonly {x: number, y: number}[]} points
 * @param {number} width
 */
export function trail(g, points, width) {
  const path = new Path2D();
  path.moveTo(points[0].x, points[0].y);
  for (const { x, y } of points) path.lineTo(x, y);
  for (const [colour, wide] of /** @type {const} */ ([
    ["rgb(0 0 0 / 0.4)", width + 3],
    ["rgb(255 255 255 / 0.5)", width],
  ])) {
    g.strokeStyle = colour;
    g.lineWidth = wide;
    g.stroke(path);
  }
}

/**
 * A path of a tool: white over black, dashed where it is not yet sure.
 * @param {CanvasRenderingContext2D} g @param {Path2D} path @param {string} colour
 * @param {boolean} [filled]
 */
export function sketch(g, path, colour, filled = true) {
  if (filled) {
    g.globalAlpha = 0.14;
    g.fillStyle = colour;
    g.fill(path);
    g.globalAlpha = 1;
  }
  g.strokeStyle = "rgb(0 0 0 / 0.55)";
  g.lineWidth = 3.5;
  g.stroke(path);
  g.strokeStyle = "#ffffff";
  g.lineWidth = 1.5;
  g.setLineDash([5, 4]);
  g.stroke(path);
  g.setLineDash([]);
}
