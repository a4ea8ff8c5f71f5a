/** The bar under the picture: what is selected, how large a part, and what to do with it. */

import { byId, counted, el, icon, iconButton, percent } from "../dom.js";
import { openMenu } from "./menu.js";

/** @typedef {import("../main.js").App} App */

export class SelectionBar {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.bar = byId("bar", HTMLElement);
    this.count = el("span", { class: "bar-count", role: "status" });
    this.sure = el("span", { class: "bar-sure quiet" });
    this.level = el("input", {
      type: "range",
      id: "level",
      min: 0,
      max: 1,
      step: 0.05,
      value: app.store.level,
      "aria-label": "Level, from part to group",
      title: "How large a thing a prompt means (, and .)",
    });
    this.level.addEventListener("input", () => app.setLevel(Number(this.level.value)));
    this.name = el("input", {
      type: "text",
      id: "keep-name",
      maxlength: 80,
      placeholder: "Name",
      "aria-label": "Name of the object to keep",
      autocomplete: "off",
      spellcheck: "false",
    });
    this.form = el(
      "form",
      { class: "keep" },
      this.name,
      el(
        "button",
        { type: "submit", class: "button primary", title: "Keep as an object (Enter)" },
        el("span", { text: "Keep" }),
        el("kbd", { "aria-hidden": "true", text: "⏎" }),
      ),
    );
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.keep();
      app.stage.focus();
    });
    this.name.addEventListener("keydown", (event) => {
      if (event.key === "Escape") app.stage.focus();
    });
    const shape = (
      /** @type {string} */ name,
      /** @type {string} */ label,
      /** @type {string} */ kind,
    ) => iconButton(name, label, () => app.selectKind(kind));
    this.shapes = el(
      "div",
      { class: "group", role: "group", "aria-label": "Shape of the selection" },
      shape("grow", "Grow", "grow"),
      shape("shrink", "Shrink", "shrink"),
      shape("fill", "Fill holes", "fill"),
      shape("similar", "More like this", "similar"),
    );
    this.remove = iconButton("trash", "Remove from the scene", () => app.edit("remove"), {
      key: "Del",
    });
    const more = iconButton("more", "More for the selection", () => this.menu(more));
    this.colour = el("input", {
      type: "color",
      class: "unseen",
      tabindex: -1,
      "aria-hidden": "true",
    });
    this.colour.addEventListener("change", () => app.recolour(this.colour.value));
    this.edits = el(
      "div",
      { class: "group", role: "group", "aria-label": "Edit the selection" },
      this.remove,
      more,
      this.colour,
    );
    this.levels = el(
      "div",
      { class: "level" },
      el("span", { "aria-hidden": "true", text: "Part" }),
      this.level,
      el("span", { "aria-hidden": "true", text: "Group" }),
    );
    this.hintButton = el(
      "button",
      { type: "button", class: "button hint", hidden: true, onclick: () => app.look.goToHint() },
      icon("spark"),
      el("span", { text: "Next click" }),
    );
    this.bar.append(
      el("div", { class: "bar-info" }, this.count, this.sure),
      this.levels,
      this.shapes,
      this.edits,
      this.form,
      this.hintButton,
    );
    app.store.on(["selection", "picked", "level", "hint", "connection"], () => this.show());
    this.show();
  }

  /** Keep what is selected, named by the field. */
  keep() {
    if (!this.app.store.document.selection) {
      this.app.toast("Nothing is selected.", "Click a thing first, then keep it.");
      return;
    }
    this.app.keep(this.name.value.trim());
    this.name.value = "";
  }

  /** @param {HTMLElement} button */
  menu(button) {
    const { app } = this;
    const any = app.store.document.selection !== null;
    const layers = app.store.features.has("layer") ? (app.store.scene?.layers ?? []) : [];
    openMenu(button, [
      {
        label: "Duplicate",
        icon: "duplicate",
        disabled: !any,
        action: () => app.edit("duplicate"),
      },
      {
        label: "Recolour…",
        icon: "colour",
        disabled: !any,
        action: () => this.colour.showPicker(),
      },
      {
        label: "Move",
        icon: "move",
        key: "1",
        disabled: !any,
        action: () => app.setMove("translate"),
      },
      "line",
      { label: "Select all", icon: "set", key: "Ctrl A", action: () => app.selectKind("all") },
      { label: "Invert", icon: "intersect", key: "Ctrl I", action: () => app.selectKind("invert") },
      {
        label: "Select none",
        icon: "close",
        key: "Ctrl Shift A",
        disabled: !any,
        action: () => app.selectKind("none"),
      },
      ...(layers.length > 0 ? [{ title: "Select what a layer holds" }] : []),
      ...layers.map((layer) => ({
        label: layer,
        icon: "layers",
        action: () => app.selectLayer(layer),
      })),
    ]);
  }

  /** What edits are of, without a selection. @returns {string} */
  pickedText() {
    const picked = this.app.store.pickedObjects();
    if (picked.length === 0) return "Nothing selected";
    return picked.length === 1 ? `${picked[0].name} picked` : `${picked.length} objects picked`;
  }

  show() {
    const { store, gestures } = this.app;
    const { selection } = store.document;
    const draft = store.selected?.stage === "draft" ? store.selected : null;
    const shown = draft ?? selection;
    const busy = gestures.pending !== 0;
    this.bar.toggleAttribute("data-busy", busy);
    this.bar.toggleAttribute("data-empty", !shown);
    const none = busy ? "Selecting…" : this.pickedText();
    this.count.textContent = shown ? counted(shown.count, "Gaussian") : none;
    this.sure.textContent = shown ? `${percent(shown.confidence)} sure` : "";
    this.sure.hidden = !shown;
    this.level.value = String(store.level);
    this.level.setAttribute("aria-valuetext", `${percent(store.level)} of the way to the group`);
    for (const button of this.shapes.querySelectorAll("button")) button.disabled = !selection;
    this.remove.disabled = !selection && store.picked.size === 0;
    const { hint } = store;
    this.hintButton.hidden = !hint?.view;
    this.hintButton.title = hint?.view ? `A click in ${hint.view} would help most` : "";
  }
}
