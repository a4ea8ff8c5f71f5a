/** Box: a rectangle around a thing. */

import { sketch } from "../stage/overlay.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../stage/stage.js").Tool} Tool
 * @typedef {import("../stage/stage.js").Point} Point
 */

const SMALLEST = 3;

/** @implements {Tool} */
export class BoxTool {
  cursor = "crosshair";
  says = "Drag a rectangle around a thing.";

  /** @param {App} app */
  constructor(app) {
    this.app = app;
    /** @type {{from: Point, to: Point}|null} */
    this.box = null;
  }

  /** @param {Point} point @returns {boolean} */
  down(point) {
    this.box = { from: point, to: point };
    return true;
  }

  /** @param {Point} point */
  move(point) {
    if (this.box) this.box.to = point;
  }

  /** @param {Point} point */
  up(point) {
    const from = this.box?.from;
    this.box = null;
    if (!from) return;
    const wide = Math.abs(point.x - from.x) >= SMALLEST;
    if (!wide || Math.abs(point.y - from.y) < SMALLEST) return;
    const { gestures } = this.app;
    const target = gestures.target(from);
    const [a, b] = [target.pixel(from), target.pixel(point)];
    const low = [Math.min(a[0], b[0]), Math.min(a[1], b[1])];
    const high = [Math.max(a[0], b[0]), Math.max(a[1], b[1])];
    const mode = gestures.modeOf(point);
    gestures.begin({ kind: "box", box: [...low, ...high] }, { mode, view: target.view });
  }

  /** @returns {boolean} */
  cancel() {
    const had = this.box !== null;
    this.box = null;
    return had;
  }

  /** @param {CanvasRenderingContext2D} g */
  draw(g) {
    if (!this.box) return;
    const { from, to } = this.box;
    const path = new Path2D();
    path.rect(from.x, from.y, to.x - from.x, to.y - from.y);
    sketch(g, path, this.app.accent);
  }
}
