/** What the masks suggest: accept or reject, one by one or all. */

import { byId, el, iconButton, number, percent } from "../dom.js";
import { SUGGESTION } from "../state.js";
import { openMenu } from "./menu.js";
import { VirtualList } from "./virtual.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../state.js").Suggestion} Suggestion
 */

export class SuggestionsPanel {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.section = byId("suggestions", HTMLElement);
    this.count = el("span", { class: "count" });
    /** @type {VirtualList<Suggestion>} */
    this.list = new VirtualList({
      label: "Suggestions",
      height: 34,
      id: (item) => item.id,
      row: (item) => this.row(item),
      active: (item) => {
        app.store.suggestion = item?.id ?? null;
        app.stage.setHover(item ? SUGGESTION + item.id : 0);
      },
      key: (event, item) => this.key(event, item),
    });
    const button = (/** @type {"accept"|"reject"} */ name, /** @type {string} */ text) =>
      el("button", { type: "button", class: "button small", text, onclick: () => this.all(name) });
    this.acceptAll = button("accept", "Accept all");
    this.rejectAll = button("reject", "Reject all");
    const layers = iconButton("layers", "Suggest from a layer", () => this.layerMenu(layers), {
      class: "small",
    });
    this.layers = layers;
    this.offer = el("div", { class: "offer" });
    this.section.append(
      el(
        "div",
        { class: "panel-head" },
        el("h2", { id: "suggestions-title" }, "Suggested ", this.count),
        this.acceptAll,
        this.rejectAll,
        this.layers,
      ),
      this.offer,
      this.list.box,
    );
    this.list.box.addEventListener("blur", () => app.stage.setHover(0));
    app.store.on(["document", "scene"], () => this.show());
    this.show();
  }

  show() {
    const { store } = this.app;
    const { suggestions } = store.document;
    const layers = store.scene?.layers ?? [];
    const bare = store.scene !== null && store.scene.source === null;
    this.count.textContent = suggestions.length > 0 ? number(suggestions.length) : "";
    if (this.list.items !== suggestions) this.list.set(suggestions);
    this.list.box.hidden = suggestions.length === 0;
    this.acceptAll.hidden = suggestions.length === 0;
    this.rejectAll.hidden = suggestions.length === 0;
    this.layers.hidden = layers.length === 0;
    this.offer.hidden = suggestions.length > 0 || (!bare && layers.length === 0);
    this.section.hidden = suggestions.length === 0 && this.offer.hidden;
    this.offer.replaceChildren();
    if (this.offer.hidden) return;
    if (bare) {
      this.offer.append(
        el("p", { text: "This scene has no masks yet." }),
        el("p", {
          class: "quiet",
          text: "A click goes by colour, place and connected pieces until they are made.",
        }),
        iconButton("spark", "Make masks", () => this.makeMasks(), { text: true }),
      );
    } else {
      this.offer.append(
        el("p", { class: "quiet", text: "Objects that a layer knows can be suggested here." }),
        iconButton("layers", "Suggest from a layer…", () => this.layerMenu(this.layers), {
          text: true,
        }),
      );
    }
  }

  /** Masks of the photographs, a layer of them, its objects as suggestions: one after the other. */
  makeMasks() {
    const { jobs, store } = this.app;
    const before = new Set(store.scene?.layers ?? []);
    jobs.start("see", {}, "Making masks", () =>
      jobs.start("associate", {}, "Joining masks to objects", () => {
        const fresh = (store.scene?.layers ?? []).find((layer) => !before.has(layer));
        if (fresh) jobs.start("suggest", { layer: fresh }, `Suggestions of ${fresh}`);
      }),
    );
  }

  /** @param {HTMLElement} button */
  layerMenu(button) {
    const { app } = this;
    openMenu(button, [
      { title: "Suggest the objects of" },
      ...(app.store.scene?.layers ?? []).map((layer) => ({
        label: layer,
        icon: "layers",
        action: () => app.jobs.start("suggest", { layer }, `Suggestions of ${layer}`),
      })),
    ]);
  }

  /** @param {Suggestion} item @returns {HTMLElement} */
  row(item) {
    const { app } = this;
    const row = el(
      "div",
      { title: `${number(item.count)} Gaussians` },
      el(
        "span",
        { class: "cell label", role: "gridcell" },
        el("span", { class: "name", text: item.name }),
      ),
      el("span", { class: "cell sure", role: "gridcell", text: percent(item.score) }),
      el(
        "span",
        { class: "cell", role: "gridcell" },
        iconButton("check", `Accept ${item.name}`, () => this.decide("accept", item.id), {
          class: "plain",
          tabindex: -1,
        }),
      ),
      el(
        "span",
        { class: "cell", role: "gridcell" },
        iconButton("close", `Reject ${item.name}`, () => this.decide("reject", item.id), {
          class: "plain",
          tabindex: -1,
        }),
      ),
    );
    row.addEventListener("click", (event) => {
      if (event.target instanceof Element && event.target.closest("button")) return;
      this.list.activate(item.id);
      this.select(item);
    });
    row.addEventListener("pointerenter", () => app.stage.setHover(SUGGESTION + item.id));
    row.addEventListener("pointerleave", () => app.stage.setHover(0));
    return row;
  }

  /** @param {KeyboardEvent} event @param {Suggestion} item @returns {boolean} */
  key(event, item) {
    if (event.key === "Enter" || event.key === "y") this.decide("accept", item.id);
    else if (event.key === " ") this.select(item);
    else if (event.key === "Delete" || event.key === "x") this.decide("reject", item.id);
    else return false;
    return true;
  }

  /** Its Gaussians become the selection, to be looked at. @param {Suggestion} item */
  select(item) {
    if (!this.app.store.features.has("select_suggestion")) return;
    this.app.gestures.forget();
    this.app.command("select_suggestion", { id: item.id, mode: "set" });
  }

  /** The next or the one before; its outline shows. @param {number} step */
  walk(step) {
    const { suggestions } = this.app.store.document;
    if (suggestions.length === 0) return;
    const index = suggestions.findIndex((item) => item.id === this.list.activeId);
    const count = suggestions.length;
    const next = index < 0 ? (step > 0 ? 0 : count - 1) : (index + step + count) % count;
    this.list.activate(suggestions[next].id, true);
  }

  /** @param {"accept"|"reject"} name @param {number|null} [id] The active one by default. */
  decide(name, id = this.app.store.suggestion) {
    if (id === null) return;
    const { suggestions } = this.app.store.document;
    const index = suggestions.findIndex((item) => item.id === id);
    const next = suggestions[index + 1] ?? suggestions[index - 1];
    if (!this.app.command(name, { ids: [id] })) return;
    if (this.list.activeId === id) this.list.activeId = next?.id ?? null;
    this.app.store.suggestion = next?.id ?? null;
  }

  /** @param {"accept"|"reject"} name */
  all(name) {
    this.app.command(name, { ids: this.app.store.document.suggestions.map((item) => item.id) });
  }
}
