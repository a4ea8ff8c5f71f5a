/** Short messages: what went wrong and what to do, or what was done. */

import { byId, el, icon, iconButton } from "../dom.js";

const STAYS = 9000;
const MOST = 4;

export class Toasts {
  constructor() {
    this.box = byId("toasts", HTMLElement);
  }

  /**
   * @param {string} text
   * @param {string} [fix] What to do.
   * @param {{good?: boolean, links?: {text: string, href: string, download?: string}[]}} [more]
   */
  show(text, fix = "", { good = false, links = [] } = {}) {
    for (const old of this.box.children) {
      if (old instanceof HTMLElement && old.dataset.text === text) old.remove();
    }
    const toast = el(
      "div",
      {
        class: `toast ${good ? "good" : "bad"}`,
        role: good ? "status" : "alert",
        "data-text": text,
      },
      icon(good ? "check" : "help"),
      el(
        "div",
        { class: "toast-body" },
        el("p", { text }),
        fix ? el("p", { class: "quiet", text: fix }) : null,
        ...links.map(({ text: name, href, download }) =>
          el("a", { href, download: download ?? "", class: "link" }, icon("download"), name),
        ),
      ),
      iconButton("close", "Dismiss", () => toast.remove(), { class: "plain" }),
    );
    this.box.append(toast);
    while (this.box.children.length > MOST) this.box.firstElementChild?.remove();
    let timer = setTimeout(
      () => toast.remove(),
      links.length > 0 ? 4 * STAYS : good ? STAYS / 2 : STAYS,
    );
    toast.addEventListener("pointerenter", () => clearTimeout(timer));
    toast.addEventListener("focusin", () => clearTimeout(timer));
    toast.addEventListener("pointerleave", () => {
      timer = setTimeout(() => toast.remove(), STAYS);
    });
  }
}
