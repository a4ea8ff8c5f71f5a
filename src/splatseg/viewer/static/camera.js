/**
 * A free pose with a pivot. Axes as OpenCV's: x right, y down, z forward.
 *
 * @typedef {import("./state.js").Vec3} Vec3
 * @typedef {{width: number, height: number, focal: number, matrix: number[]}} CameraRecord
 */

import { clamp } from "./dom.js";

/** @param {Vec3} a @param {Vec3} b @returns {Vec3} */
export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
/** @param {Vec3} a @param {Vec3} b @returns {Vec3} */
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
/** @param {Vec3} a @param {number} s @returns {Vec3} */
export const mul = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
/** @param {Vec3} a @param {Vec3} b @returns {number} */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** @param {Vec3} a @param {Vec3} b @returns {Vec3} */
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
/** @param {Vec3} a @returns {number} */
export const norm = (a) => Math.hypot(a[0], a[1], a[2]);
/** @param {Vec3} a @returns {Vec3} */
export const unit = (a) => mul(a, 1 / (norm(a) || 1));

/** @param {Vec3} a @returns {Vec3} */
const copied = (a) => [a[0], a[1], a[2]];

/** `a` turned about `axis` (unit) by `angle`, Rodrigues. @param {Vec3} a @param {Vec3} axis
 * @param {number} angle @returns {Vec3} */
export function turn(a, axis, angle) {
  const cos = Math.cos(angle);
  const part = add(mul(a, cos), mul(cross(axis, a), Math.sin(angle)));
  return add(part, mul(axis, dot(axis, a) * (1 - cos)));
}

const NEAREST_POLE = 0.06;
const LEVELLING = 0.2;

export class Camera {
  constructor() {
    /** @type {Vec3} */
    this.up = [0, 0, 1];
    /** @type {Vec3} */
    this.position = [0, -3, 0];
    /** @type {Vec3} */
    this.right = [1, 0, 0];
    /** @type {Vec3} */
    this.down = [0, 0, -1];
    /** @type {Vec3} */
    this.forward = [0, 1, 0];
    /** @type {Vec3} */
    this.pivot = [0, 0, 0];
    /** In widths of the longer side of the picture. */
    this.focal = 0.9;
    /** Size of the picture in pixels. */
    this.width = 720;
    this.height = 600;
    /** Radius of the scene: speeds and limits are shares of it. */
    this.radius = 1;
  }

  /** Focal length in pixels. @returns {number} */
  get pixels() {
    return this.focal * Math.max(this.width, this.height);
  }

  /** Depth of the pivot. @returns {number} */
  get distance() {
    const depth = dot(sub(this.pivot, this.position), this.forward);
    return Math.max(depth, this.radius * 1e-3);
  }

  /** @returns {number[]} world_from_camera, row-major. */
  matrix() {
    const { right: r, down: d, forward: f, position: p } = this;
    return [r[0], d[0], f[0], p[0], r[1], d[1], f[1], p[1], r[2], d[2], f[2], p[2], 0, 0, 0, 1];
  }

  /** @param {number} [scale] Of the picture. @returns {CameraRecord} What messages hold. */
  record(scale = 1) {
    const width = Math.round(this.width * scale);
    const height = Math.round(this.height * scale);
    return { width, height, focal: this.pixels * scale, matrix: this.matrix() };
  }

  /**
   * Stand where a matrix says.
   * @param {number[]} m world_from_camera, row-major
   * @param {number} [distance] To the pivot, straight ahead.
   */
  setMatrix(m, distance = this.distance) {
    this.right = unit([m[0], m[4], m[8]]);
    this.down = unit([m[1], m[5], m[9]]);
    this.forward = unit([m[2], m[6], m[10]]);
    this.position = [m[3], m[7], m[11]];
    this.pivot = add(this.position, mul(this.forward, distance));
  }

  /** @param {Camera} other */
  copy(other) {
    for (const key of /** @type {const} */ (["right", "down", "forward", "position", "pivot"])) {
      this[key] = copied(other[key]);
    }
    this.focal = other.focal;
  }

  /** Turn about the pivot by angles. @param {number} yaw @param {number} pitch */
  orbit(yaw, pitch) {
    this.rotate(yaw, pitch, this.pivot);
  }

  /** Look around from where we stand. @param {number} yaw @param {number} pitch */
  look(yaw, pitch) {
    const distance = this.distance;
    this.rotate(yaw, pitch, this.position);
    this.pivot = add(this.position, mul(this.forward, distance));
  }

  /** @param {number} yaw @param {number} pitch @param {Vec3} about */
  rotate(yaw, pitch, about) {
    const polar = Math.acos(clamp(dot(this.forward, this.up), -1, 1));
    const wanted = clamp(polar - pitch, NEAREST_POLE, Math.PI - NEAREST_POLE);
    const level = cross(this.forward, this.up);
    const axis = norm(level) > 1e-6 ? unit(level) : this.right;
    const tilt = polar - wanted;
    /** @param {Vec3} v @returns {Vec3} */
    const both = (v) => turn(turn(v, axis, tilt), this.up, yaw);
    this.position = add(about, both(sub(this.position, about)));
    this.forward = unit(both(this.forward));
    // A photograph may be held askew: its roll goes while one orbits, not with a jump.
    const right = both(this.right);
    const upright = unit(cross(this.forward, this.up));
    const eased = dot(right, upright) > -0.99 ? LEVELLING : 1;
    this.right = unit(add(mul(right, 1 - eased), mul(upright, eased)));
    this.right = unit(sub(this.right, mul(this.forward, dot(this.right, this.forward))));
    this.down = cross(this.forward, this.right);
  }

  /** Shift so that what is at the pivot's depth follows the pointer. @param {number} dx Pixels.
   * @param {number} dy */
  pan(dx, dy) {
    const size = this.distance / this.pixels;
    this.move(add(mul(this.right, -dx * size), mul(this.down, -dy * size)));
  }

  /** @param {Vec3} step World. */
  move(step) {
    this.position = add(this.position, step);
    this.pivot = add(this.pivot, step);
  }

  /** Come nearer, keeping what is under a pixel there. @param {number} factor Of the distance.
   * @param {number} x @param {number} y */
  zoom(factor, x, y) {
    const distance = this.distance;
    const wanted = clamp(distance * factor, this.radius * 2e-3, this.radius * 50);
    const held = this.unproject(x, y, distance);
    const share = wanted / distance;
    const depth = dot(sub(this.pivot, this.position), this.forward);
    const aside = sub(sub(this.pivot, this.position), mul(this.forward, depth));
    this.position = add(held, mul(sub(this.position, held), share));
    this.pivot = add(add(this.position, mul(this.forward, wanted)), mul(aside, share));
  }

  /**
   * World point of a pixel at a depth.
   * @param {number} x @param {number} y @param {number} depth @returns {Vec3}
   */
  unproject(x, y, depth) {
    const u = ((x - this.width / 2) / this.pixels) * depth;
    const v = ((y - this.height / 2) / this.pixels) * depth;
    const plane = add(mul(this.right, u), mul(this.down, v));
    return add(add(this.position, plane), mul(this.forward, depth));
  }

  /** Direction through a pixel, unit. @param {number} x @param {number} y @returns {Vec3} */
  ray(x, y) {
    return unit(sub(this.unproject(x, y, 1), this.position));
  }

  /**
   * Pixel and depth of a world point.
   * @param {Vec3} point @returns {{x: number, y: number, depth: number}}
   */
  project(point) {
    const local = sub(point, this.position);
    const depth = dot(local, this.forward);
    const scale = this.pixels / (depth || 1e-9);
    return {
      x: this.width / 2 + dot(local, this.right) * scale,
      y: this.height / 2 + dot(local, this.down) * scale,
      depth,
    };
  }

  /** Look at a ball from the same side so that it fills the picture. @param {Vec3} centre
   * @param {number} radius */
  frame(centre, radius) {
    const half = Math.min(this.width, this.height) / 2 / this.pixels;
    const distance = Math.max((radius * 1.15) / Math.sin(Math.atan(half)), this.radius * 1e-2);
    this.pivot = copied(centre);
    this.position = sub(centre, mul(this.forward, distance));
  }

  /** Turn towards a point without moving. @param {Vec3} point */
  lookAt(point) {
    this.forward = unit(sub(point, this.position));
    const right = cross(this.forward, this.up);
    if (norm(right) > 1e-6) this.right = unit(right);
    this.down = cross(this.forward, this.right);
    this.pivot = copied(point);
  }

  /** @returns {string} For the fragment of a link. */
  toLink() {
    const numbers = [...this.matrix().slice(0, 12), this.distance, this.focal];
    return numbers.map((value) => Number(value.toPrecision(6))).join(",");
  }

  /** @param {string} text @returns {boolean} Whether it was a camera. */
  fromLink(text) {
    const numbers = text.split(",").map(Number);
    if (numbers.length !== 14 || !numbers.every(Number.isFinite)) return false;
    const [distance, focal] = numbers.slice(12);
    if (distance <= 0 || focal <= 0.05 || focal > 20) return false;
    this.setMatrix([...numbers.slice(0, 12), 0, 0, 0, 1], distance);
    const straight = norm(this.right) * norm(this.down) * norm(this.forward) > 0;
    this.down = unit(sub(this.down, mul(this.forward, dot(this.down, this.forward))));
    this.right = cross(this.down, this.forward);
    this.focal = focal;
    return straight;
  }
}

/**
 * Between two poses, by position and by the nearest rotation (normalised axes).
 * @param {Camera} from @param {Camera} to @param {number} share @param {Camera} out
 */
export function between(from, to, share, out) {
  /** @param {Vec3} a @param {Vec3} b @returns {Vec3} */
  const mix = (a, b) => add(mul(a, 1 - share), mul(b, share));
  out.position = mix(from.position, to.position);
  out.pivot = mix(from.pivot, to.pivot);
  out.focal = from.focal * (1 - share) + to.focal * share;
  const forward = mix(from.forward, to.forward);
  if (norm(forward) < 0.05) {
    out.copy(to);
    return;
  }
  out.forward = unit(forward);
  const right = mix(from.right, to.right);
  const straight = sub(right, mul(out.forward, dot(right, out.forward)));
  out.right = norm(straight) > 0.05 ? unit(straight) : to.right;
  out.down = cross(out.forward, out.right);
}
