/** Polygon: corner by corner around a thing. */

import { sketch } from "../stage/overlay.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../stage/stage.js").Tool} Tool
 * @typedef {import("../stage/stage.js").Point} Point
 */

const CLOSES = 9;

/** @implements {Tool} */
export class PolygonTool {
  cursor = "crosshair";
  says = "Click corner by corner; Enter or the first corner closes, Backspace takes one back.";

  /** @param {App} app */
  constructor(app) {
    this.app = app;
    /** @type {Point[]} */
    this.corners = [];
    /** @type {Point|null} */
    this.at = null;
    /** Camera of the first corner. */
    this.pose = "";
  }

  /** @param {Point} _point @returns {boolean} */
  down(_point) {
    return true;
  }

  /** @param {Point} point */
  move(point) {
    this.at = point;
  }

  /** @param {Point} point */
  up(point) {
    const pose = this.app.camera.matrix().join();
    if (pose !== this.pose) this.corners = [];
    this.pose = pose;
    const first = this.corners[0];
    const last = this.corners.at(-1);
    const near = (/** @type {Point|undefined} */ corner) =>
      corner !== undefined && Math.hypot(corner.x - point.x, corner.y - point.y) < CLOSES;
    if (this.corners.length >= 3 && (near(first) || near(last))) {
      this.close(point);
      return;
    }
    if (!near(last)) this.corners.push(point);
  }

  /** @param {Pick<Point, "shift"|"ctrl">} keys */
  close(keys) {
    const corners = this.corners;
    this.corners = [];
    if (corners.length < 3) return;
    const { gestures } = this.app;
    const target = gestures.target(corners[0]);
    gestures.begin(
      { kind: "polygon", points: corners.map((at) => target.pixel(at)) },
      { mode: gestures.modeOf(keys), view: target.view },
    );
    this.app.stage.redraw();
  }

  /** @param {Point} point */
  hover(point) {
    this.at = point;
    if (this.corners.length > 0) this.app.stage.redraw();
  }

  /** @returns {boolean} Whether there was a polygon to close. */
  enter() {
    if (this.corners.length < 3) return false;
    this.close({ shift: false, ctrl: false });
    return true;
  }

  /** @returns {boolean} Whether there was a corner to take back. */
  back() {
    const had = this.corners.pop() !== undefined;
    this.app.stage.redraw();
    return had;
  }

  /** @returns {boolean} */
  cancel() {
    const had = this.corners.length > 0;
    this.corners = [];
    return had;
  }

  /** @param {CanvasRenderingContext2D} g */
  draw(g) {
    if (this.corners.length === 0) return;
    if (this.pose !== this.app.camera.matrix().join()) {
      this.corners = [];
      return;
    }
    const path = new Path2D();
    path.moveTo(this.corners[0].x, this.corners[0].y);
    for (const { x, y } of this.corners) path.lineTo(x, y);
    if (this.at) path.lineTo(this.at.x, this.at.y);
    path.closePath();
    sketch(g, path, this.app.accent);
    for (const [index, { x, y }] of this.corners.entries()) {
      g.beginPath();
      g.arc(x, y, index === 0 ? 5.5 : 3.5, 0, 7);
      g.fillStyle = index === 0 ? this.app.accent : "#ffffff";
      g.fill();
      g.lineWidth = 1.5;
      g.strokeStyle = index === 0 ? "#ffffff" : "rgb(0 0 0 / 0.6)";
      g.stroke();
    }
  }
}
