/** A list that holds only the rows that are seen, so that 2 000 entries stay quick. */

import { clamp, el } from "../dom.js";

const BEYOND = 6;

/**
 * Rows of one height in a scrolling box, one of them active (keyboard).
 * @template T
 */
export class VirtualList {
  /**
   * @param {{label: string, height: number, id: (item: T) => number,
   *   row: (item: T) => HTMLElement, active?: (item: T|null) => void,
   *   key?: (event: KeyboardEvent, item: T) => boolean}} options
   *   `row`: a row's element; `key`: what a key does to the active row.
   */
  constructor(options) {
    this.options = options;
    /** @type {T[]} */
    this.items = [];
    /** @type {number|null} */
    this.activeId = null;
    this.body = el("div", { class: "rows", role: "rowgroup" });
    this.box = el(
      "div",
      { class: "list", role: "grid", tabindex: 0, "aria-label": options.label },
      this.body,
    );
    /** @type {Map<number, HTMLElement>} */
    this.shown = new Map();
    this.frame = 0;
    this.box.addEventListener("scroll", () => this.schedule());
    this.box.addEventListener("keydown", (event) => this.keydown(event));
    this.box.addEventListener("focus", () => this.activate(this.activeId, true));
    new ResizeObserver(() => this.schedule()).observe(this.box);
  }

  /** @param {T[]} items */
  set(items) {
    this.items = items;
    this.shown.clear();
    this.body.replaceChildren();
    this.box.setAttribute("aria-rowcount", String(items.length));
    this.body.style.height = `${items.length * this.options.height}px`;
    if (!items.some((item) => this.options.id(item) === this.activeId)) this.activeId = null;
    this.draw();
  }

  schedule() {
    if (this.frame) return;
    this.frame = requestAnimationFrame(() => this.draw());
  }

  draw() {
    cancelAnimationFrame(this.frame);
    this.frame = 0;
    const { height, id, row } = this.options;
    const first = Math.max(0, Math.floor(this.box.scrollTop / height) - BEYOND);
    const seen = Math.ceil(this.box.clientHeight / height) + 2 * BEYOND;
    const last = Math.min(this.items.length, first + seen);
    const wanted = new Set();
    for (let index = first; index < last; index++) {
      const item = this.items[index];
      const key = id(item);
      wanted.add(key);
      if (this.shown.has(key)) continue;
      const element = row(item);
      element.classList.add("row");
      element.setAttribute("role", "row");
      element.setAttribute("aria-rowindex", String(index + 1));
      element.id = `${this.box.getAttribute("aria-label")?.toLowerCase()}-row-${key}`;
      element.style.translate = `0 ${index * height}px`;
      if (key === this.activeId) element.dataset.active = "";
      this.shown.set(key, element);
      this.body.append(element);
    }
    for (const [key, element] of this.shown) {
      if (wanted.has(key)) continue;
      element.remove();
      this.shown.delete(key);
    }
  }

  /** @param {number|null} id @param {boolean} [reveal] */
  activate(id, reveal = false) {
    let index = this.items.findIndex((item) => this.options.id(item) === id);
    if (index < 0) index = this.items.length > 0 ? 0 : -1;
    const item = this.items[index] ?? null;
    this.activeId = item === null ? null : this.options.id(item);
    if (reveal && index >= 0) this.reveal(index);
    this.draw();
    for (const [key, element] of this.shown) {
      element.toggleAttribute("data-active", key === this.activeId);
    }
    const element = this.activeId === null ? undefined : this.shown.get(this.activeId);
    if (element) this.box.setAttribute("aria-activedescendant", element.id);
    else this.box.removeAttribute("aria-activedescendant");
    this.options.active?.(item);
  }

  /** @param {number} index */
  reveal(index) {
    const { height } = this.options;
    const top = index * height;
    const { scrollTop, clientHeight } = this.box;
    if (top < scrollTop) this.box.scrollTop = top;
    else if (top + height > scrollTop + clientHeight) {
      this.box.scrollTop = top + height - clientHeight;
    }
  }

  /** @param {KeyboardEvent} event */
  keydown(event) {
    if (event.target !== this.box) return;
    const page = Math.max(1, Math.floor(this.box.clientHeight / this.options.height) - 1);
    const steps = {
      ArrowDown: 1,
      ArrowUp: -1,
      PageDown: page,
      PageUp: -page,
      Home: -1e9,
      End: 1e9,
    };
    const step = steps[/** @type {keyof typeof steps} */ (event.key)];
    const index = this.items.findIndex((item) => this.options.id(item) === this.activeId);
    if (step && this.items.length > 0) {
      const next = clamp(index + step, 0, this.items.length - 1);
      this.activate(this.options.id(this.items[next]), true);
    } else if (!(index >= 0 && this.options.key?.(event, this.items[index]))) {
      return;
    }
    event.preventDefault();
    event.stopPropagation();
  }
}
