/** Click: one point is a prompt; further points, for or against, refine it. */

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../stage/stage.js").Tool} Tool
 * @typedef {import("../stage/stage.js").Point} Point
 */

/** @implements {Tool} */
export class ClickTool {
  cursor = "crosshair";
  says = "Click a thing. Alt+click: not this. Shift adds, Ctrl removes, both intersect.";

  /** @param {App} app */
  constructor(app) {
    this.app = app;
    /** What a plain click is: a new prompt, or a point of the current one. @type {"new"|"more"|"less"} */
    this.points = "new";
    /** Where the points are drawn, CSS pixels. @type {{x: number, y: number, good: boolean}[]} */
    this.marks = [];
  }

  /** @param {Point} point */
  click(point) {
    const { gestures } = this.app;
    const target = gestures.target(point);
    const pixel = target.pixel(point);
    const { current } = gestures;
    const refines = point.alt || this.points !== "new";
    const good = point.alt ? point.shift : this.points !== "less";
    const same =
      gestures.here() && current?.prompt.kind === "click" && current.view === target.view;
    if (refines && same && current) {
      const { points = [], negative = [] } = current.prompt;
      this.marks.push({ x: point.x, y: point.y, good });
      gestures.refine({
        kind: "click",
        points: good ? [...points, pixel] : points,
        negative: good ? negative : [...negative, pixel],
      });
      return;
    }
    const against = refines && !good;
    this.marks = [{ x: point.x, y: point.y, good: !against }];
    // After the camera has moved a point against is a prompt of its own, taken away.
    const mode = against ? "remove" : refines ? "add" : gestures.modeOf(point);
    gestures.begin({ kind: "click", points: [pixel] }, { mode, view: target.view });
  }

  /** @returns {boolean} */
  cancel() {
    this.marks = [];
    return false;
  }

  /** @param {CanvasRenderingContext2D} g */
  draw(g) {
    if (!this.app.gestures.here()) return;
    for (const { x, y, good } of this.marks) {
      g.beginPath();
      g.arc(x, y, 6, 0, 7);
      g.fillStyle = good ? "#1a7f45" : "#c8321f";
      g.fill();
      g.lineWidth = 2;
      g.strokeStyle = "#ffffff";
      g.stroke();
      g.lineWidth = 1.75;
      g.beginPath();
      g.moveTo(x - 2.8, y);
      g.lineTo(x + 2.8, y);
      if (good) {
        g.moveTo(x, y - 2.8);
        g.lineTo(x, y + 2.8);
      }
      g.stroke();
    }
  }
}
