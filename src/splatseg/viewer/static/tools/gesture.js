/**
 * Prompts on their way: one gesture is one prompt, sent again as a whole when it is refined.
 *
 * @typedef {import("../main.js").App} App
 * @typedef {import("../state.js").SelectMode} SelectMode
 * @typedef {import("../stage/stage.js").Point} Point
 * @typedef {{kind: string, points?: number[][], negative?: number[][], box?: number[],
 *   width?: number, radius?: number, text?: string}} Prompt
 */

const APART = 3;
const MOST_POINTS = 1500;

/**
 * Go on with a line that a pointer draws: a point where it is far enough from the last one.
 * @param {Point[]} points @param {Point} point
 */
export function follow(points, point) {
  const last = points.at(-1);
  if (!last || points.length >= MOST_POINTS) return;
  if (Math.hypot(point.x - last.x, point.y - last.y) >= APART) points.push(point);
}

export class Gestures {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.count = 0;
    /** @type {{gesture: number, prompt: Prompt, mode: SelectMode, view: string|null,
     *   camera: import("../camera.js").CameraRecord|null}|null} */
    this.current = null;
    /** Gesture whose final answer is awaited (0: none). */
    this.pending = 0;
    /** Gesture that was answered last. */
    this.done = 0;
    this.levelTimer = 0;
  }

  /**
   * What the modifiers ask for: Shift adds, Ctrl removes, both intersect.
   * @param {Pick<Point, "shift"|"ctrl">} keys @returns {SelectMode}
   */
  modeOf({ shift, ctrl }) {
    if (shift && ctrl) return "intersect";
    if (shift) return "add";
    return ctrl ? "remove" : this.app.store.selectMode;
  }

  /**
   * A new prompt.
   * @param {Prompt} prompt
   * @param {{mode?: SelectMode, view?: string|null}} [how]
   */
  begin(prompt, { mode = "set", view = null } = {}) {
    this.count += 1;
    const camera = view === null ? this.app.camera.record() : null;
    this.current = { gesture: this.count, prompt, mode, view, camera };
    this.post();
  }

  /** The same prompt, changed. @param {Prompt} prompt */
  refine(prompt) {
    if (!this.current) return;
    this.current.prompt = prompt;
    this.post();
  }

  /** The same prompt with the level that is set now. */
  again() {
    clearTimeout(this.levelTimer);
    const leveled = ["click", "box", "stroke", "lasso", "polygon", "words"];
    if (!this.current || !leveled.includes(this.current.prompt.kind)) return;
    this.levelTimer = setTimeout(() => this.post(), 90);
  }

  post() {
    if (!this.current) return;
    const { gesture, prompt, mode, view, camera } = this.current;
    /** @type {Record<string, unknown> & {type: string}} */
    const message = { type: "select", gesture, camera, ...prompt, mode };
    message.level = this.app.store.level;
    if (view !== null) message.view = view;
    if (!this.app.send(message)) return;
    this.pending = gesture;
    this.app.store.hint = null;
    this.app.store.changed("selection", "hint");
  }

  /** @param {{gesture: number, stage: string}} answer */
  answered(answer) {
    if (answer.stage !== "final") return;
    this.done = answer.gesture;
    if (answer.gesture >= this.pending) this.pending = 0;
  }

  /** @param {number} gesture */
  failed(gesture) {
    if (gesture === this.pending) this.pending = 0;
    if (this.app.store.selected?.stage === "draft") this.app.store.selected = null;
    this.app.store.changed("selection");
  }

  /** The prompt is over: undo, another selection, a new connection. */
  forget() {
    this.current = null;
    this.pending = 0;
  }

  /** Whether the current gesture was made where one looks from now. @returns {boolean} */
  here() {
    const { current } = this;
    if (!current) return false;
    if (current.view !== null) return current.view === this.app.store.photograph;
    return current.camera?.matrix.join() === this.app.camera.matrix().join();
  }

  /**
   * On the photograph or on the render: a point of the canvas as pixels of it.
   * @param {Point} point
   * @returns {{view: string|null, pixel: (point: {x: number, y: number}) => [number, number],
   *   scale: number}} `scale`: pixels a CSS pixel.
   */
  target(point) {
    const { stage } = this.app;
    const { photograph } = stage;
    if (photograph.covers(point) && photograph.view) {
      return {
        view: photograph.view.name,
        pixel: (at) => photograph.pixel(at),
        scale: 1 / photograph.scale,
      };
    }
    return { view: null, pixel: (at) => stage.pixel(at), scale: stage.ratio };
  }
}
