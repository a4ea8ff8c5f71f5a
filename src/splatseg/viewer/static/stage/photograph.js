/**
 * A photograph laid over the render, with a divider; prompts on it are pixels of the photograph.
 */

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../state.js").SceneView} SceneView
 * @typedef {import("./stage.js").Stage} Stage
 */

import { byId, clamp } from "../dom.js";

export class Photograph {
  /** @param {App} app @param {Stage} stage */
  constructor(app, stage) {
    this.app = app;
    this.stage = stage;
    this.image = byId("photograph", HTMLImageElement);
    this.divider = byId("divider", HTMLElement);
    /** @type {SceneView|null} */
    this.view = null;
    /** World_from_camera it belongs to; another pose hides it. */
    this.pose = "";
    /** Of the canvas's width, left of it is the photograph. */
    this.share = 0.5;
    this.scale = 1;
    this.left = 0;
    this.top = 0;
    this.divider.addEventListener("pointerdown", (event) => {
      this.divider.setPointerCapture(event.pointerId);
      event.preventDefault();
      this.divider.focus();
    });
    this.divider.addEventListener("pointermove", (event) => {
      if (!this.divider.hasPointerCapture(event.pointerId)) return;
      const box = stage.box.getBoundingClientRect();
      this.setShare((event.clientX - box.left) / box.width);
    });
    this.divider.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: -0.02, ArrowRight: 0.02, PageDown: -0.1, PageUp: 0.1 };
      const step = steps[/** @type {keyof typeof steps} */ (event.key)];
      if (step) this.setShare(this.share + step);
      else if (event.key === "Home") this.setShare(0);
      else if (event.key === "End") this.setShare(1);
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  /** Lay it over the canvas; the camera is already that of the view. @param {SceneView} view */
  async show(view) {
    this.view = view;
    this.pose = this.app.camera.matrix().join();
    this.app.store.photograph = view.name;
    const width = Math.min(
      1600,
      view.width,
      Math.ceil(this.stage.box.clientWidth * this.stage.ratio),
    );
    const path = `/photographs/${encodeURIComponent(view.name)}?width=${width}`;
    try {
      this.image.src = await this.app.socket.address(path);
    } catch {
      this.app.toast("This photograph could not be loaded.", "See whether the server still runs.");
    }
    this.image.alt = `Photograph ${view.name}`;
    this.image.hidden = false;
    this.divider.hidden = false;
    this.place();
    this.app.store.changed("compare");
  }

  hide() {
    if (!this.view) return;
    this.view = null;
    this.image.hidden = true;
    this.divider.hidden = true;
    this.app.store.photograph = null;
    this.app.store.changed("compare");
  }

  /** Gone when the camera leaves its place. */
  check() {
    if (this.view && this.app.camera.matrix().join() !== this.pose) this.hide();
  }

  place() {
    const { view, image } = this;
    if (!view) return;
    const { camera } = this.app;
    this.scale = camera.pixels / view.fx / this.stage.ratio;
    this.left = this.stage.box.clientWidth / 2 - view.cx * this.scale;
    this.top = this.stage.box.clientHeight / 2 - view.cy * this.scale;
    image.style.width = `${view.width * this.scale}px`;
    image.style.height = `${view.height * this.scale}px`;
    image.style.translate = `${this.left}px ${this.top}px`;
    this.setShare(this.share);
  }

  /** @param {number} share */
  setShare(share) {
    this.share = clamp(share, 0, 1);
    if (!this.view) return;
    const width = this.stage.box.clientWidth;
    const from = clamp(width * this.share - this.left, 0, this.view.width * this.scale);
    this.image.style.clipPath = `inset(0 ${this.view.width * this.scale - from}px 0 0)`;
    this.divider.style.translate = `${width * this.share}px 0`;
    this.divider.setAttribute("aria-valuenow", String(Math.round(100 * this.share)));
    this.divider.setAttribute("aria-valuetext", `${Math.round(100 * this.share)} % photograph`);
  }

  /** Whether the photograph is what one sees at a point of the canvas. @param {{x: number}} point */
  covers(point) {
    return this.view !== null && point.x < this.stage.box.clientWidth * this.share;
  }

  /** Where a pixel of a view is on the canvas, if the camera is that of the view.
   * @param {string} name @param {{x: number, y: number}} pixel @returns {{x: number, y: number}|null} */
  css(name, { x, y }) {
    const view = this.app.store.view(name);
    if (!view) return null;
    const scale = this.app.camera.pixels / view.fx / this.stage.ratio;
    const { clientWidth: width, clientHeight: height } = this.stage.box;
    return { x: width / 2 + (x - view.cx) * scale, y: height / 2 + (y - view.cy) * scale };
  }

  /** Pixel of the photograph. @param {{x: number, y: number}} point @returns {[number, number]} */
  pixel(point) {
    const { width, height } = /** @type {SceneView} */ (this.view);
    const x = clamp((point.x - this.left) / this.scale, 0, width);
    const y = clamp((point.y - this.top) / this.scale, 0, height);
    return [Math.round(x * 100) / 100, Math.round(y * 100) / 100];
  }
}
