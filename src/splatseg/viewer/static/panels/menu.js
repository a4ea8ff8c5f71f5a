/** A menu that opens from a button: arrow keys, Escape, click outside. */

import { el, icon } from "../dom.js";

/**
 * @typedef {{label: string, icon?: string, action?: () => void, disabled?: boolean,
 *   checked?: boolean, key?: string, toggle?: boolean}|"line"|{title: string}} Item
 */

/**
 * Open a menu below a button.
 * @param {HTMLElement} button
 * @param {Item[]} items
 */
export function openMenu(button, items) {
  const menu = el("div", {
    class: "menu",
    role: "menu",
    popover: "auto",
    "aria-label": button.title,
  });
  /** @type {HTMLButtonElement[]} */
  const entries = [];
  for (const item of items) {
    if (item === "line") {
      menu.append(el("div", { class: "menu-line", role: "separator" }));
      continue;
    }
    if ("title" in item) {
      menu.append(el("div", { class: "menu-title", role: "presentation", text: item.title }));
      continue;
    }
    const checks = item.checked !== undefined;
    const entry = el(
      "button",
      {
        type: "button",
        class: "menu-item",
        role: checks ? (item.toggle ? "menuitemcheckbox" : "menuitemradio") : "menuitem",
        "aria-checked": checks ? String(item.checked) : null,
        tabindex: -1,
        disabled: item.disabled,
        onclick: () => {
          menu.hidePopover();
          item.action?.();
        },
      },
      icon(checks ? "check" : (item.icon ?? "more")),
      el("span", { text: item.label }),
      item.key ? el("kbd", { text: item.key }) : null,
    );
    if (checks && !item.checked) entry.dataset.unchecked = "";
    if (!checks && !item.icon) entry.dataset.unchecked = "";
    entries.push(entry);
    menu.append(entry);
  }
  menu.addEventListener("keydown", (event) => {
    const open = entries.filter((entry) => !entry.disabled);
    const index = open.indexOf(/** @type {HTMLButtonElement} */ (document.activeElement));
    const steps = { ArrowDown: 1, ArrowUp: -1 };
    const step = steps[/** @type {keyof typeof steps} */ (event.key)];
    if (step) open[(index + step + open.length) % open.length]?.focus();
    else if (event.key === "Home") open[0]?.focus();
    else if (event.key === "End") open.at(-1)?.focus();
    else if (event.key === "Tab") menu.hidePopover();
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
  menu.addEventListener("toggle", (event) => {
    if (/** @type {ToggleEvent} */ (event).newState !== "closed") return;
    button.setAttribute("aria-expanded", "false");
    const inside =
      menu.contains(document.activeElement) || document.activeElement === document.body;
    menu.remove();
    if (inside) button.focus();
  });
  (button.closest("header, nav, main, aside") ?? document.body).append(menu);
  button.setAttribute("aria-haspopup", "menu");
  button.setAttribute("aria-expanded", "true");
  menu.showPopover();
  const at = button.getBoundingClientRect();
  const { offsetWidth: width, offsetHeight: height } = menu;
  const left = Math.max(8, Math.min(at.left, innerWidth - width - 8));
  const below = at.bottom + 4;
  const top = below + height > innerHeight - 8 ? Math.max(8, at.top - height - 4) : below;
  menu.style.left = `${left}px`;
  menu.style.top = `${top}px`;
  entries.find((entry) => !entry.disabled)?.focus();
}
