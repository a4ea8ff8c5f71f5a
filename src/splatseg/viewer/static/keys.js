/**
 * The keyboard: one table that is read, and shown by `?`.
 *
 * Keys of one letter do nothing while a text field has the focus, and can be switched off
 * (WCAG 2.1.4).
 *
 * @typedef {import("./main.js").App} App
 * @typedef {{key: string, ctrl: boolean, shift: boolean, shown: string, label: string,
 *   group: string, run: (app: App, event: KeyboardEvent) => void|boolean}} Key
 *   `key`: of `KeyboardEvent.key`, lower case; `run` returns false if it did nothing.
 */

const SELECT = "Select";
const ORGANISE = "Objects";
const EDIT = "Edit";
const LOOK = "Look";

/**
 * @param {string} keys `ctrl+shift+z`; `plus` is the key +.
 * @param {string} shown Keys as `?` shows them, apart by spaces; "" does not show them.
 * @param {string} label
 * @param {string} group
 * @param {Key["run"]} run
 * @returns {Key}
 */
function row(keys, shown, label, group, run) {
  const parts = keys.split("+");
  const last = parts.at(-1) ?? "";
  const key = last === "plus" ? "+" : last;
  return {
    key,
    ctrl: parts.includes("ctrl"),
    shift: parts.includes("shift"),
    shown,
    label,
    group,
    run,
  };
}

/** @type {readonly Key[]} */
export const KEYS = [
  row("c", "C", "Click", SELECT, (app) => app.setTool("click")),
  row("r", "R", "Box", SELECT, (app) => app.setTool("box")),
  row("b", "B", "Stroke", SELECT, (app) => app.setTool("stroke")),
  row("l", "L", "Lasso", SELECT, (app) => app.setTool("lasso")),
  row("p", "P", "Polygon", SELECT, (app) => app.setTool("polygon")),
  row("o", "O", "Sphere", SELECT, (app) => app.setTool("sphere")),
  row("[", "[ ]", "Smaller, larger brush", SELECT, (app) => app.size(1 / 1.2)),
  row("]", "", "", SELECT, (app) => app.size(1.2)),
  row(",", ", .", "Level: towards part, group", SELECT, (app) =>
    app.setLevel(app.store.level - 0.1),
  ),
  row(".", "", "", SELECT, (app) => app.setLevel(app.store.level + 0.1)),
  row(" ", "Space", "Select what is in the middle", SELECT, (app, event) => app.aim(event)),
  row("shift+ ", "", "", SELECT, (app, event) => app.aim(event)),
  row("ctrl+ ", "", "", SELECT, (app, event) => app.aim(event)),
  row("/", "/", "Find by words", SELECT, (app) => app.words.field.focus()),
  row("ctrl+a", "Ctrl+A", "Select all", SELECT, (app) => app.selectKind("all")),
  row("ctrl+shift+a", "Ctrl+Shift+A", "Select none", SELECT, (app) => app.selectKind("none")),
  row("ctrl+i", "Ctrl+I", "Invert the selection", SELECT, (app) => app.selectKind("invert")),
  row("escape", "Esc", "Cancel, then back to Click", SELECT, (app) => app.escape()),
  row("enter", "Enter", "Keep the selection as an object", ORGANISE, (app) => app.enter()),
  row("shift+enter", "Shift+Enter", "Name it first", ORGANISE, (app) => app.bar.name.focus()),
  row("f2", "F2", "Rename", ORGANISE, (app) => app.renamePicked()),
  row("n", "N", "Next suggestion", ORGANISE, (app) => app.suggestions.walk(1)),
  row("shift+n", "Shift+N", "Suggestion before", ORGANISE, (app) => app.suggestions.walk(-1)),
  row("y", "Y", "Accept it", ORGANISE, (app) => app.suggestions.decide("accept")),
  row("x", "X", "Reject it", ORGANISE, (app) => app.suggestions.decide("reject")),
  row("h", "H", "Hide the picked objects", ORGANISE, (app) => app.hide()),
  row("shift+h", "Shift+H", "Show all", ORGANISE, (app) => app.showAll()),
  row("ctrl+z", "Ctrl+Z", "Undo", EDIT, (app) => app.undo()),
  row("ctrl+shift+z", "Ctrl+Shift+Z", "Redo", EDIT, (app) => app.redo()),
  row("ctrl+y", "", "", EDIT, (app) => app.redo()),
  row("delete", "Del", "Remove the selection from the scene", EDIT, (app) => app.edit("remove")),
  row("1", "1 2 3", "Move, rotate, scale", EDIT, (app) => app.setMove("translate")),
  row("2", "", "", EDIT, (app) => app.setMove("rotate")),
  row("3", "", "", EDIT, (app) => app.setMove("scale")),
  row("ctrl+e", "Ctrl+E", "Export", EDIT, (app) => app.exportDialog.open()),
  row("f", "F", "Frame the selection", LOOK, (app) => app.look.frame(true)),
  row("shift+f", "Shift+F", "Frame everything", LOOK, (app) => app.look.frame(false)),
  row("v", "V", "Orbit or fly", LOOK, (app) => app.look.toggleFly()),
  row("tab", "Tab", "Overlay of objects on and off", LOOK, (app) => app.toggleOverlay()),
  row("?", "?", "This page", LOOK, (app) => app.helpDialog.open()),
  row("shift+?", "", "", LOOK, (app) => app.helpDialog.open()),
  row("flying", "W A S D Q E", "Fly; Shift fast, Alt slow", LOOK, () => false),
  row("arrows", "← ↑ → ↓", "Orbit; Shift pans; with Move: steps", LOOK, () => false),
  row("plus", "+ −", "Zoom", LOOK, (app) => app.stage.zoom(1 / 1.15, app.stage.middle())),
  row("shift+plus", "", "", LOOK, (app) => app.stage.zoom(1 / 1.15, app.stage.middle())),
  row("=", "", "", LOOK, (app) => app.stage.zoom(1 / 1.15, app.stage.middle())),
  row("-", "", "", LOOK, (app) => app.stage.zoom(1.15, app.stage.middle())),
];

/** `_` stands for a space within one key. */
export const MOUSE = [
  { shown: "Click", label: "Select; Shift adds, Ctrl removes, both intersect" },
  { shown: "Alt+click", label: "Not this: a point against" },
  { shown: "Alt+Shift+click", label: "This, too: a further point for it" },
  { shown: "Left_drag", label: "Orbit, or what the tool does" },
  { shown: "Right_drag", label: "Pan" },
  { shown: "Middle_drag", label: "Orbit; Shift pans, Ctrl zooms" },
  { shown: "Wheel", label: "Zoom to the pointer" },
  { shown: "Double_click", label: "Turn about this point" },
  { shown: "One_finger", label: "Orbit; two pan and zoom; tap selects" },
];

export const LIST = [
  { shown: "↑ ↓", label: "Another row" },
  { shown: "Enter", label: "Pick it; Ctrl one more, Shift all between" },
  { shown: "F2", label: "Rename" },
  { shown: "H K", label: "Hide, lock" },
  { shown: "Del", label: "Delete the entry; the scene keeps its Gaussians" },
];

const FLYING = new Set(["KeyW", "KeyA", "KeyS", "KeyD", "KeyQ", "KeyE"]);
const ORBIT_STEP = 24;

export class Keys {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    /** Whether keys of one letter do something. */
    this.letters = localStorage.getItem("splatseg-letters") !== "off";
    window.addEventListener("keydown", (event) => this.down(event));
    window.addEventListener("keyup", (event) => app.stage.fly(event.code, false, 1));
    window.addEventListener("blur", () => app.stage.flying.clear());
  }

  /** @param {boolean} on */
  setLetters(on) {
    this.letters = on;
    localStorage.setItem("splatseg-letters", on ? "on" : "off");
  }

  /** @param {KeyboardEvent} event */
  down(event) {
    if (event.defaultPrevented || event.isComposing) return;
    const { target } = event;
    const element = target instanceof Element ? target : document.body;
    const typing = element.matches(
      "input:not([type=radio], [type=checkbox], [type=range]), textarea",
    );
    const modal = document.querySelector("dialog[open]") !== null;
    if (typing || modal || element.closest("[role=menu], .popup")) return;
    const { app } = this;
    const onStage = element === app.stage.overlay || element === document.body;
    const ctrl = event.ctrlKey || event.metaKey;
    const single = !ctrl && event.key.length === 1;
    if (single && !this.letters && event.key !== " ") return;
    if (!ctrl && FLYING.has(event.code)) {
      app.stage.fly(event.code, true, event.shiftKey ? 4 : event.altKey ? 0.25 : 1);
      event.preventDefault();
      return;
    }
    if (onStage && !ctrl && this.arrow(event)) {
      event.preventDefault();
      return;
    }
    // On a button, Space and Enter press it and Tab goes on: as everywhere.
    if (!onStage && [" ", "Enter", "Tab"].includes(event.key)) return;
    if (element.matches("select, input") && event.key.length === 1 && !ctrl) return;
    const pressed = event.key.toLowerCase();
    // Whoever came here by the keyboard leaves by it: Tab is a key of the view for the mouse only.
    const mouse = app.stage.byPointer || (element === document.body && app.stage.pointer !== null);
    if (pressed === "tab" && (event.shiftKey || !mouse)) return;
    if (pressed === "backspace" && app.store.tool === "polygon") {
      app.tools.polygon.back();
      event.preventDefault();
      return;
    }
    for (const key of KEYS) {
      if (key.key !== pressed || key.ctrl !== ctrl || key.shift !== event.shiftKey) continue;
      if (event.altKey) continue;
      if (key.run(app, event) !== false) event.preventDefault();
      return;
    }
  }

  /** @param {KeyboardEvent} event @returns {boolean} */
  arrow(event) {
    /** @type {Record<string, [number, number]>} */
    const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const way = ways[event.key];
    if (!way) return false;
    const { stage } = this.app;
    if (!event.shiftKey && stage.tool.arrow?.(way[0], way[1])) return true;
    if (event.shiftKey) stage.pan(-ORBIT_STEP * way[0], -ORBIT_STEP * way[1]);
    else stage.turn(-ORBIT_STEP * way[0], -ORBIT_STEP * way[1]);
    return true;
  }
}
