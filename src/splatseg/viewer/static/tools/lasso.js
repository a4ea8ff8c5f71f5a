/** Lasso: draw around a thing. */

import { sketch } from "../stage/overlay.js";
import { follow } from "./gesture.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../stage/stage.js").Tool} Tool
 * @typedef {import("../stage/stage.js").Point} Point
 */

/** @implements {Tool} */
export class LassoTool {
  cursor = "crosshair";
  says = "Draw around a thing; it closes by itself.";

  /** @param {App} app */
  constructor(app) {
    this.app = app;
    /** @type {Point[]} */
    this.points = [];
  }

  /** @param {Point} point @returns {boolean} */
  down(point) {
    this.points = [point];
    return true;
  }

  /** @param {Point} point */
  move(point) {
    follow(this.points, point);
  }

  /** @param {Point} point */
  up(point) {
    const points = this.points;
    this.points = [];
    if (points.length < 3) return;
    const { gestures } = this.app;
    const target = gestures.target(points[0]);
    gestures.begin(
      { kind: "lasso", points: points.map((at) => target.pixel(at)) },
      { mode: gestures.modeOf(point), view: target.view },
    );
  }

  /** @returns {boolean} */
  cancel() {
    const had = this.points.length > 0;
    this.points = [];
    return had;
  }

  /** @param {CanvasRenderingContext2D} g */
  draw(g) {
    if (this.points.length < 2) return;
    const path = new Path2D();
    path.moveTo(this.points[0].x, this.points[0].y);
    for (const { x, y } of this.points) path.lineTo(x, y);
    path.closePath();
    sketch(g, path, this.app.accent);
  }
}
