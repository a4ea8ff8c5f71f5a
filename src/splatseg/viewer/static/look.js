/** Where one looks from: home, framing, up, flying, the link that comes back here. */

import { add, dot, mul, norm, sub, unit } from "./camera.js";
import { clamp } from "./dom.js";

/**
 * @typedef {import("./main.js").App} App
 * @typedef {import("./state.js").Vec3} Vec3
 * @typedef {import("./state.js").SceneObject} SceneObject
 */

const REMEMBER_AFTER = 400;

export class Look {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.timer = 0;
  }

  goHome() {
    const { scene } = this.app.store;
    if (!scene) return;
    const { matrix, focal, width, height } = scene.home;
    this.app.camera.focal = clamp(focal / Math.max(width, height), 0.2, 5);
    const ahead = dot(sub(scene.centre, [matrix[3], matrix[7], matrix[11]]), [
      matrix[2],
      matrix[6],
      matrix[10],
    ]);
    this.app.camera.setMatrix(matrix, ahead > 0 ? ahead : scene.radius * 0.5);
  }

  /**
   * A plane through the pivot, where it lies in the object, else through its middle.
   * @param {SceneObject} object
   * @param {"upright"|"level"} kind
   * @returns {number[]} a, b, c, d with a x + b y + c z + d = 0
   */
  cuttingPlane(object, kind) {
    const { camera } = this.app;
    const centre = object.centre ?? camera.pivot;
    const inside = norm(sub(camera.pivot, centre)) < (object.radius ?? 0);
    const point = inside ? camera.pivot : centre;
    const flat = sub(camera.right, mul(camera.up, dot(camera.right, camera.up)));
    const normal = kind === "level" ? camera.up : unit(flat);
    return [...normal, -dot(normal, point)];
  }

  /** @param {boolean} selection Or the whole scene. */
  frame(selection) {
    const { scene } = this.app.store;
    if (!scene) return;
    const subject = selection ? this.app.tools.move.subject() : null;
    if (subject) {
      const { about, radius } = subject;
      this.app.stage.go((camera) => camera.frame(about, radius || camera.radius * 0.1));
    } else if (selection) this.app.toast("Nothing is selected.", "Shift+F frames everything.");
    else this.app.stage.go((camera) => camera.frame(scene.centre, scene.radius));
  }

  toggleFly() {
    this.app.stage.movement = this.app.stage.movement === "orbit" ? "fly" : "orbit";
    this.app.store.changed("tool");
  }

  /** @param {Vec3} up */
  setUp(up) {
    this.app.stage.go((camera) => {
      camera.up = unit(up);
      const away = norm(sub(camera.pivot, camera.position));
      const flat = sub(camera.forward, mul(camera.up, dot(camera.forward, camera.up)));
      if (norm(flat) < 0.1) {
        const side =
          Math.abs(camera.up[0]) > 0.9
            ? /** @type {Vec3} */ ([0, 1, 0])
            : /** @type {Vec3} */ ([1, 0, 0]);
        camera.position = sub(camera.pivot, mul(unit(add(side, mul(camera.up, -0.4))), away));
      }
      camera.lookAt(camera.pivot);
    });
  }

  goToHint() {
    const view = this.app.store.hint?.view;
    const found = view ? this.app.store.view(view) : null;
    if (found) this.app.views.goTo(found);
  }

  /** Keep the camera in the address, so that a reload comes back here. */
  remember() {
    if (!this.app.started) return;
    clearTimeout(this.timer);
    this.timer = setTimeout(
      () => replaceFragment(`#view=${this.app.camera.toLink()}`),
      REMEMBER_AFTER,
    );
  }

  async copyLink() {
    const address = `${location.origin}${location.pathname}#view=${this.app.camera.toLink()}`;
    replaceFragment(`#view=${this.app.camera.toLink()}`);
    try {
      await navigator.clipboard.writeText(address);
      this.app.toasts.show("The link to this view is copied.", "", { good: true });
    } catch {
      this.app.toasts.show("The link to this view is in the address line.", "Copy it from there.", {
        good: true,
      });
    }
  }
}

/** The part of the address after `#`, without a step back in the history. @param {string} fragment */
export function replaceFragment(fragment) {
  history.replaceState(null, "", `${location.pathname}${location.search}${fragment}`);
}
