/** Words: the field at the top finds what it is told. */

import { byId } from "../dom.js";

/** @typedef {import("../main.js").App} App */

export class Words {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.field = byId("find", HTMLInputElement);
    const form = byId("find-form", HTMLFormElement);
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.find({ shift: false, ctrl: false });
    });
    this.field.addEventListener("keydown", (event) => {
      if (event.key === "Escape") {
        app.stage.focus();
        event.stopPropagation();
      }
      if (event.key === "Enter" && (event.shiftKey || event.ctrlKey)) {
        event.preventDefault();
        this.find({ shift: event.shiftKey, ctrl: event.ctrlKey });
      }
    });
    app.store.on(["scene"], () => this.show());
    this.show();
  }

  /** @param {{shift: boolean, ctrl: boolean}} keys */
  find(keys) {
    const text = this.field.value.trim();
    if (!text || this.field.disabled) return;
    const { gestures } = this.app;
    gestures.begin({ kind: "words", text }, { mode: gestures.modeOf(keys) });
    this.app.stage.focus();
  }

  show() {
    const possible = this.app.store.scene?.words ?? false;
    this.field.disabled = !possible;
    this.field.placeholder = possible ? "Find: red mug" : "No word search in this scene";
    this.field.title = possible
      ? "Describe a thing and press Enter (/)"
      : "Words need features of a language model: see splatseg see --help";
  }
}
