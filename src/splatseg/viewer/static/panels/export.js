/** The dialog of everything that can be taken away: files, layer, picture, film. */

import { byId, el, icon, iconButton } from "../dom.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {{id: string, label: string, icon: string, about: string, formats?: [string, string][],
 *   file: string, some?: boolean}} Kind
 */

/** What files may be called. */
const NAME = "[A-Za-z0-9][A-Za-z0-9._\\-]{0,59}";

/** @type {[string, string][]} */
const SPLATS = [
  ["ply", "PLY, exact, with labels"],
  ["compressed.ply", "Compressed PLY"],
  ["splat", ".splat"],
  ["spz", "SPZ"],
  ["sog", "SOG"],
];

/** @type {readonly Kind[]} */
const KINDS = [
  {
    id: "splat",
    label: "One splat file",
    icon: "layers",
    about: "The Gaussians in one file, edits applied.",
    formats: SPLATS,
    file: "scene",
    some: true,
  },
  {
    id: "objects",
    label: "A file per object",
    icon: "similar",
    about: "A folder with one splat file for each object, and a table.",
    file: "objects",
    some: true,
  },
  {
    id: "points",
    label: "Point cloud",
    icon: "points",
    about: "Middles of the Gaussians with colour and labels.",
    formats: [
      ["ply", "PLY"],
      ["las", "LAS"],
      ["laz", "LAZ, compressed LAS"],
    ],
    file: "points",
    some: true,
  },
  {
    id: "table",
    label: "Table",
    icon: "table",
    about: "Objects with class, box, volume and confidence.",
    formats: [
      ["csv", "CSV"],
      ["json", "JSON"],
    ],
    file: "objects",
    some: true,
  },
  {
    id: "coco",
    label: "COCO panoptic",
    icon: "photo",
    about: "Label maps of the views, in COCO's panoptic format.",
    file: "coco",
  },
  {
    id: "save_layer",
    label: "Layer of the scene",
    icon: "tag",
    about: "The objects as a layer of labels in the scene's folder, for every other command.",
    file: "objects",
  },
  {
    id: "picture",
    label: "Picture",
    icon: "photo",
    about: "What one sees now, as a PNG.",
    file: "picture",
  },
  {
    id: "film",
    label: "Turntable film",
    icon: "film",
    about: "Once around what one looks at.",
    file: "turntable",
  },
];

export class ExportDialog {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.dialog = byId("export", HTMLDialogElement);
    /** @type {Kind} */
    this.kind = KINDS[0];
    this.format = "ply";
    /** Whether the picked objects alone are exported: what was kept last is picked, so not by
     * default. */
    this.picked = false;
    this.dialog.addEventListener("click", (event) => {
      if (event.target === this.dialog) this.dialog.close();
    });
  }

  /** @param {string} [kind] @param {boolean} [picked] Of the picked objects alone. */
  open(kind = "splat", picked = false) {
    this.picked = picked && this.app.store.picked.size > 0;
    this.kind = KINDS.find((item) => item.id === kind) ?? KINDS[0];
    this.build();
    this.dialog.showModal();
  }

  /** @returns {readonly Kind[]} Those that this server knows. */
  kinds() {
    return KINDS.filter((kind) => kind.id !== "coco" || this.app.store.features.has("coco"));
  }

  build() {
    const { kind } = this;
    const kinds = el(
      "fieldset",
      { class: "kinds" },
      el("legend", { class: "unseen", text: "What to export" }),
    );
    for (const item of this.kinds()) {
      const id = `kind-${item.id}`;
      kinds.append(
        el("input", {
          type: "radio",
          name: "kind",
          id,
          class: "unseen",
          checked: item === kind,
          autofocus: item === kind,
          onchange: () => {
            this.kind = item;
            this.build();
            document.getElementById(id)?.focus();
          },
        }),
        el("label", { for: id }, icon(item.icon), el("span", { text: item.label })),
      );
    }
    const form = el("form", { class: "export-form", method: "dialog" });
    form.append(el("p", { class: "quiet", text: kind.about }));
    if (kind.formats) form.append(this.formatField(kind.formats));
    if (kind.some) form.append(this.whichField());
    if (kind.id === "film") form.append(this.lengthField());
    form.append(
      el(
        "label",
        { class: "form-row", for: "export-name" },
        el("span", { text: "Name" }),
        el("input", {
          type: "text",
          id: "export-name",
          maxlength: 80,
          required: true,
          pattern: NAME,
          title: "Letters, digits, - _ and ., beginning with a letter or a digit",
          value: this.defaultName(),
          autocomplete: "off",
          spellcheck: "false",
        }),
      ),
      el(
        "div",
        { class: "form-buttons" },
        el("button", {
          type: "button",
          class: "button",
          text: "Cancel",
          onclick: () => this.dialog.close(),
        }),
        el("button", {
          type: "submit",
          class: "button primary",
          text: kind.id === "save_layer" ? "Save" : "Export",
        }),
      ),
    );
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.start(form);
      this.dialog.close();
    });
    this.dialog.replaceChildren(
      el(
        "div",
        { class: "dialog-head" },
        el("h2", { id: "export-title", text: "Export" }),
        iconButton("close", "Close", () => this.dialog.close(), { class: "plain" }),
      ),
      el("div", { class: "export-body" }, kinds, form),
    );
  }

  /** @param {[string, string][]} formats */
  formatField(formats) {
    if (!formats.some(([value]) => value === this.format)) this.format = formats[0][0];
    const select = el("select", { id: "export-format" });
    for (const [value, text] of formats) {
      select.append(el("option", { value, text, selected: value === this.format }));
    }
    select.addEventListener("change", () => {
      this.format = select.value;
    });
    return el(
      "label",
      { class: "form-row", for: "export-format" },
      el("span", { text: "Format" }),
      select,
    );
  }

  whichField() {
    const { store } = this.app;
    const picked = store.picked.size;
    const select = el("select", { id: "export-which" });
    const all =
      this.kind.id === "splat" ? "The whole scene" : `All ${store.document.objects.length} objects`;
    select.append(el("option", { value: "all", text: all }));
    const text =
      picked === 1 ? `Only ${store.pickedObjects()[0].name}` : `Only the ${picked} picked objects`;
    if (picked > 0) select.append(el("option", { value: "picked", text, selected: this.picked }));
    select.addEventListener("change", () => {
      this.picked = select.value === "picked";
      const name = this.dialog.querySelector("#export-name");
      if (name instanceof HTMLInputElement && this.kind.id === "splat") {
        name.value = this.defaultName();
      }
    });
    return el(
      "label",
      { class: "form-row", for: "export-which" },
      el("span", { text: "Which" }),
      select,
    );
  }

  lengthField() {
    const select = el("select", { id: "export-frames" });
    for (const seconds of [4, 8, 12]) {
      const text = `${seconds} seconds`;
      select.append(el("option", { value: seconds * 30, text, selected: seconds === 4 }));
    }
    return el(
      "label",
      { class: "form-row", for: "export-frames" },
      el("span", { text: "Length" }),
      select,
    );
  }

  defaultName() {
    const { store } = this.app;
    const scene = store.scene?.name ?? "scene";
    const one = this.picked && store.picked.size === 1 ? store.pickedObjects()[0].name : null;
    if (this.kind.id !== "splat") return this.kind.file;
    const plain = (one ?? scene).normalize("NFKD").replaceAll(/[^A-Za-z0-9._-]+/g, "-");
    return plain.replace(/^[-._]+|[-._]+$/g, "").slice(0, 60) || "scene";
  }

  /** @param {HTMLFormElement} form */
  start(form) {
    const { app, kind } = this;
    const value = (/** @type {string} */ id) => {
      const field = form.querySelector(`#${id}`);
      return field instanceof HTMLInputElement || field instanceof HTMLSelectElement
        ? field.value
        : "";
    };
    const name = value("export-name").trim();
    const label = `${kind.label} “${name}”`;
    if (kind.id === "save_layer") {
      app.jobs.start("save_layer", { name }, label);
    } else if (kind.id === "picture") {
      app.jobs.start("picture", { camera: app.camera.record(), mode: app.store.mode, name }, label);
    } else if (kind.id === "film") {
      const frames = Number(value("export-frames"));
      const args = { camera: app.camera.record(), mode: app.store.mode, frames, name };
      app.jobs.start("film", args, label);
    } else {
      /** @type {Record<string, unknown>} */
      const args = { what: kind.id, name: kind.formats ? `${name}.${this.format}` : name };
      if (value("export-which") === "picked") args.ids = [...app.store.picked];
      app.jobs.start("export", args, label);
    }
  }
}
