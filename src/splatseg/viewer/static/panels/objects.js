/** The list of objects: search, sort, rename, colour, show, lock, and what several can do. */

import { byId, bytes, counted, el, hex, icon, iconButton, number, percent } from "../dom.js";
import { openMenu } from "./menu.js";
import { VirtualList } from "./virtual.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../state.js").SceneObject} SceneObject
 */

const SORTS = /** @type {const} */ ([
  ["order", "Order"],
  ["name", "Name"],
  ["size", "Size"],
  ["confidence", "Confidence"],
]);

export class ObjectsPanel {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.sort = "order";
    this.query = "";
    /** What the rows were made of: others' selections do not make them again. @type {unknown[]} */
    this.built = [];
    /** Row that the range of a Shift+click starts at. @type {number|null} */
    this.anchor = null;
    /** Object whose row is a text field now: rows are not rebuilt under it. @type {number|null} */
    this.renaming = null;
    const section = byId("objects", HTMLElement);
    this.count = el("span", { class: "count" });
    this.search = el("input", {
      type: "search",
      id: "object-search",
      placeholder: "Search",
      "aria-label": "Search objects by name or class",
      autocomplete: "off",
    });
    this.search.addEventListener("input", () => {
      this.query = this.search.value.trim().toLowerCase();
      this.show();
    });
    const sort = el("select", { id: "object-sort", "aria-label": "Sort objects" });
    for (const [value, text] of SORTS) sort.append(el("option", { value, text }));
    sort.addEventListener("change", () => {
      this.sort = sort.value;
      this.show();
    });
    /** @type {VirtualList<SceneObject>} */
    this.list = new VirtualList({
      label: "Objects",
      height: 34,
      id: (object) => object.id,
      row: (object) => this.row(object),
      key: (event, object) => this.key(event, object),
    });
    this.list.box.setAttribute("aria-multiselectable", "true");
    this.empty = el("div", { class: "empty" });
    this.colour = el("input", {
      type: "color",
      class: "unseen",
      tabindex: -1,
      "aria-hidden": "true",
    });
    this.colour.addEventListener("change", () =>
      app.command("set_colour", { ids: [...app.store.picked], colour: bytes(this.colour.value) }),
    );
    this.actions = el("div", {
      class: "row-actions",
      role: "group",
      "aria-label": "Picked objects",
    });
    this.showAll = iconButton("eye", "Show all objects", () => app.showAll(), {
      key: "Shift+H",
      class: "small",
    });
    const head = el(
      "div",
      { class: "panel-head" },
      el("h2", { id: "objects-title" }, "Objects ", this.count),
      el("div", { class: "field small" }, icon("search"), this.search),
      sort,
      this.showAll,
    );
    section.append(head, this.list.box, this.empty, this.actions, this.colour);
    app.store.on(["document"], () => this.show());
    app.store.on(["picked", "mode"], () => this.showPicked());
    this.show();
  }

  /** Objects as the list shows them. @returns {SceneObject[]} */
  shown() {
    const { objects } = this.app.store.document;
    const { query } = this;
    const found = query
      ? objects.filter(
          (object) =>
            object.name.toLowerCase().includes(query) || object.class.toLowerCase().includes(query),
        )
      : [...objects];
    if (this.sort === "name") {
      found.sort((a, b) => a.name.localeCompare(b.name, "en", { numeric: true }));
    } else if (this.sort === "size") found.sort((a, b) => b.count - a.count);
    else if (this.sort === "confidence") found.sort((a, b) => b.confidence - a.confidence);
    return found;
  }

  show() {
    if (this.renaming !== null) return;
    const { objects, isolated } = this.app.store.document;
    const key = [objects, isolated, this.query, this.sort];
    if (key.every((part, index) => part === this.built[index])) return;
    this.built = key;
    const shown = this.shown();
    this.count.textContent = objects.length > 0 ? number(objects.length) : "";
    this.list.set(shown);
    this.list.box.hidden = shown.length === 0;
    this.empty.hidden = shown.length > 0;
    this.empty.replaceChildren();
    if (objects.length === 0) {
      this.empty.append(
        el("p", { text: "No objects yet." }),
        el("p", { class: "quiet", text: "Click a thing in the scene, then Enter keeps it here." }),
      );
    } else {
      this.empty.append(el("p", { text: "No object has that name or class." }));
    }
    this.showAll.hidden = objects.every((object) => this.app.store.shows(object));
    this.showPicked();
  }

  showPicked() {
    const { store } = this.app;
    for (const [id, row] of this.list.shown) this.mark(row, id);
    const picked = store.pickedObjects();
    this.actions.hidden = picked.length === 0;
    const key = picked.map((object) => `${object.id}${object.locked}${object.visible}`).join();
    if (this.actions.hidden || this.actions.dataset.key === `${key}|${store.only}`) return;
    this.actions.dataset.key = `${key}|${store.only}`;
    const focused = document.activeElement?.getAttribute("aria-label");
    const held = this.actions.contains(document.activeElement);
    this.buildActions(picked);
    if (held) {
      const again = [...this.actions.querySelectorAll("button")];
      (again.find((button) => button.getAttribute("aria-label") === focused) ?? again[0])?.focus();
    }
  }

  /** @param {HTMLElement} row @param {number} id */
  mark(row, id) {
    const picked = this.app.store.picked.has(id);
    row.setAttribute("aria-selected", String(picked));
    row.toggleAttribute("data-picked", picked);
  }

  /** @param {SceneObject[]} picked */
  buildActions(picked) {
    const { app } = this;
    const { store } = app;
    const ids = picked.map((object) => object.id);
    const one = picked.length === 1 ? picked[0] : null;
    const locked = picked.some((object) => object.locked);
    const only = one !== null && store.only === one.id;
    const split = iconButton("split", "Split", () =>
      this.splitMenu(split, /** @type {SceneObject} */ (one)),
    );
    const classes = iconButton("tag", "Class", () => this.classDialog(classes, picked));
    const more = iconButton("more", "More for the picked objects", () =>
      this.moreMenu(more, picked),
    );
    const join = iconButton("join", "Join", () =>
      app.command("join", { ids, name: picked[0].name }),
    );
    join.disabled = picked.length < 2 || locked;
    split.disabled = one === null || locked;
    const alone = iconButton("isolate", only ? "Show with the others" : "Show alone", () =>
      app.setOnly(only ? null : /** @type {SceneObject} */ (one).id),
    );
    alone.disabled = one === null;
    alone.setAttribute("aria-pressed", String(only));
    const subtract = iconButton("subtract", "Subtract the selection", () =>
      app.command("subtract", { id: /** @type {SceneObject} */ (one).id }),
    );
    subtract.disabled = one === null || locked;
    const replace = iconButton("replace", "Replace by the selection", () =>
      app.command("refine", { id: /** @type {SceneObject} */ (one).id }),
    );
    replace.disabled = one === null || locked;
    const remove = iconButton("trash", "Delete from the list", () =>
      app.command("delete", { ids }),
    );
    remove.disabled = locked;
    this.actions.replaceChildren(
      el("span", {
        class: "quiet picked-count",
        text: one ? "1 picked" : `${picked.length} picked`,
      }),
      join,
      split,
      subtract,
      replace,
      classes,
      alone,
      remove,
      more,
    );
  }

  /** @param {HTMLElement} button @param {SceneObject} object */
  splitMenu(button, object) {
    const { app } = this;
    const { store } = app;
    const tree = store.scene?.source === "tree" || (store.scene?.layers.length ?? 0) > 0;
    const split = (/** @type {Record<string, unknown>} */ how) =>
      app.command("split", { id: object.id, ...how });
    openMenu(button, [
      { label: "Connected parts", icon: "split", action: () => split({ by: "parts" }) },
      {
        label: "Parts of the tree",
        icon: "layers",
        disabled: !tree,
        action: () => split({ by: "tree" }),
      },
      "line",
      {
        label: "Left and right of the pivot",
        icon: "split",
        action: () => split({ by: "plane", plane: app.look.cuttingPlane(object, "upright") }),
      },
      {
        label: "Above and below the pivot",
        icon: "minus",
        action: () => split({ by: "plane", plane: app.look.cuttingPlane(object, "level") }),
      },
    ]);
  }

  /** @param {HTMLElement} button @param {SceneObject[]} picked */
  moreMenu(button, picked) {
    const { app } = this;
    const ids = picked.map((object) => object.id);
    const visible = picked.some((object) => object.visible);
    const locked = picked.some((object) => object.locked);
    openMenu(button, [
      {
        label: "Rename",
        icon: "stroke",
        key: "F2",
        disabled: picked.length !== 1,
        action: () => this.rename(ids[0]),
      },
      {
        label: "Colour…",
        icon: "colour",
        action: () => {
          this.colour.value = hex(picked[0].colour);
          this.colour.showPicker();
        },
      },
      { label: "Frame", icon: "frame", key: "F", action: () => app.look.frame(true) },
      {
        label: visible ? "Hide" : "Show",
        icon: visible ? "eye-off" : "eye",
        key: "H",
        action: () => app.command("set_visible", { ids, visible: !visible }),
      },
      { label: "Hide all others", icon: "isolate", action: () => app.command("isolate", { ids }) },
      {
        label: locked ? "Unlock" : "Lock",
        icon: locked ? "unlock" : "lock",
        action: () => app.command("set_locked", { ids, locked: !locked }),
      },
      "line",
      {
        label: "Duplicate in the scene",
        icon: "duplicate",
        action: () => app.edit("duplicate", undefined, ids),
      },
      {
        label: "Remove from the scene",
        icon: "trash",
        key: "Del",
        action: () => app.edit("remove", undefined, ids),
      },
      { label: "Export…", icon: "export", action: () => app.exportDialog.open("objects", true) },
    ]);
  }

  /** @param {HTMLElement} button @param {SceneObject[]} picked */
  classDialog(button, picked) {
    const { app } = this;
    const names = [...new Set(app.store.document.objects.map((object) => object.class))];
    const known = names.filter(Boolean).sort((a, b) => a.localeCompare(b, "en"));
    const list = el("datalist", { id: "class-names" });
    for (const value of known) list.append(el("option", { value }));
    const input = el("input", {
      type: "text",
      id: "class-name",
      list: "class-names",
      maxlength: 80,
      value: picked[0].class,
      autocomplete: "off",
    });
    const form = el(
      "form",
      { class: "popup", popover: "auto" },
      el("label", { for: "class-name", text: `Class of ${counted(picked.length, "object")}` }),
      el(
        "div",
        { class: "line" },
        input,
        el("button", { type: "submit", class: "button primary", text: "Set" }),
      ),
      list,
    );
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      const ids = picked.map((object) => object.id);
      app.command("set_class", { ids, class_name: input.value.trim() });
      form.hidePopover();
    });
    form.addEventListener("toggle", (event) => {
      if (/** @type {ToggleEvent} */ (event).newState !== "closed") return;
      form.remove();
      button.focus();
    });
    this.actions.append(form);
    form.showPopover();
    const at = button.getBoundingClientRect();
    form.style.left = `${Math.max(8, Math.min(at.left, innerWidth - form.offsetWidth - 8))}px`;
    form.style.top = `${Math.max(8, at.top - form.offsetHeight - 6)}px`;
    input.select();
  }

  /** @param {SceneObject} object @returns {HTMLElement} */
  row(object) {
    const { app } = this;
    const colour = el("input", {
      type: "color",
      value: hex(object.colour),
      tabindex: -1,
      "aria-label": `Colour of ${object.name}`,
      title: "Colour",
    });
    colour.addEventListener("change", () =>
      app.command("set_colour", { ids: [object.id], colour: bytes(colour.value) }),
    );
    const swatch = el("span", { class: "cell swatch", role: "gridcell" }, colour);
    colour.addEventListener("click", (event) => event.stopPropagation());
    const name = el("span", { class: "name", text: object.name });
    const label = el(
      "span",
      { class: "cell label", role: "gridcell" },
      name,
      object.class ? el("span", { class: "class", text: object.class }) : null,
    );
    label.addEventListener("dblclick", () => this.rename(object.id));
    const eye = iconButton(
      object.visible ? "eye" : "eye-off",
      `${object.visible ? "Hide" : "Show"} ${object.name}`,
      () => app.command("set_visible", { ids: [object.id], visible: !object.visible }),
      { class: "plain eye", tabindex: -1 },
    );
    const lock = iconButton(
      object.locked ? "lock" : "unlock",
      `${object.locked ? "Unlock" : "Lock"} ${object.name}`,
      () => app.command("set_locked", { ids: [object.id], locked: !object.locked }),
      { class: "plain lock", tabindex: -1 },
    );
    const row = el(
      "div",
      {
        title: `${object.name}: ${counted(object.count, "Gaussian")}, from ${object.source || "a selection"}`,
      },
      swatch,
      label,
      el("span", { class: "cell size", role: "gridcell", text: compact(object.count) }),
      el("span", { class: "cell sure", role: "gridcell", text: percent(object.confidence) }),
      el("span", { class: "cell", role: "gridcell" }, eye),
      el("span", { class: "cell", role: "gridcell" }, lock),
    );
    row.toggleAttribute("data-hidden", !app.store.shows(object));
    row.toggleAttribute("data-locked", object.locked);
    row.addEventListener("click", (event) => {
      if (event.target instanceof Element && event.target.closest("button, input")) return;
      this.list.activate(object.id);
      this.pick(object, event.ctrlKey || event.metaKey, event.shiftKey);
    });
    row.addEventListener("pointerenter", () => app.stage.setHover(object.id + 1));
    row.addEventListener("pointerleave", () => app.stage.setHover(0));
    this.mark(row, object.id);
    return row;
  }

  /** Pick a row: its Gaussians become the selection. @param {SceneObject} object
   * @param {boolean} more One more. @param {boolean} range All from the last one. */
  pick(object, more, range) {
    const { store } = this.app;
    const shown = this.shown();
    if (range && this.anchor !== null) {
      const from = shown.findIndex((item) => item.id === this.anchor);
      const to = shown.findIndex((item) => item.id === object.id);
      if (from >= 0 && to >= 0) {
        const part = shown.slice(Math.min(from, to), Math.max(from, to) + 1);
        store.pick(part.map((item) => item.id));
        this.app.selectObjects([...store.picked]);
        return;
      }
    }
    this.anchor = object.id;
    const picked = new Set(more ? store.picked : []);
    if (more && picked.has(object.id)) picked.delete(object.id);
    else picked.add(object.id);
    store.pick(picked);
    this.app.selectObjects([...picked]);
  }

  /** @param {KeyboardEvent} event @param {SceneObject} object @returns {boolean} */
  key(event, object) {
    const { app } = this;
    const more = event.ctrlKey || event.metaKey;
    if (event.key === "Enter" || event.key === " ") this.pick(object, more, event.shiftKey);
    else if (event.key === "F2") this.rename(object.id);
    else if (event.key === "Delete") {
      const picked = app.store.picked.has(object.id) ? [...app.store.picked] : [object.id];
      app.command("delete", { ids: picked });
    } else if (event.key === "h" && !more) {
      app.command("set_visible", { ids: [object.id], visible: !object.visible });
    } else if (event.key === "k" && !more) {
      app.command("set_locked", { ids: [object.id], locked: !object.locked });
    } else return false;
    return true;
  }

  /** Edit the name in its row. @param {number} id */
  rename(id) {
    const object = this.app.store.byId.get(id);
    if (!object) return;
    this.app.showPanel("objects");
    if (!this.shown().some((item) => item.id === id)) {
      this.query = "";
      this.search.value = "";
      this.show();
    }
    this.list.activate(id, true);
    const label = this.list.shown.get(id)?.querySelector(".label");
    if (!(label instanceof HTMLElement)) return;
    const input = el("input", {
      type: "text",
      class: "rename",
      value: object.name,
      maxlength: 80,
      "aria-label": `New name of ${object.name}`,
      autocomplete: "off",
      spellcheck: "false",
    });
    const active = document.activeElement;
    const { stage } = this.app;
    const before = active === stage.overlay ? stage : this.list.box;
    let done = false;
    const finish = (/** @type {boolean} */ take) => {
      if (done) return;
      done = true;
      this.renaming = null;
      this.built = [];
      const name = input.value.trim();
      this.show();
      if (take && name && name !== object.name) this.app.command("rename", { id, name });
    };
    input.addEventListener("keydown", (event) => {
      event.stopPropagation();
      if (event.key !== "Enter" && event.key !== "Escape") return;
      finish(event.key === "Enter");
      before.focus();
    });
    input.addEventListener("blur", () => finish(true));
    this.renaming = id;
    label.replaceChildren(input);
    input.focus();
    input.select();
  }
}

/** 1.2 k, 34 k, 1.5 M. @param {number} count @returns {string} */
function compact(count) {
  if (count < 1000) return String(count);
  if (count < 999_500) return `${(count / 1000).toFixed(count < 9950 ? 1 : 0)} k`;
  return `${(count / 1e6).toFixed(1)} M`;
}
