/** Sphere: a brush that takes what is in balls on a surface. */

import { clamp } from "../dom.js";
import { sketch, trail } from "../stage/overlay.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../state.js").Vec3} Vec3
 * @typedef {import("../stage/stage.js").Tool} Tool
 * @typedef {import("../stage/stage.js").Point} Point
 * @typedef {{points: Point[], world: Vec3|null|undefined, ended: Point|null}} Press `world`: of the
 *   first point, null where nothing is, undefined until the server has said it.
 */

/** Between two balls, as a share of their radius. */
const APART = 0.35;
const MOST_POINTS = 400;

/** @implements {Tool} */
export class SphereTool {
  cursor = "crosshair";
  says = "Paint with a ball on a surface. [ and ] change its radius.";

  /** @param {App} app */
  constructor(app) {
    this.app = app;
    /** At the depth where the stroke begins, CSS pixels. */
    this.radius = 40;
    /** @type {Press|null} */
    this.press = null;
    /** @type {Point|null} */
    this.at = null;
  }

  /** @param {number} radius */
  setRadius(radius) {
    this.radius = clamp(Math.round(radius), 4, 400);
    this.app.store.changed("tool");
  }

  /** @param {Point} point @returns {boolean} */
  down(point) {
    /** @type {Press} */
    const press = { points: [point], world: undefined, ended: null };
    this.press = press;
    this.at = point;
    this.app.depth(this.app.stage.pixel(point), (world) => {
      press.world = world;
      if (press.ended) this.send(press, press.ended);
    });
    return true;
  }

  /** @param {Point} point */
  move(point) {
    this.at = point;
    const points = this.press?.points;
    const apart = Math.max(2, APART * this.radius);
    // A quick pointer skips pixels; the brush goes all the way.
    while (points && points.length < MOST_POINTS) {
      const last = points[points.length - 1];
      const away = Math.hypot(point.x - last.x, point.y - last.y);
      if (away < apart) return;
      const share = apart / away;
      const x = last.x + share * (point.x - last.x);
      const y = last.y + share * (point.y - last.y);
      points.push({ ...point, x, y });
    }
  }

  /** @param {Point} point */
  up(point) {
    const { press } = this;
    this.press = null;
    if (!press) return;
    press.ended = point;
    if (press.world !== undefined) this.send(press, point);
  }

  /** @param {Press} press @param {Point} ended */
  send({ points, world }, ended) {
    const { camera, gestures, stage } = this.app;
    if (!world) {
      this.app.toast("There is no surface at that point.", "Press on a thing.");
      return;
    }
    const radius = (this.radius * stage.ratio * camera.project(world).depth) / camera.pixels;
    gestures.begin(
      {
        kind: "sphere",
        points: points.map((at) => stage.pixel(at)),
        radius: Number(radius.toPrecision(6)),
      },
      { mode: gestures.modeOf(ended) },
    );
  }

  /** @param {Point} point */
  hover(point) {
    this.at = point.touch ? null : point;
    this.app.stage.redraw();
  }

  /** @returns {boolean} */
  cancel() {
    const had = this.press !== null;
    this.press = null;
    return had;
  }

  /** @param {CanvasRenderingContext2D} g */
  draw(g) {
    const { press, radius } = this;
    if (press) trail(g, press.points, 2 * radius);
    if (!this.at) return;
    const path = new Path2D();
    path.arc(this.at.x, this.at.y, radius, 0, 2 * Math.PI);
    sketch(g, path, this.app.accent, false);
    g.globalAlpha = 0.7;
    const waist = new Path2D();
    waist.ellipse(this.at.x, this.at.y, radius, radius * 0.3, 0, 0, Math.PI);
    g.strokeStyle = "#ffffff";
    g.lineWidth = 1;
    g.stroke(waist);
    g.globalAlpha = 1;
  }
}
