/** The top: scene, undo and redo, modes, link, export, settings; the sheets of a narrow page. */

import { byId, el, iconButton } from "../dom.js";
import { openMenu } from "./menu.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../state.js").Vec3} Vec3
 */

/** @type {Record<string, string>} */
const MODE_NAMES = {
  colour: "Colour",
  objects: "Objects",
  blend: "Blend",
  confidence: "Confidence",
  depth: "Depth",
  pca: "Features",
  similarity: "Similarity",
};

/** @type {Record<string, string>} */
const MODE_TITLES = {
  colour: "As the photographs show it",
  objects: "Each object in its colour",
  blend: "Colours of the objects over the picture (Tab)",
  confidence: "How sure each Gaussian's object is",
  depth: "Distance along the optical axis",
  pca: "Three main directions of the features",
  similarity: "How similar everything is to the words or the selection",
};

const THEMES = /** @type {const} */ (["auto", "light", "dark"]);

/** @type {readonly {label: string, up: Vec3}[]} */
const UPS = [
  { label: "+X up", up: [1, 0, 0] },
  { label: "−X up", up: [-1, 0, 0] },
  { label: "+Y up", up: [0, 1, 0] },
  { label: "−Y up", up: [0, -1, 0] },
  { label: "+Z up", up: [0, 0, 1] },
  { label: "−Z up", up: [0, 0, -1] },
];

export class TopBar {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.undo = iconButton("undo", "Undo", () => app.undo(), { key: "Ctrl+Z" });
    this.redo = iconButton("redo", "Redo", () => app.redo(), { key: "Ctrl+Shift+Z" });
    byId("history", HTMLElement).append(this.undo, this.redo);
    this.modes = byId("modes", HTMLFieldSetElement);
    const settings = iconButton("settings", "Settings", () => this.settings(settings));
    const exports = iconButton("export", "Export", () => app.exportDialog.open(), {
      key: "Ctrl+E",
      text: true,
      class: "primary",
    });
    byId("actions", HTMLElement).append(
      iconButton("link", "Copy a link to this view", () => app.look.copyLink()),
      iconButton("help", "Keys and mouse", () => app.helpDialog.open(), { key: "?" }),
      settings,
      exports,
    );
    this.tabs = byId("sheet-tabs", HTMLElement);
    /** @type {Map<string, HTMLButtonElement>} */
    this.tabButtons = new Map();
    for (const [id, label] of [
      ["objects", "Objects"],
      ["suggestions", "Suggested"],
      ["views", "Photographs"],
    ]) {
      const tab = el("button", {
        type: "button",
        role: "tab",
        class: "tab",
        id: `tab-${id}`,
        "aria-controls": id,
        text: label,
        onclick: () => this.sheet(document.body.dataset.sheet === id ? null : id),
      });
      this.tabButtons.set(id, tab);
      this.tabs.append(tab);
    }
    this.tabs.addEventListener("keydown", (event) => {
      if (event.key !== "ArrowRight" && event.key !== "ArrowLeft") return;
      const open = [...this.tabButtons.values()].filter((tab) => !tab.hidden);
      const index = open.indexOf(/** @type {HTMLButtonElement} */ (document.activeElement));
      const next = open[(index + (event.key === "ArrowRight" ? 1 : open.length - 1)) % open.length];
      next?.focus();
    });
    this.sheet(null);
    app.store.on(["document", "scene", "mode"], () => this.show());
    this.theme(localStorage.getItem("splatseg-theme") ?? "auto");
    this.show();
  }

  show() {
    const { store } = this.app;
    this.label(this.undo, "Undo", store.undo, "Ctrl+Z");
    this.label(this.redo, "Redo", store.redo, "Ctrl+Shift+Z");
    const name = store.scene?.name ?? "splatseg";
    byId("scene-name", HTMLElement).textContent = name;
    byId("scene-name", HTMLElement).title = name;
    document.title = store.scene ? `${name} – splatseg` : "splatseg";
    const modes = store.scene?.modes ?? ["colour"];
    if (this.modes.dataset.modes !== modes.join()) this.buildModes(modes);
    for (const input of this.modes.querySelectorAll("input")) {
      input.checked = input.value === store.mode;
    }
    const { suggestions } = store.document;
    const tab = (/** @type {string} */ id) =>
      /** @type {HTMLButtonElement} */ (this.tabButtons.get(id));
    tab("objects").textContent = `Objects ${store.document.objects.length || ""}`;
    tab("suggestions").textContent = `Suggested ${suggestions.length || ""}`;
    tab("views").hidden = (store.scene?.views.length ?? 0) === 0;
    tab("suggestions").hidden = byId("suggestions", HTMLElement).hidden;
  }

  /** @param {HTMLButtonElement} button @param {string} verb @param {string|null} what
   * @param {string} key */
  label(button, verb, what, key) {
    button.disabled = what === null;
    const text = what ? `${verb}: ${what}` : verb;
    button.setAttribute("aria-label", text);
    button.title = `${text} (${key})`;
  }

  /** @param {string[]} modes */
  buildModes(modes) {
    this.modes.dataset.modes = modes.join();
    const legend = this.modes.firstElementChild;
    this.modes.replaceChildren(...(legend ? [legend] : []));
    for (const mode of modes) {
      const id = `mode-${mode}`;
      this.modes.append(
        el("input", {
          type: "radio",
          name: "mode",
          id,
          value: mode,
          class: "unseen",
          onchange: () => this.app.setMode(mode),
        }),
        el("label", { for: id, title: MODE_TITLES[mode] ?? mode, text: MODE_NAMES[mode] ?? mode }),
      );
    }
  }

  /** @param {string|null} id Of the panel that a narrow page shows. */
  sheet(id) {
    if (id === null) delete document.body.dataset.sheet;
    else document.body.dataset.sheet = id;
    for (const [name, tab] of this.tabButtons) {
      tab.setAttribute("aria-selected", String(name === id));
      tab.tabIndex = name === (id ?? "objects") ? 0 : -1;
    }
  }

  /** @param {string} theme */
  theme(theme) {
    const known = THEMES.find((name) => name === theme) ?? "auto";
    document.documentElement.dataset.theme = known;
    localStorage.setItem("splatseg-theme", known);
  }

  /** Who draws while the camera moves. @returns {import("./menu.js").Item[]} */
  drawers() {
    const { drawing } = this.app;
    /** @type {[import("../stage/choice.js").Wanted, string][]} */
    const drawers = [
      ["server", "By the server"],
      ["gpu", "In the page, on its GPU"],
    ];
    // Against the page's own judgement.
    if (drawing.reason || drawing.wanted === "forced") {
      drawers.push(["forced", "In the page, however slow"]);
    }
    return drawers.map(([wanted, label]) => ({
      label,
      checked: drawing.wanted === wanted,
      action: () => drawing.choose(wanted),
    }));
  }

  /** @param {HTMLElement} button */
  settings(button) {
    const { app } = this;
    const now = document.documentElement.dataset.theme;
    const up = app.camera.up.join();
    const sceneUp = app.store.scene?.up ?? [0, 0, 1];
    const same = (/** @type {Vec3} */ a) => a.join() === up;
    const known = UPS.some((item) => same(item.up));
    openMenu(button, [
      { title: "Appearance" },
      ...THEMES.map((theme) => ({
        label: { auto: "As the system", light: "Light", dark: "Dark" }[theme],
        checked: now === theme,
        action: () => this.theme(theme),
      })),
      { title: "Camera" },
      {
        label: "Orbit",
        key: "V",
        checked: app.stage.movement === "orbit",
        action: () => app.stage.movement === "fly" && app.look.toggleFly(),
      },
      {
        label: "Fly",
        key: "V",
        checked: app.stage.movement === "fly",
        action: () => app.stage.movement === "orbit" && app.look.toggleFly(),
      },
      { title: "Up" },
      {
        label: "As the scene says",
        checked: !known || up === sceneUp.join(),
        action: () => app.look.setUp(sceneUp),
      },
      ...UPS.filter((item) => item.up.join() !== sceneUp.join()).map((item) => ({
        label: item.label,
        checked: same(item.up),
        action: () => app.look.setUp(item.up),
      })),
      { title: "Drawing" },
      ...this.drawers(),
      { title: "Keys" },
      {
        label: "Keys of one letter",
        checked: app.keys.letters,
        toggle: true,
        action: () => app.keys.setLetters(!app.keys.letters),
      },
    ]);
  }
}
