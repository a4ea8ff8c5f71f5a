/** The strip of photographs: a click goes to that camera, the divider compares. */

import { byId, el, iconButton, number } from "../dom.js";

/**
 * @typedef {import("../main.js").App} App
 * @typedef {import("../state.js").SceneView} SceneView
 */

const THUMBNAIL = 160;

export class ViewsPanel {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.section = byId("views", HTMLElement);
    this.title = el("span", { text: "Photographs " });
    this.count = el("span", { class: "count" });
    this.strip = el("div", { class: "strip", role: "group", "aria-label": "Photographs" });
    /** Where the camera stands, if at a photograph's place. @type {string|null} */
    this.current = null;
    this.compare = iconButton(
      "compare",
      "Compare with the photograph",
      () => this.toggleCompare(),
      {
        class: "small",
      },
    );
    const previous = iconButton("chevron", "Photograph before", () => this.step(-1), {
      class: "small left",
    });
    const next = iconButton("chevron", "Next photograph", () => this.step(1), {
      class: "small right",
    });
    this.section.append(
      el(
        "div",
        { class: "panel-head" },
        el("h2", { id: "views-title" }, this.title, this.count),
        el("span", { class: "grow" }),
        previous,
        next,
        this.compare,
      ),
      this.strip,
    );
    this.watcher = new IntersectionObserver((entries) => this.load(entries), {
      root: this.strip,
      rootMargin: "0px 300px",
    });
    this.strip.addEventListener("keydown", (event) => {
      if (event.key !== "ArrowRight" && event.key !== "ArrowLeft") return;
      const buttons = [...this.strip.querySelectorAll("button")];
      const index = buttons.indexOf(/** @type {HTMLButtonElement} */ (document.activeElement));
      buttons[index + (event.key === "ArrowRight" ? 1 : -1)]?.focus();
      event.preventDefault();
    });
    app.store.on(["scene"], () => this.build());
    app.store.on(["compare"], () => this.show());
    this.build();
  }

  build() {
    const views = this.app.store.scene?.views ?? [];
    this.section.hidden = views.length === 0;
    const photographs = views.some((view) => view.photograph);
    this.title.textContent = photographs ? "Photographs " : "Cameras ";
    this.compare.hidden = !photographs;
    const names = views.map((view) => view.name).join("\n");
    if (this.strip.dataset.names === names) return;
    this.strip.dataset.names = names;
    this.count.textContent = number(views.length);
    this.watcher.disconnect();
    this.strip.replaceChildren();
    for (const [index, view] of views.entries()) {
      const button = el(
        "button",
        {
          type: "button",
          class: "thumb",
          title: view.name,
          "aria-label": `Camera of ${view.name}`,
          "data-view": view.name,
          tabindex: index === 0 ? 0 : -1,
          onclick: () => this.goTo(view),
        },
        el("img", { alt: "", draggable: "false" }),
        el("span", { text: view.name.split("/").at(-1) ?? view.name }),
      );
      button.addEventListener("focus", () => {
        for (const other of this.strip.querySelectorAll("button")) other.tabIndex = -1;
        button.tabIndex = 0;
      });
      this.strip.append(button);
      this.watcher.observe(button);
    }
    this.show();
  }

  /** @param {IntersectionObserverEntry[]} entries */
  load(entries) {
    for (const { target, isIntersecting } of entries) {
      if (!isIntersecting || !(target instanceof HTMLElement)) continue;
      this.watcher.unobserve(target);
      const name = target.dataset.view ?? "";
      const image = target.querySelector("img");
      if (!image) continue; // a view without a photograph is drawn
      void this.app.socket
        .address(`/photographs/${encodeURIComponent(name)}?width=${THUMBNAIL}`)
        .then((address) => {
          image.src = address;
        })
        .catch(() => image.removeAttribute("src"));
    }
  }

  /** @param {SceneView} view */
  goTo(view) {
    const { stage } = this.app;
    const compares = this.app.store.photograph !== null;
    stage.photograph.hide();
    stage.go(
      (camera) => {
        const fits = Math.min(camera.width / view.width, camera.height / view.height);
        camera.focal = (view.fx * fits) / Math.max(camera.width, camera.height);
        const { scene } = this.app.store;
        const ahead = scene ? aheadOf(view.matrix, scene.centre) : 0;
        camera.setMatrix(view.matrix, ahead > 0 ? ahead : camera.radius * 0.5);
      },
      () => {
        this.current = view.name;
        this.pose = this.app.camera.matrix().join();
        if (compares && view.photograph) void stage.photograph.show(view);
        this.show();
      },
    );
  }

  /** View at whose place the camera stands. @returns {string|null} */
  here() {
    return this.app.camera.matrix().join() === this.pose ? this.current : null;
  }

  toggleCompare() {
    const { stage, store } = this.app;
    if (store.photograph !== null) {
      stage.photograph.hide();
      return;
    }
    const here = this.here();
    const view = here === null ? this.nearest() : store.view(here);
    if (!view) return;
    if (!view.photograph) {
      this.app.toast("This view has no photograph at hand.", "Choose another one in the strip.");
    } else if (here !== null) void stage.photograph.show(view);
    else {
      this.goTo(view);
      const wait = () => {
        if (this.current === view.name) void stage.photograph.show(view);
      };
      setTimeout(wait, 320);
    }
  }

  /** The photograph taken from nearest to here. @returns {SceneView|null} */
  nearest() {
    const { position, forward } = this.app.camera;
    let best = null;
    let least = Infinity;
    for (const view of this.app.store.scene?.views ?? []) {
      const m = view.matrix;
      const away = Math.hypot(m[3] - position[0], m[7] - position[1], m[11] - position[2]);
      const turned = 1 - (m[2] * forward[0] + m[6] * forward[1] + m[10] * forward[2]);
      const cost = away / this.app.camera.radius + turned;
      if (view.photograph && cost < least) {
        least = cost;
        best = view;
      }
    }
    return best;
  }

  /** @param {number} step */
  step(step) {
    const views = this.app.store.scene?.views ?? [];
    if (views.length === 0) return;
    const index = views.findIndex((view) => view.name === this.current);
    const next = views[(index + step + views.length) % views.length];
    this.goTo(next);
    this.strip.querySelector(`[data-view="${CSS.escape(next.name)}"]`)?.scrollIntoView({
      block: "nearest",
      inline: "nearest",
    });
  }

  /** Pose of the current view. */
  pose = "";

  show() {
    const compares = this.app.store.photograph !== null;
    this.compare.setAttribute("aria-pressed", String(compares));
    for (const button of this.strip.querySelectorAll("button")) {
      const here = button.dataset.view === this.current;
      if (here) button.setAttribute("aria-current", "true");
      else button.removeAttribute("aria-current");
    }
  }
}

/** Depth of a point in front of a camera. @param {number[]} m world_from_camera
 * @param {[number, number, number]} point @returns {number} */
function aheadOf(m, point) {
  return m[2] * (point[0] - m[3]) + m[6] * (point[1] - m[7]) + m[10] * (point[2] - m[11]);
}
