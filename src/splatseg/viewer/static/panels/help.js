/** All keys and what the mouse does, from the table that the keys are read from. */

import { byId, el, iconButton } from "../dom.js";
import { KEYS, LIST, MOUSE } from "../keys.js";

/** @typedef {import("../main.js").App} App */

export class HelpDialog {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.dialog = byId("help", HTMLDialogElement);
    this.dialog.addEventListener("click", (event) => {
      if (event.target === this.dialog) this.dialog.close();
    });
  }

  open() {
    const { app } = this;
    /** @type {Map<string, {shown: string, label: string}[]>} */
    const groups = new Map([["Mouse and touch", [...MOUSE]]]);
    for (const key of KEYS) {
      const group = groups.get(key.group) ?? [];
      if (key.shown) group.push({ shown: key.shown, label: key.label });
      groups.set(key.group, group);
    }
    groups.set("In the list of objects", [...LIST]);
    const body = el("div", {
      class: "help-body",
      tabindex: 0,
      role: "group",
      "aria-label": "Keys",
    });
    for (const [title, rows] of groups) {
      const list = el("dl", {});
      for (const { shown, label } of rows) {
        const term = el("dt", {});
        for (const [index, part] of shown.split(" ").entries()) {
          if (index > 0) term.append(" ");
          term.append(el("kbd", { text: part.replaceAll("_", " ") }));
        }
        list.append(el("div", {}, term, el("dd", { text: label })));
      }
      body.append(el("section", {}, el("h3", { text: title }), list));
    }
    const letters = el("input", { type: "checkbox", id: "letters", checked: app.keys.letters });
    letters.addEventListener("change", () => app.keys.setLetters(letters.checked));
    this.dialog.replaceChildren(
      el(
        "div",
        { class: "dialog-head" },
        el("h2", { id: "help-title", text: "Keys and mouse" }),
        el("label", { class: "check", for: "letters" }, letters, "Keys of one letter"),
        iconButton("close", "Close", () => this.dialog.close(), { class: "plain" }),
      ),
      body,
    );
    this.dialog.showModal();
  }
}
