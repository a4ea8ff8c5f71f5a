/** The line at the bottom: counts, milliseconds, who draws, whether it is saved; the notices. */

import { byId, counted, el, number } from "../dom.js";

/** @typedef {import("../main.js").App} App */

export class StatusLine {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.box = byId("status", HTMLElement);
    this.notice = byId("notice", HTMLElement);
    this.says = el("span", { class: "says" });
    this.count = el("span", {});
    this.size = el("span", { class: "wide" });
    this.times = el("span", { class: "wide" });
    this.draws = el("span", { class: "wide" });
    this.edits = el("span", { class: "wide" });
    this.saved = el("span", {});
    this.people = el("span", {});
    this.box.append(
      this.says,
      this.count,
      this.size,
      this.times,
      this.draws,
      this.edits,
      this.saved,
      this.people,
    );
    app.store.on(["status", "scene", "connection", "tool", "selection"], () => this.show());
    this.show();
  }

  show() {
    const { store, stage, drawing } = this.app;
    const { frame, scene, selected } = store;
    const open = store.connection === "open";
    this.says.textContent = stage.tool.says;
    this.count.textContent = scene ? counted(scene.count, "Gaussian") : "";
    this.size.textContent = frame ? `${frame.width} × ${frame.height}` : "";
    const times = [];
    if (selected) times.push(`select ${selected.milliseconds.toFixed(0)}`);
    if (frame) {
      times.push(`draw ${frame.draw.toFixed(0)}`, `encode ${frame.encode.toFixed(0)}`);
      times.push(`whole ${frame.whole.toFixed(0)} ms`);
    }
    this.times.textContent = times.join("  ");
    const stages = Object.entries(selected?.stages ?? {});
    this.times.title = stages.map(([name, ms]) => `${name} ${ms.toFixed(0)} ms`).join(", ");
    this.draws.textContent = drawing.says;
    const edits = store.document.edits.length;
    this.edits.textContent = edits > 0 ? counted(edits, "edit") : "";
    this.saved.textContent = open ? "saved" : "";
    this.people.textContent =
      open && store.clients > 1 ? counted(store.clients, "person", "people") : "";
    for (const part of this.box.children) {
      if (part instanceof HTMLElement) part.hidden = part.textContent === "";
    }
    this.showNotice();
  }

  showNotice() {
    const { store, socket } = this.app;
    const texts = {
      connecting: store.scene ? "Connecting again…" : "Opening the scene…",
      lost: "The server is away. Trying again by itself; what was done is kept.",
      refused:
        "This page is not let in. Open the address that the command printed, with its token.",
      full: "Too many people look at this scene. Close another page of it and reload.",
      open: "",
    };
    let text = texts[store.connection];
    if (!text && !store.ready) text = "Warming up: the first click will be quick in a moment.";
    if (!text && store.fitting) {
      const share = Math.round(100 * store.fitting.progress);
      text = `Still being fitted: ${number(store.fitting.steps)} steps, ${share} %. The picture improves.`;
    }
    if (this.notice.dataset.text === text) return;
    this.notice.dataset.text = text;
    this.notice.replaceChildren();
    this.notice.hidden = text === "";
    if (!text) return;
    const waits = store.connection === "connecting" || store.connection === "open";
    this.notice.append(el("span", { class: waits ? "spinner" : "dot", "aria-hidden": "true" }));
    this.notice.append(el("span", { text }));
    if (store.connection === "lost" || store.connection === "refused") {
      this.notice.append(
        el("button", {
          type: "button",
          class: "button small",
          text: "Try now",
          onclick: () => socket.retry(),
        }),
      );
    }
  }
}
