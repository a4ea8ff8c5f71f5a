/** What the colours of the picture stand for, in the modes that draw values. */

import { byId, el } from "../dom.js";

/** @typedef {import("../main.js").App} App */

/** @type {Record<string, {title: string, unit: string, share: boolean}>} */
const VALUES = {
  confidence: { title: "Confidence", unit: "", share: true },
  depth: { title: "Depth", unit: "scene units", share: false },
  similarity: { title: "Similarity", unit: "", share: true },
};

export class Legend {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.box = byId("legend", HTMLElement);
    app.store.on(["legend", "mode"], () => this.show());
  }

  show() {
    const { legend, mode, ramp } = this.app.store;
    const values = VALUES[mode];
    const ends = legend?.mode === mode ? legend.ends : null;
    this.box.hidden = !values || !ends || ramp.length < 2;
    if (!values || !ends || this.box.hidden) return;
    // From the small value to the large one, whichever colour that has.
    const rising = ends[0] <= ends[1];
    const [low, high] = rising ? ends : [ends[1], ends[0]];
    const colours = rising ? ramp : [...ramp].reverse();
    const text = (/** @type {number} */ value) =>
      values.share ? `${(100 * value).toFixed(0)} %` : short(value);
    const bar = el("span", { class: "legend-bar" });
    bar.style.backgroundImage = `linear-gradient(to right, ${colours.join(", ")})`;
    const name = values.unit ? `${values.title}, ${values.unit}` : values.title;
    this.box.setAttribute("aria-label", `${name}: from ${text(low)} to ${text(high)}`);
    this.box.replaceChildren(
      el("span", { class: "legend-title", text: name }),
      bar,
      el("span", { class: "legend-low", text: text(low) }),
      el("span", { class: "legend-high", text: text(high) }),
    );
  }
}

/** Three digits. @param {number} value @returns {string} */
function short(value) {
  return Math.abs(value) >= 100 ? value.toFixed(0) : String(Number(value.toPrecision(3)));
}
