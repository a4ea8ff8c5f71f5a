/** Stroke: paint over a thing with a brush. */

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../stage/stage.js").Tool} Tool
 * @typedef {import("../stage/stage.js").Point} Point
 */

import { clamp } from "../dom.js";
import { trail } from "../stage/overlay.js";
import { follow } from "./gesture.js";

/** @implements {Tool} */
export class StrokeTool {
  cursor = "none";
  says = "Paint over a thing. [ and ] change the brush.";

  /** @param {App} app */
  constructor(app) {
    this.app = app;
    /** Of the brush, CSS pixels. */
    this.width = 18;
    /** @type {Point[]} */
    this.points = [];
    /** @type {Point|null} */
    this.at = null;
  }

  /** @param {number} width */
  setWidth(width) {
    this.width = clamp(Math.round(width), 2, 200);
    this.app.store.changed("tool");
  }

  /** @param {Point} point @returns {boolean} */
  down(point) {
    this.points = [point];
    this.at = point;
    return true;
  }

  /** @param {Point} point */
  move(point) {
    this.at = point;
    follow(this.points, point);
  }

  /** @param {Point} point */
  up(point) {
    const points = this.points;
    this.points = [];
    if (points.length === 0) return;
    const { gestures } = this.app;
    const target = gestures.target(points[0]);
    gestures.begin(
      {
        kind: "stroke",
        points: points.map((at) => target.pixel(at)),
        width: Math.round(10 * this.width * target.scale) / 10,
      },
      { mode: gestures.modeOf(point), view: target.view },
    );
  }

  /** @param {Point} point */
  hover(point) {
    this.at = point.touch ? null : point;
    this.app.stage.redraw();
  }

  /** @returns {boolean} */
  cancel() {
    const had = this.points.length > 0;
    this.points = [];
    return had;
  }

  /** @param {CanvasRenderingContext2D} g */
  draw(g) {
    if (this.points.length > 0) trail(g, this.points, this.width);
    if (!this.at) return;
    for (const [colour, width] of /** @type {const} */ ([
      ["rgb(0 0 0 / .6)", 3],
      ["#fff", 1.5],
    ])) {
      g.beginPath();
      g.arc(this.at.x, this.at.y, this.width / 2, 0, 7);
      g.strokeStyle = colour;
      g.lineWidth = width;
      g.stroke();
    }
  }
}
