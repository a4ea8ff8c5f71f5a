/** Elements, icons and numbers as text. Text reaches the page through `textContent` only. */

/**
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {Record<string, string|number|boolean|null|undefined|((event: any) => void)>} [properties]
 *   Attributes; `class`, `text` (text content), `on...` (listeners); null and false are left out.
 * @param {...(Node|string|null|undefined|false)} children
 * @returns {HTMLElementTagNameMap[K]}
 */
export function el(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [key, value] of Object.entries(properties)) {
    if (value === null || value === undefined || value === false) continue;
    if (typeof value === "function") element.addEventListener(key.slice(2), value);
    else if (key === "text") element.textContent = String(value);
    else element.setAttribute(key === "class" ? "class" : key, value === true ? "" : String(value));
  }
  for (const child of children) if (child) element.append(child);
  return element;
}

const SVG = "http://www.w3.org/2000/svg";

/** An icon of index.html's sheet. @param {string} name @returns {SVGSVGElement} */
export function icon(name) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("class", "icon");
  svg.setAttribute("aria-hidden", "true");
  const use = document.createElementNS(SVG, "use");
  use.setAttribute("href", `#i-${name}`);
  svg.append(use);
  return svg;
}

/** Another icon in an element that has one. @param {Element} element @param {string} name */
export function setIcon(element, name) {
  element.querySelector("use")?.setAttribute("href", `#i-${name}`);
}

/**
 * A button with an icon, named for everyone.
 * @param {string} name Of the icon.
 * @param {string} label
 * @param {() => void} action
 * @param {{key?: string, text?: boolean, class?: string, tabindex?: number}} [more] `text`: the
 *   label is seen, not only read.
 * @returns {HTMLButtonElement}
 */
export function iconButton(name, label, action, more = {}) {
  const hint = more.key ? `${label} (${more.key})` : label;
  const button = el(
    "button",
    {
      type: "button",
      class: `button ${more.text ? "" : "square"} ${more.class ?? ""}`.trim(),
      title: hint,
      "aria-label": more.text ? null : label,
      tabindex: more.tabindex,
      onclick: action,
    },
    icon(name),
  );
  if (more.text) button.append(el("span", { text: label }));
  return button;
}

/**
 * The element with an id, of the class that is expected.
 * @template {Element} T
 * @param {string} id
 * @param {new () => T} kind
 * @returns {T}
 */
export function byId(id, kind) {
  const element = document.getElementById(id);
  if (!(element instanceof kind)) throw new Error(`index.html has no ${kind.name} #${id}.`);
  return element;
}

const NUMBER = new Intl.NumberFormat("en");

/** 287 012. @param {number} value @returns {string} */
export function number(value) {
  return NUMBER.format(value).replaceAll(",", "\u2009");
}

/** @param {number} count @param {string} one @param {string} [many] @returns {string} */
export function counted(count, one, many = `${one}s`) {
  return `${number(count)} ${count === 1 ? one : many}`;
}

/** @param {number} share In [0, 1]. @returns {string} */
export function percent(share) {
  return `${Math.round(100 * share)} %`;
}

/** @param {readonly number[]} colour Bytes. @returns {string} */
export function hex(colour) {
  return `#${colour.map((byte) => Math.round(byte).toString(16).padStart(2, "0")).join("")}`;
}

/** @param {string} text #rrggbb @returns {[number, number, number]} */
export function bytes(text) {
  const value = Number.parseInt(text.slice(1), 16);
  return [(value >> 16) & 255, (value >> 8) & 255, value & 255];
}

/** Whether the person asked for little motion. @returns {boolean} */
export function calm() {
  return matchMedia("(prefers-reduced-motion: reduce)").matches;
}

/** @param {number} value @param {number} low @param {number} high @returns {number} */
export function clamp(value, low, high) {
  return Math.min(high, Math.max(low, value));
}
