/** Move, rotate and scale what is selected, by handles or by arrow keys. */

import { add, dot, mul, sub, unit } from "../camera.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../state.js").Vec3} Vec3
 * @typedef {import("../stage/stage.js").Tool} Tool
 * @typedef {import("../stage/stage.js").Point} Point
 * @typedef {{rotation: [number, number, number, number], translation: Vec3, scale: number,
 *   about: Vec3}} Motion
 * @typedef {"translate"|"rotate"|"scale"} Kind
 */

const LENGTH = 78;
const GRAB = 9;
/** @type {readonly {name: string, axis: Vec3, colour: string}[]} */
const AXES = [
  { name: "x", axis: [1, 0, 0], colour: "#ff6b6b" },
  { name: "y", axis: [0, 1, 0], colour: "#5bd66f" },
  { name: "z", axis: [0, 0, 1], colour: "#6ea8ff" },
];
const NONE = -2;
const FREE = -1;

/** @implements {Tool} */
export class MoveTool {
  cursor = "default";

  /** @param {App} app */
  constructor(app) {
    this.app = app;
    /** @type {Kind} */
    this.kind = "translate";
    /** @type {{axis: number, from: Point, about: Vec3, motion: Motion}|null} */
    this.grip = null;
    /** What was let go of, until the document says so. @type {Motion|null} */
    this.sent = null;
    this.near = NONE;
    app.store.on(["document", "connection"], () => {
      this.sent = null;
    });
  }

  get says() {
    const verb = { translate: "move", rotate: "rotate", scale: "scale" }[this.kind];
    return `Drag a handle to ${verb} the selection; arrow keys do it in steps.`;
  }

  /** Middle and size of what would move. @returns {{about: Vec3, radius: number}|null} */
  subject() {
    const { store } = this.app;
    const { selection } = store.document;
    if (selection?.centre) return { about: selection.centre, radius: selection.radius ?? 0 };
    const picked = store.pickedObjects().filter((object) => object.centre);
    if (picked.length > 0) {
      let about = /** @type {Vec3} */ ([0, 0, 0]);
      for (const object of picked) {
        about = add(about, mul(/** @type {Vec3} */ (object.centre), 1 / picked.length));
      }
      const radius = Math.max(...picked.map((object) => object.radius ?? 0));
      return { about, radius };
    }
    return selection ? { about: this.app.camera.pivot, radius: 0 } : null;
  }

  /** A move under way, as the picture is to show it. */
  preview() {
    const { store } = this.app;
    if (!this.grip || !store.features.has("preview")) return null;
    return { ids: store.document.selection ? null : [...store.picked], ...this.grip.motion };
  }

  /** Scene units a CSS pixel at a point. @param {Vec3} about @returns {number} */
  unitsPerPixel(about) {
    const { camera, stage } = this.app;
    return (camera.project(about).depth / camera.pixels) * stage.ratio;
  }

  /** Handle at a point: 0, 1, 2 of an axis, -1 the middle, -2 none. @param {Point} point */
  at(point) {
    const subject = this.subject();
    if (!subject) return NONE;
    const { stage } = this.app;
    const middle = stage.css(subject.about);
    if (middle.depth <= 0) return NONE;
    const away = Math.hypot(point.x - middle.x, point.y - middle.y);
    if (this.kind === "scale") return Math.abs(away - LENGTH) < GRAB ? FREE : NONE;
    if (this.kind === "translate" && away < GRAB) return FREE;
    let best = NONE;
    let nearest = GRAB;
    for (const [index, line] of this.lines(subject.about).entries()) {
      for (let i = 1; i < line.length; i++) {
        const distance = toSegment(point, line[i - 1], line[i]);
        if (distance < nearest) {
          nearest = distance;
          best = index;
        }
      }
    }
    return best;
  }

  /** The handles on the canvas: arrows, or circles about the axes. @param {Vec3} about */
  lines(about) {
    const { stage } = this.app;
    const size = LENGTH * this.unitsPerPixel(about);
    return AXES.map(({ axis }) => {
      if (this.kind === "translate") {
        return [stage.css(about), stage.css(add(about, mul(axis, size)))];
      }
      const [u, v] = across(axis);
      return Array.from({ length: 49 }, (_, index) => {
        const angle = (index / 48) * 2 * Math.PI;
        const out = add(mul(u, Math.cos(angle) * size), mul(v, Math.sin(angle) * size));
        return stage.css(add(about, out));
      });
    });
  }

  /** @param {Point} point @returns {boolean} */
  down(point) {
    const axis = this.at(point);
    const subject = this.subject();
    if (axis === NONE || !subject) return false;
    this.grip = { axis, from: point, about: subject.about, motion: still(subject.about) };
    return true;
  }

  /** @param {Point} point */
  move(point) {
    const { grip } = this;
    if (!grip) return;
    grip.motion = this.motion(point);
    this.app.server.moved();
  }

  /** What a drag to a point means. @param {Point} point @returns {Motion} */
  motion(point) {
    const { axis, from, about } = /** @type {NonNullable<MoveTool["grip"]>} */ (this.grip);
    const { camera, stage } = this.app;
    const middle = stage.css(about);
    const motion = still(about);
    const [dx, dy] = [point.x - from.x, point.y - from.y];
    const size = this.unitsPerPixel(about);
    if (this.kind === "translate" && axis === FREE) {
      motion.translation = add(mul(camera.right, dx * size), mul(camera.down, dy * size));
    } else if (this.kind === "translate") {
      const end = stage.css(add(about, mul(AXES[axis].axis, LENGTH * size)));
      const way = [end.x - middle.x, end.y - middle.y];
      const length = Math.max(12, Math.hypot(way[0], way[1]));
      const along = (dx * way[0] + dy * way[1]) / length;
      motion.translation = mul(AXES[axis].axis, (along / length) * LENGTH * size);
    } else if (this.kind === "rotate") {
      const before = Math.atan2(from.y - middle.y, from.x - middle.x);
      const after = Math.atan2(point.y - middle.y, point.x - middle.x);
      let angle = after - before;
      if (angle > Math.PI) angle -= 2 * Math.PI;
      if (angle < -Math.PI) angle += 2 * Math.PI;
      if (point.shift) angle = Math.round(angle / (Math.PI / 12)) * (Math.PI / 12);
      const towards = dot(AXES[axis].axis, unit(sub(about, camera.position)));
      motion.rotation = quaternion(AXES[axis].axis, towards < 0 ? -angle : angle);
    } else {
      const radius = Math.max(4, Math.hypot(point.x - middle.x, point.y - middle.y));
      const start = Math.max(4, Math.hypot(from.x - middle.x, from.y - middle.y));
      motion.scale = radius / start;
    }
    return motion;
  }

  /** @param {Point} point */
  up(point) {
    if (!this.grip) return;
    const motion = this.motion(point);
    this.grip = null;
    this.app.server.hold();
    if (this.commit(motion)) this.sent = motion;
    else this.app.server.rest();
  }

  /** Make a move. @param {Motion} motion @returns {boolean} Whether there is one. */
  commit(motion) {
    const turned = Math.abs(motion.rotation[0]) < 1 - 1e-9;
    const shifted = motion.translation.some((value) => Math.abs(value) > 1e-9);
    if (!turned && !shifted && Math.abs(motion.scale - 1) < 1e-6) return false;
    return this.app.edit("move", motion);
  }

  /** The server did not make the move. */
  refused() {
    this.sent = null;
    this.app.server.rest();
  }

  /** Steps by arrow keys; Shift: by depth. @param {number} x @param {number} y @returns {boolean} */
  arrow(x, y) {
    const subject = this.subject();
    if (!subject) return false;
    const { camera } = this.app;
    const motion = still(subject.about);
    if (this.kind === "translate") {
      const step = 12 * this.unitsPerPixel(subject.about);
      motion.translation = add(mul(camera.right, x * step), mul(camera.down, y * step));
    } else if (this.kind === "rotate") {
      const axis = x ? camera.up : camera.right;
      motion.rotation = quaternion(axis, ((x || y) * Math.PI) / 36);
    } else {
      motion.scale = 1.05 ** (x - y);
    }
    this.commit(motion);
    return true;
  }

  /** @param {Point} point */
  hover(point) {
    const near = this.at(point);
    if (near === this.near) return;
    this.near = near;
    this.app.stage.overlay.dataset.cursor = near === NONE ? "default" : "grab";
    this.app.stage.redraw();
  }

  /** @returns {boolean} */
  cancel() {
    const had = this.grip !== null;
    this.grip = null;
    if (had) this.app.server.rest();
    return had;
  }

  /** @param {CanvasRenderingContext2D} g */
  draw(g) {
    const subject = this.subject();
    if (!subject) return;
    const { stage } = this.app;
    const motion = this.grip?.motion ?? this.sent;
    const about = motion ? add(subject.about, motion.translation) : subject.about;
    const middle = stage.css(about);
    if (middle.depth <= 0) return;
    const right = stage.box.clientWidth;
    const { features } = this.app.store;
    if (motion && subject.radius > 0 && !features.has("preview")) {
      this.drawGhost(g, subject, motion);
    }
    if (this.kind === "scale") {
      const factor = motion?.scale ?? 1;
      const path = new Path2D();
      path.arc(middle.x, middle.y, LENGTH * factor, 0, 2 * Math.PI);
      stroke(g, path, this.near === FREE || motion ? "#ffffff" : this.app.accent, 2.5);
      if (motion) label(g, middle.x, middle.y, `× ${factor.toFixed(2)}`, right);
      return;
    }
    for (const [index, line] of this.lines(about).entries()) {
      const lit = (this.grip?.axis ?? this.near) === index;
      const path = new Path2D();
      path.moveTo(line[0].x, line[0].y);
      for (const { x, y } of line) path.lineTo(x, y);
      stroke(g, path, lit ? "#ffffff" : AXES[index].colour, lit ? 3.5 : 2.5);
      if (this.kind === "translate")
        arrowHead(g, line[0], line[1], lit ? "#fff" : AXES[index].colour);
    }
    if (this.kind === "translate") {
      const lit = (this.grip?.axis ?? this.near) === FREE;
      g.fillStyle = lit ? "#ffffff" : this.app.accent;
      g.strokeStyle = "rgb(0 0 0 / 0.6)";
      g.lineWidth = 1.5;
      g.beginPath();
      g.roundRect(middle.x - 6, middle.y - 6, 12, 12, 3);
      g.fill();
      g.stroke();
    }
    if (motion && this.kind === "rotate") {
      const angle = (2 * Math.acos(Math.min(1, Math.abs(motion.rotation[0]))) * 180) / Math.PI;
      label(g, middle.x, middle.y, `${angle.toFixed(0)}°`, right);
    } else if (motion) {
      const parts = motion.translation.map((part) => part.toFixed(2));
      label(g, middle.x, middle.y, parts.join("  "), right);
    }
  }

  /** A box around what moves. @param {CanvasRenderingContext2D} g
   * @param {{about: Vec3, radius: number}} subject @param {Motion} motion */
  drawGhost(g, subject, motion) {
    const { stage } = this.app;
    const half = (subject.radius * motion.scale) / Math.sqrt(3);
    const corners = Array.from({ length: 8 }, (_, index) => {
      const corner = /** @type {Vec3} */ (
        [0, 1, 2].map((bit) => (index & (1 << bit) ? half : -half))
      );
      const turned = rotate(motion.rotation, corner);
      return stage.css(add(add(subject.about, motion.translation), turned));
    });
    if (corners.some((corner) => corner.depth <= 0)) return;
    const path = new Path2D();
    for (let a = 0; a < 8; a++) {
      for (const bit of [1, 2, 4]) {
        if (a & bit) continue;
        path.moveTo(corners[a].x, corners[a].y);
        path.lineTo(corners[a | bit].x, corners[a | bit].y);
      }
    }
    g.setLineDash([4, 4]);
    stroke(g, path, "#ffffff", 1.25);
    g.setLineDash([]);
  }
}

/** @param {Vec3} about @returns {Motion} */
function still(about) {
  return { rotation: [1, 0, 0, 0], translation: [0, 0, 0], scale: 1, about };
}

/** @param {Vec3} axis @param {number} angle @returns {[number, number, number, number]} */
function quaternion(axis, angle) {
  const sin = Math.sin(angle / 2);
  return [Math.cos(angle / 2), axis[0] * sin, axis[1] * sin, axis[2] * sin];
}

/** @param {[number, number, number, number]} q @param {Vec3} v @returns {Vec3} */
function rotate([w, x, y, z], v) {
  const t = mul([y * v[2] - z * v[1], z * v[0] - x * v[2], x * v[1] - y * v[0]], 2);
  const turned = add(v, mul(t, w));
  return add(turned, [y * t[2] - z * t[1], z * t[0] - x * t[2], x * t[1] - y * t[0]]);
}

/** Two directions across an axis. @param {Vec3} axis @returns {[Vec3, Vec3]} */
function across(axis) {
  if (axis[0])
    return [
      [0, 1, 0],
      [0, 0, 1],
    ];
  if (axis[1])
    return [
      [0, 0, 1],
      [1, 0, 0],
    ];
  return [
    [1, 0, 0],
    [0, 1, 0],
  ];
}

/** @param {{x: number, y: number}} p @param {{x: number, y: number}} a
 * @param {{x: number, y: number}} b @returns {number} */
function toSegment(p, a, b) {
  const [dx, dy] = [b.x - a.x, b.y - a.y];
  const length = dx * dx + dy * dy || 1;
  const share = Math.min(1, Math.max(0, ((p.x - a.x) * dx + (p.y - a.y) * dy) / length));
  return Math.hypot(p.x - a.x - share * dx, p.y - a.y - share * dy);
}

/** @param {CanvasRenderingContext2D} g @param {Path2D} path @param {string} colour
 * @param {number} width */
function stroke(g, path, colour, width) {
  g.strokeStyle = "rgb(0 0 0 / 0.5)";
  g.lineWidth = width + 2;
  g.stroke(path);
  g.strokeStyle = colour;
  g.lineWidth = width;
  g.stroke(path);
}

/** @param {CanvasRenderingContext2D} g @param {{x: number, y: number}} from
 * @param {{x: number, y: number}} to @param {string} colour */
function arrowHead(g, from, to, colour) {
  const angle = Math.atan2(to.y - from.y, to.x - from.x);
  g.save();
  g.translate(to.x, to.y);
  g.rotate(angle);
  g.fillStyle = colour;
  g.beginPath();
  g.moveTo(9, 0);
  g.lineTo(-4, 5.5);
  g.lineTo(-4, -5.5);
  g.closePath();
  g.fill();
  g.restore();
}

/** Words beside a handle, within the canvas. @param {CanvasRenderingContext2D} g
 * @param {number} x @param {number} y @param {string} text @param {number} right Edge. */
function label(g, x, y, text, right) {
  g.font = "600 12px system-ui, 'DejaVu Sans', sans-serif";
  const width = g.measureText(text).width + 14;
  const left = Math.max(4, Math.min(x + 14, right - width - 4));
  const top = Math.max(4, y - 34);
  g.fillStyle = "rgb(16 18 22 / 0.82)";
  g.beginPath();
  g.roundRect(left, top, width, 22, 6);
  g.fill();
  g.fillStyle = "#ffffff";
  g.textBaseline = "middle";
  g.textAlign = "left";
  g.fillText(text, left + 7, top + 11.5);
}
