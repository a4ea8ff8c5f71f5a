/** Sphere: a ball around a point of the surface; the drag says how large. */

import { sketch } from "../stage/overlay.js";
import { clamp } from "../dom.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../state.js").Vec3} Vec3
 * @typedef {import("../stage/stage.js").Tool} Tool
 * @typedef {import("../stage/stage.js").Point} Point
 */

const DRAGGED = 5;

/** @implements {Tool} */
export class SphereTool {
  cursor = "crosshair";
  says =
    "Press on a surface and drag for the radius; a click takes the last one. [ and ] change it.";

  /** @param {App} app */
  constructor(app) {
    this.app = app;
    /** Of a click, CSS pixels. */
    this.radius = 40;
    /** @type {{from: Point, to: Point, world: Vec3|null|undefined, done: boolean}|null} */
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
    /** @type {{from: Point, to: Point, world: Vec3|null|undefined, done: boolean}} */
    const press = { from: point, to: point, world: undefined, done: false };
    this.press = press;
    this.app.depth(this.app.stage.pixel(point), (world) => {
      press.world = world;
      if (press.done) this.send(press);
    });
    return true;
  }

  /** @param {Point} point */
  move(point) {
    if (this.press) this.press.to = point;
    this.at = point;
  }

  /** @param {Point} point */
  up(point) {
    const { press } = this;
    this.press = null;
    if (!press) return;
    press.to = point;
    press.done = true;
    const dragged = Math.hypot(point.x - press.from.x, point.y - press.from.y);
    if (dragged >= DRAGGED) this.setRadius(dragged);
    if (press.world !== undefined) this.send(press);
  }

  /** @param {{from: Point, to: Point, world: Vec3|null|undefined}} press */
  send({ from, to, world }) {
    const { camera, gestures, stage } = this.app;
    if (!world) {
      this.app.toast("There is no surface at that point.", "Press on a thing.");
      return;
    }
    const depth = camera.project(world).depth;
    const radius = (this.radius * stage.ratio * depth) / camera.pixels;
    gestures.begin(
      { kind: "sphere", points: [stage.pixel(from)], radius: Number(radius.toPrecision(6)) },
      { mode: gestures.modeOf(to) },
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
    const centre = this.press?.from ?? this.at;
    if (!centre) return;
    const { press } = this;
    const dragged = press ? Math.hypot(press.to.x - press.from.x, press.to.y - press.from.y) : 0;
    const radius = dragged >= DRAGGED ? dragged : this.radius;
    const path = new Path2D();
    path.arc(centre.x, centre.y, radius, 0, 2 * Math.PI);
    sketch(g, path, this.app.accent, press !== null);
    g.globalAlpha = 0.7;
    const waist = new Path2D();
    waist.ellipse(centre.x, centre.y, radius, radius * 0.3, 0, 0, Math.PI);
    g.strokeStyle = "#ffffff";
    g.lineWidth = 1;
    g.stroke(waist);
    g.globalAlpha = 1;
  }
}
