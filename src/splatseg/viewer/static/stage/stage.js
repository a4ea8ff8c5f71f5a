/**
 * The canvas: picture, outline under the pointer, photograph, and what the pointer does.
 *
 * A tool gets the left button first; what it does not take turns the camera.
 *
 * @typedef {import("../main.js").App} App
 * @typedef {import("../state.js").Vec3} Vec3
 * @typedef {import("./outline.js").IdMap} IdMap
 * @typedef {{x: number, y: number, shift: boolean, ctrl: boolean, alt: boolean, touch: boolean}} Point
 *   Of the canvas in CSS pixels, with the modifiers.
 * @typedef {{cursor: string, says: string, down?: (point: Point) => boolean,
 *   move?: (point: Point) => void, up?: (point: Point) => void, click?: (point: Point) => void,
 *   hover?: (point: Point) => void, cancel?: () => boolean, enter?: () => boolean,
 *   arrow?: (x: number, y: number) => boolean,
 *   draw?: (g: CanvasRenderingContext2D, ratio: number) => void}} Tool
 */

import { Camera, add, between, mul } from "../camera.js";
import { byId, calm, clamp } from "../dom.js";
import { drawOverlay } from "./overlay.js";
import { Photograph } from "./photograph.js";

const DRAG_FROM = 3;
const ORBIT_SPEED = 0.0055;
const LOOK_SPEED = 0.004;
const WHEEL_SPEED = 0.0012;
const SWING = 260;
const LONGEST_SIDE = 2560;
/** Tools that select the thing under the pointer. */
const POINTING = ["click", "box", "stroke"];

export class Stage {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.box = byId("stage", HTMLElement);
    this.picture = byId("picture", HTMLCanvasElement);
    this.overlay = byId("overlay", HTMLCanvasElement);
    this.label = byId("hover-label", HTMLElement);
    this.photograph = new Photograph(app, this);
    /** Picture pixels a CSS pixel. */
    this.ratio = 1;
    /** @type {"orbit"|"fly"} */
    this.movement = "orbit";
    /** @type {IdMap|null} */
    this.ids = null;
    /** @type {Map<number, Path2D>} */
    this.outlines = new Map();
    /** @type {Point|null} */
    this.pointer = null;
    /** @type {Map<number, {x: number, y: number}>} */
    this.fingers = new Map();
    /** @type {{id: number, button: number, x: number, y: number, lastX: number, lastY: number,
     *   moved: boolean, tool: boolean}|null} */
    this.drag = null;
    this.lastTap = { time: 0, x: 0, y: 0, gesture: 0 };
    /** @type {Set<string>} Keys of flying that are down. */
    this.flying = new Set();
    this.flySpeed = 1;
    this.flyTime = 0;
    this.swing = 0;
    this.pivotShown = 0;
    this.drawing = false;
    this.seen = false;
    /** Whether the canvas has the focus by the pointer: `Tab` is then a key of the view. */
    this.byPointer = false;
    this.wasByPointer = false;
    this.listen();
  }

  listen() {
    const { overlay } = this;
    new ResizeObserver(() => this.resize()).observe(this.box);
    overlay.addEventListener("pointerdown", (event) => this.pointerDown(event));
    overlay.addEventListener("pointermove", (event) => this.pointerMove(event));
    overlay.addEventListener("pointerup", (event) => this.pointerUp(event, false));
    overlay.addEventListener("pointercancel", (event) => this.pointerUp(event, true));
    overlay.addEventListener("pointerleave", () => this.leave());
    // The middle button would begin to scroll.
    overlay.addEventListener("mousedown", (event) => event.button === 1 && event.preventDefault());
    overlay.addEventListener("contextmenu", (event) => event.preventDefault());
    overlay.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    overlay.addEventListener("focus", () => {
      overlay.toggleAttribute("data-keyboard", !this.byPointer);
      this.redraw();
    });
    overlay.addEventListener("blur", () => {
      this.wasByPointer = this.byPointer;
      this.byPointer = false;
      this.flying.clear();
      this.redraw();
    });
    this.app.store.on(["tool", "selection", "hint", "selectMode", "document"], () => {
      overlay.dataset.cursor = this.tool.cursor;
      this.redraw();
    });
  }

  /** Back to the canvas, as one was there before. */
  focus() {
    this.byPointer = this.wasByPointer;
    this.overlay.focus({ preventScroll: true });
  }

  /** @returns {Tool} */
  get tool() {
    return this.app.tools[this.app.store.tool];
  }

  resize() {
    const width = this.box.clientWidth;
    const height = this.box.clientHeight;
    if (width < 2 || height < 2) return;
    const longest = Math.max(width, height);
    this.ratio = Math.min(devicePixelRatio || 1, 2, LONGEST_SIDE / longest);
    const { camera } = this.app;
    camera.width = Math.round(width * this.ratio);
    camera.height = Math.round(height * this.ratio);
    this.overlay.width = Math.round(width * (devicePixelRatio || 1));
    this.overlay.height = Math.round(height * (devicePixelRatio || 1));
    this.photograph.place();
    this.moved();
  }

  /** A new picture. @param {ImageBitmap} bitmap */
  paint(bitmap) {
    const { picture, app } = this;
    if (picture.width !== app.camera.width || picture.height !== app.camera.height) {
      picture.width = app.camera.width;
      picture.height = app.camera.height;
    }
    const g = picture.getContext("2d", { alpha: false });
    if (!g) return;
    g.imageSmoothingQuality = "high";
    g.drawImage(bitmap, 0, 0, picture.width, picture.height);
    if (!this.seen) {
      this.seen = true;
      this.box.dataset.seen = "";
    }
  }

  /** @param {IdMap} ids */
  setIds(ids) {
    this.ids = ids;
    this.outlines.clear();
    this.hoverAt(this.pointer);
    this.redraw();
  }

  /** The camera moved, by whatever. */
  moved() {
    this.ids = null;
    this.outlines.clear();
    this.setHover(0);
    this.photograph.check();
    this.app.drawing.moved();
    this.app.look.remember();
    this.redraw();
  }

  /**
   * Go to another pose, with a short swing where motion is welcome.
   * @param {(camera: Camera) => void} change
   * @param {() => void} [then]
   */
  go(change, then) {
    const { camera } = this.app;
    const from = new Camera();
    from.copy(camera);
    change(camera);
    const to = new Camera();
    to.copy(camera);
    cancelAnimationFrame(this.swing);
    if (calm() || !this.seen) {
      this.moved();
      then?.();
      return;
    }
    const start = performance.now();
    /** @param {number} now */
    const step = (now) => {
      const share = clamp((now - start) / SWING, 0, 1);
      const eased = 1 - (1 - share) ** 3;
      if (share < 1) {
        between(from, to, eased, camera);
        this.swing = requestAnimationFrame(step);
      } else {
        camera.copy(to);
      }
      this.moved();
      if (share >= 1) then?.();
    };
    this.swing = requestAnimationFrame(step);
  }

  /** @param {MouseEvent} event @returns {Point} */
  point(event) {
    const box = this.overlay.getBoundingClientRect();
    return {
      x: event.clientX - box.left,
      y: event.clientY - box.top,
      shift: event.shiftKey,
      ctrl: event.ctrlKey || event.metaKey,
      alt: event.altKey,
      touch: event instanceof PointerEvent && event.pointerType === "touch",
    };
  }

  /** Pixels of the camera of a point of the canvas. @param {{x: number, y: number}} point
   * @returns {[number, number]} */
  pixel(point) {
    return [round(point.x * this.ratio), round(point.y * this.ratio)];
  }

  /** Where a world point is on the canvas, CSS pixels. @param {Vec3} point */
  css(point) {
    const { x, y, depth } = this.app.camera.project(point);
    return { x: x / this.ratio, y: y / this.ratio, depth };
  }

  /** Whether a world point lies in the picture. @param {Vec3} point @returns {boolean} */
  sees(point) {
    const { x, y, depth } = this.css(point);
    const { clientWidth: width, clientHeight: height } = this.box;
    return depth > 0 && x >= 0 && y >= 0 && x <= width && y <= height;
  }

  /** @param {PointerEvent} event */
  pointerDown(event) {
    this.byPointer = true;
    this.overlay.focus({ preventScroll: true });
    delete this.overlay.dataset.keyboard;
    cancelAnimationFrame(this.swing);
    const point = this.point(event);
    this.overlay.setPointerCapture(event.pointerId);
    if (event.pointerType === "touch") {
      this.fingers.set(event.pointerId, { x: point.x, y: point.y });
      if (this.fingers.size === 2) {
        if (this.drag?.tool) this.tool.cancel?.();
        this.drag = null;
        return;
      }
    }
    if (this.drag) return;
    const tool = event.button === 0 && (this.tool.down?.(point) ?? false);
    this.drag = {
      id: event.pointerId,
      button: event.button,
      x: point.x,
      y: point.y,
      lastX: point.x,
      lastY: point.y,
      moved: false,
      tool,
    };
    if (tool) {
      this.setHover(0);
      this.redraw();
    }
  }

  /** @param {PointerEvent} event */
  pointerMove(event) {
    const point = this.point(event);
    this.pointer = point;
    if (event.pointerType === "touch" && this.fingers.size === 2) {
      this.pinch(event.pointerId, point);
      return;
    }
    const drag = this.drag;
    if (!drag || drag.id !== event.pointerId) {
      this.hoverAt(point);
      this.tool.hover?.(point);
      return;
    }
    const dx = point.x - drag.lastX;
    const dy = point.y - drag.lastY;
    if (!drag.moved && Math.hypot(point.x - drag.x, point.y - drag.y) < DRAG_FROM) return;
    drag.moved = true;
    drag.lastX = point.x;
    drag.lastY = point.y;
    if (drag.tool) {
      this.tool.move?.(point);
      this.redraw();
      return;
    }
    this.overlay.dataset.dragging = "";
    if (drag.button === 2 || (drag.button === 1 && event.shiftKey)) this.pan(dx, dy);
    else if (drag.button === 1 && event.ctrlKey) this.zoom(Math.exp(dy * 0.006), drag);
    else this.turn(dx, dy);
  }

  /** @param {PointerEvent} event @param {boolean} cancelled */
  pointerUp(event, cancelled) {
    const point = this.point(event);
    const fingers = this.fingers.size;
    this.fingers.delete(event.pointerId);
    delete this.overlay.dataset.dragging;
    const drag = this.drag;
    if (!drag || drag.id !== event.pointerId || fingers > 1) {
      this.redraw();
      return;
    }
    this.drag = null;
    if (cancelled) {
      if (drag.tool) this.tool.cancel?.();
    } else if (drag.tool) {
      this.tool.up?.(point);
    } else if (!drag.moved && drag.button === 0) {
      this.click(point);
    }
    if (point.touch) this.pointer = null;
    this.redraw();
  }

  /** A press without a drag; the second of two puts the pivot there. @param {Point} point */
  click(point) {
    const now = performance.now();
    const near = Math.hypot(point.x - this.lastTap.x, point.y - this.lastTap.y) < 6;
    if (near && now - this.lastTap.time < 350) {
      this.lastTap.time = 0;
      if (this.lastTap.gesture) this.app.revert(this.lastTap.gesture);
      this.setPivot(point);
      return;
    }
    const { gestures } = this.app;
    const before = gestures.count;
    this.tool.click?.(point);
    const gesture = gestures.count > before ? gestures.count : 0;
    this.lastTap = { time: now, x: point.x, y: point.y, gesture };
  }

  /** @param {Point} point */
  setPivot(point) {
    this.app.depth(this.pixel(point), (world) => {
      if (!world) return;
      this.pivotShown = performance.now() + 900;
      this.go(
        (camera) => camera.lookAt(world),
        () => setTimeout(() => this.redraw(), 950),
      );
    });
  }

  /** @param {number} id @param {Point} point */
  pinch(id, point) {
    const before = [...this.fingers.values()];
    this.fingers.set(id, { x: point.x, y: point.y });
    const after = [...this.fingers.values()];
    const middle = (/** @type {{x: number, y: number}[]} */ two) => ({
      x: (two[0].x + two[1].x) / 2,
      y: (two[0].y + two[1].y) / 2,
    });
    const apart = (/** @type {{x: number, y: number}[]} */ two) =>
      Math.max(8, Math.hypot(two[0].x - two[1].x, two[0].y - two[1].y));
    const [from, to] = [middle(before), middle(after)];
    this.app.camera.pan((to.x - from.x) * this.ratio, (to.y - from.y) * this.ratio);
    this.zoom(apart(before) / apart(after), to);
  }

  /** @param {WheelEvent} event */
  wheel(event) {
    event.preventDefault();
    const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 30 : 1;
    // Two fingers on a touch pad come as a wheel with Ctrl, in small steps.
    const pinch = event.ctrlKey ? 5 : 1;
    const delta = clamp(event.deltaY * lines * pinch, -240, 240);
    this.zoom(Math.exp(delta * WHEEL_SPEED), this.point(event));
  }

  /** @param {number} dx CSS pixels. @param {number} dy */
  turn(dx, dy) {
    const { camera } = this.app;
    if (this.movement === "fly") camera.look(-dx * LOOK_SPEED, -dy * LOOK_SPEED);
    else camera.orbit(-dx * ORBIT_SPEED, -dy * ORBIT_SPEED);
    this.pivotShown = this.movement === "orbit" ? performance.now() + 400 : 0;
    this.moved();
  }

  /** @param {number} dx CSS pixels. @param {number} dy */
  pan(dx, dy) {
    this.app.camera.pan(dx * this.ratio, dy * this.ratio);
    this.moved();
  }

  /** @param {number} factor @param {{x: number, y: number}} at CSS pixels. */
  zoom(factor, at) {
    const [x, y] = this.pixel(at);
    this.app.camera.zoom(factor, x, y);
    this.moved();
  }

  /** The middle of the canvas. @returns {Point} */
  middle() {
    const { clientWidth: width, clientHeight: height } = this.box;
    return { x: width / 2, y: height / 2, shift: false, ctrl: false, alt: false, touch: false };
  }

  /** Keys of flying: `KeyW` and so on. @param {string} code @param {boolean} down
   * @param {number} speed */
  fly(code, down, speed) {
    const idle = this.flying.size === 0;
    if (down) this.flying.add(code);
    else this.flying.delete(code);
    this.flySpeed = speed;
    if (!idle || !down) return;
    this.flyTime = performance.now();
    /** @param {number} now */
    const step = (now) => {
      if (this.flying.size === 0) return;
      const seconds = Math.min(0.1, (now - this.flyTime) / 1000);
      this.flyTime = now;
      const { camera } = this.app;
      const way = 0.6 * camera.radius * this.flySpeed * seconds;
      const has = (/** @type {string} */ key) => (this.flying.has(key) ? 1 : 0);
      const ahead = mul(camera.forward, has("KeyW") - has("KeyS"));
      const aside = mul(camera.right, has("KeyD") - has("KeyA"));
      const above = mul(camera.up, has("KeyE") - has("KeyQ"));
      camera.move(mul(add(add(ahead, aside), above), way));
      this.moved();
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  leave() {
    this.pointer = null;
    this.setHover(0);
    this.tool.hover?.({ x: -1e4, y: -1e4, shift: false, ctrl: false, alt: false, touch: false });
    this.redraw();
  }

  /** What the id map has at a point: no message. @param {Point|null} point */
  hoverAt(point) {
    // Outlines say what a click means; what is drawn around things does not go by them.
    const busy = this.drag !== null || !POINTING.includes(this.app.store.tool);
    if (!point || point.touch || busy || !this.ids) {
      this.setHover(0);
      return;
    }
    if (this.photograph.covers(point)) {
      this.setHover(0);
      return;
    }
    const { width, height, ids } = this.ids;
    const x = Math.floor((point.x / this.box.clientWidth) * width);
    const y = Math.floor((point.y / this.box.clientHeight) * height);
    const inside = x >= 0 && y >= 0 && x < width && y < height;
    this.setHover(inside ? ids[y * width + x] : 0);
    if (this.app.store.hover) {
      const left = clamp(point.x + 14, 4, this.box.clientWidth - this.label.offsetWidth - 4);
      const top = clamp(point.y + 18, 4, this.box.clientHeight - this.label.offsetHeight - 4);
      this.label.style.translate = `${left}px ${top}px`;
    }
  }

  /** @param {number} code */
  setHover(code) {
    const { store } = this.app;
    if (store.hover === code) return;
    store.hover = code;
    const name = store.nameOf(code);
    this.label.textContent = name;
    this.label.hidden = !name;
    store.changed("hover");
    this.redraw();
  }

  /** Draw the overlay with the next frame of the screen. */
  redraw() {
    if (this.drawing) return;
    this.drawing = true;
    requestAnimationFrame(() => {
      this.drawing = false;
      drawOverlay(this.app);
    });
  }
}

/** @param {number} value @returns {number} */
function round(value) {
  return Math.round(value * 100) / 100;
}
