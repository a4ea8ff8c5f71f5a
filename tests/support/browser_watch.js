// What a test reached: a name for each control, and a note of each that is used.
(() => {
  const REGIONS = [
    "history", "find-form", "modes", "actions", "tools", "tool-options", "notice", "bar",
    "sheet-tabs", "objects", "suggestions", "views", "jobs", "toasts", "export", "help",
  ];
  const CONTROLS =
    "button, input, select, a[href], [role=slider], #overlay, [role=grid], .row, .help-body";

  /** A control that is this or around it, or that the label is of. */
  function control(target) {
    if (!(target instanceof Element)) return null;
    const label = target.closest("label");
    const found = target.closest(CONTROLS);
    if (label?.control && !label.contains(found)) return label.control;
    return found;
  }

  function handle(e) {
    if (e.matches(".row")) return `#${e.closest("section").id} .row`;
    if (e.closest(".swatch")) return "#objects .row colour";
    if (e.matches(".eye")) return "#objects .row eye";
    if (e.matches(".lock")) return "#objects .row lock";
    if (e.matches(".rename")) return "#objects .rename";
    if (e.matches(".thumb")) return "#views .thumb";
    if (e.id) return `#${e.id}`;
    const name = (e.getAttribute("aria-label") ?? e.querySelector("span")?.textContent ??
      e.textContent).split(":")[0].trim();
    const menu = e.closest("[role=menu]");
    if (menu) return `menu ${menu.getAttribute("aria-label")} > ${name}`;
    if (e.closest(".row")) return `#suggestions .row ${name.split(" ")[0]}`;
    if (e.matches("input[type=color]")) return `#${e.closest("#bar, #objects").id} colour`;
    if (e.matches("a.link")) return "#toasts link";
    const region = REGIONS.find((id) => e.closest(`#${id}`));
    if (e.closest(".popup")) return `popup ${name}`;
    return `${region ? `#${region}` : e.tagName.toLowerCase()} ${name}`;
  }

  const note = (event) => {
    const found = control(event.target);
    if (!found) return;
    if (event.type === "pointerdown" && !found.matches("#overlay, #divider")) return;
    if (event.type === "keydown" && !found.matches("[role=slider], [role=grid], #overlay, .help-body"))
      return;
    void window.touched(handle(found));
  };
  for (const type of ["click", "change", "input", "pointerdown", "keydown"])
    window.addEventListener(type, note, true);
  window.addEventListener("securitypolicyviolation", (event) => {
    void window.violated(`${event.violatedDirective} ${event.blockedURI}`);
  });

  window.visibleHandles = () => {
    const shown = (e) => {
      const seen = e.matches(".unseen") ? (e.labels?.[0] ?? null) : e;
      return (
        seen !== null &&
        seen.checkVisibility({ checkVisibilityCSS: true }) &&
        seen.getBoundingClientRect().width > 0
      );
    };
    const found = [...document.querySelectorAll(CONTROLS)].filter(shown).map(handle);
    return [...new Set(found)];
  };
})();
