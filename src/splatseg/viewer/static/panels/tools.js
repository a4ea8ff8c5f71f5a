/** The rail of tools, and the options of the tool in use. */

import { byId, el, icon, iconButton } from "../dom.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../state.js").SelectMode} SelectMode
 * @typedef {import("../state.js").ToolId} ToolId
 * @typedef {import("../tools/move.js").Kind} Kind
 */

/** @type {readonly {id: ToolId, label: string, key: string}[]} */
const TOOLS = [
  { id: "click", label: "Click", key: "C" },
  { id: "box", label: "Box", key: "R" },
  { id: "stroke", label: "Stroke", key: "B" },
  { id: "lasso", label: "Lasso", key: "L" },
  { id: "polygon", label: "Polygon", key: "P" },
  { id: "sphere", label: "Sphere", key: "O" },
];

/** @type {readonly {kind: Kind, icon: string, label: string, key: string}[]} */
const MOVES = [
  { kind: "translate", icon: "move", label: "Move", key: "1" },
  { kind: "rotate", icon: "rotate", label: "Rotate", key: "2" },
  { kind: "scale", icon: "scale", label: "Scale", key: "3" },
];

/** @type {readonly {mode: SelectMode, icon: string, label: string, key: string}[]} */
const SELECT_MODES = [
  { mode: "set", icon: "set", label: "New selection", key: "no modifier" },
  { mode: "add", icon: "plus", label: "Add to the selection", key: "Shift" },
  { mode: "remove", icon: "minus", label: "Remove from the selection", key: "Ctrl" },
  {
    mode: "intersect",
    icon: "intersect",
    label: "Intersect with the selection",
    key: "Shift+Ctrl",
  },
];

export class ToolPanel {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.rail = byId("tools", HTMLElement);
    this.options = byId("tool-options", HTMLElement);
    /** @type {Map<string, HTMLButtonElement>} */
    this.buttons = new Map();
    this.build();
    app.store.on(["tool", "selectMode", "scene"], () => this.show());
    this.show();
  }

  build() {
    const { app } = this;
    const select = el("div", {
      class: "tool-group",
      role: "group",
      "aria-label": "Selection tools",
    });
    for (const { id, label, key } of TOOLS) {
      const button = iconButton(id, label, () => app.setTool(id), { key });
      this.buttons.set(id, button);
      select.append(button);
    }
    const edit = el("div", { class: "tool-group", role: "group", "aria-label": "Edit tools" });
    for (const { kind, icon: name, label, key } of MOVES) {
      const button = iconButton(name, label, () => app.setMove(kind), { key });
      this.buttons.set(kind, button);
      edit.append(button);
    }
    const look = el("div", { class: "tool-group", role: "group", "aria-label": "View" });
    look.append(
      iconButton("frame", "Frame the selection", () => app.look.frame(true), { key: "F" }),
      iconButton("home", "Frame everything", () => app.look.frame(false), { key: "Shift+F" }),
    );
    const fly = iconButton("fly", "Fly", () => app.look.toggleFly(), { key: "V" });
    this.buttons.set("fly", fly);
    look.append(fly);
    this.rail.append(select, edit, look);
  }

  show() {
    const { store, stage, tools } = this.app;
    const active = store.tool === "move" ? tools.move.kind : store.tool;
    for (const [id, button] of this.buttons) {
      const on = id === "fly" ? stage.movement === "fly" : id === active;
      button.setAttribute("aria-pressed", String(on));
    }
    this.showOptions();
  }

  showOptions() {
    const { app, options } = this;
    const { store, tools } = app;
    const focused = document.activeElement?.id;
    options.replaceChildren();
    options.hidden = store.tool === "move";
    if (options.hidden) return;
    options.append(
      segments("selmode", "How it joins the selection", SELECT_MODES, store.selectMode, (mode) => {
        store.selectMode = mode;
        store.changed("selectMode");
      }),
    );
    if (store.tool === "click") {
      const kinds = /** @type {const} */ ([
        { mode: "new", text: "New", label: "A click is a new prompt", key: "" },
        {
          mode: "more",
          text: "+ Point",
          label: "A click is a point for the same thing",
          key: "Alt+Shift",
        },
        { mode: "less", text: "− Point", label: "A click is a point against it", key: "Alt" },
      ]);
      options.append(
        segments("points", "What a click is", kinds, tools.click.points, (mode) => {
          tools.click.points = mode;
          store.changed("tool");
        }),
      );
    }
    if (store.tool === "stroke") {
      options.append(
        slider("brush", "Brush", 2, 120, tools.stroke.width, (width) =>
          tools.stroke.setWidth(width),
        ),
      );
    }
    if (store.tool === "sphere") {
      options.append(
        slider("ball", "Radius", 4, 250, tools.sphere.radius, (size) =>
          tools.sphere.setRadius(size),
        ),
      );
    }
    if (store.tool === "polygon") {
      options.append(
        iconButton("check", "Close the polygon", () => tools.polygon.enter(), { key: "Enter" }),
      );
    }
    if (focused) document.getElementById(focused)?.focus();
  }
}

/**
 * A row of radio buttons that looks like one control.
 * @template {string} M
 * @param {string} name
 * @param {string} legend
 * @param {readonly {mode: M, label: string, key: string, icon?: string, text?: string}[]} choices
 * @param {M} value
 * @param {(mode: M) => void} choose
 */
function segments(name, legend, choices, value, choose) {
  const box = el(
    "fieldset",
    { class: "segments" },
    el("legend", { class: "unseen", text: legend }),
  );
  for (const choice of choices) {
    const id = `${name}-${choice.mode}`;
    const input = el("input", {
      type: "radio",
      id,
      name,
      class: "unseen",
      checked: choice.mode === value,
      "aria-label": choice.text ? null : choice.label,
      onchange: () => choose(choice.mode),
    });
    const title = choice.key ? `${choice.label} (${choice.key})` : choice.label;
    const label = el("label", { for: id, title });
    if (choice.icon) label.append(icon(choice.icon));
    if (choice.text) label.append(el("span", { text: choice.text }));
    box.append(input, label);
  }
  return box;
}

/**
 * @param {string} id @param {string} name @param {number} min @param {number} max
 * @param {number} value @param {(value: number) => void} change
 */
function slider(id, name, min, max, value, change) {
  const input = el("input", { type: "range", id, min, max, value });
  input.addEventListener("input", () => {
    output.textContent = `${input.value} px`;
  });
  input.addEventListener("change", () => change(Number(input.value)));
  const output = el("output", { for: id, text: `${value} px` });
  return el("label", { class: "slider", for: id }, el("span", { text: name }), input, output);
}
