/**
 * The keyboard: one table that is read, and shown by `?`.
 *
 * Keys of one letter do nothing while a text field has the focus, and can be switched off
 * (WCAG 2.1.4).
 *
 * @typedef {import("./main.js").App} App
 * @typedef {{key: string, ctrl?: boolean, shift?: boolean, shown: string, label: string,
 *   group: string, run: (app: App, event: KeyboardEvent) => void|boolean}} Key
 *   `key`: of `KeyboardEvent.key`, lower case; `run` returns false if it did nothing.
 */

const SELECT = "Select";
const ORGANISE = "Objects";
const EDIT = "Edit";
const LOOK = "Look";

/** @type {readonly Key[]} */
export const KEYS = [
  { key: "c", shown: "C", label: "Click", group: SELECT, run: (app) => app.setTool("click") },
  { key: "r", shown: "R", label: "Box", group: SELECT, run: (app) => app.setTool("box") },
  { key: "b", shown: "B", label: "Stroke", group: SELECT, run: (app) => app.setTool("stroke") },
  { key: "l", shown: "L", label: "Lasso", group: SELECT, run: (app) => app.setTool("lasso") },
  { key: "p", shown: "P", label: "Polygon", group: SELECT, run: (app) => app.setTool("polygon") },
  { key: "o", shown: "O", label: "Sphere", group: SELECT, run: (app) => app.setTool("sphere") },
  { key: "[", shown: "[ ]", label: "Smaller, larger brush", group: SELECT, run: (app) => app.size(1 / 1.2) },
  { key: "]", shown: "", label: "", group: SELECT, run: (app) => app.size(1.2) },
  { key: ",", shown: ", .", label: "Level: towards part, group", group: SELECT, run: (app) => app.setLevel(app.store.level - 0.1) },
  { key: ".", shown: "", label: "", group: SELECT, run: (app) => app.setLevel(app.store.level + 0.1) },
  { key: " ", shown: "Space", label: "Select what is in the middle", group: SELECT, run: (app, event) => app.aim(event) },
  { key: " ", shift: true, shown: "", label: "", group: SELECT, run: (app, event) => app.aim(event) },
  { key: " ", ctrl: true, shown: "", label: "", group: SELECT, run: (app, event) => app.aim(event) },
  { key: "/", shown: "/", label: "Find by words", group: SELECT, run: (app) => app.words.field.focus() },
  { key: "a", ctrl: true, shown: "Ctrl+A", label: "Select all", group: SELECT, run: (app) => app.selectKind("all") },
  { key: "a", ctrl: true, shift: true, shown: "Ctrl+Shift+A", label: "Select none", group: SELECT, run: (app) => app.selectKind("none") },
  { key: "i", ctrl: true, shown: "Ctrl+I", label: "Invert the selection", group: SELECT, run: (app) => app.selectKind("invert") },
  { key: "escape", shown: "Esc", label: "Cancel, then back to Click", group: SELECT, run: (app) => app.escape() },
  { key: "enter", shown: "Enter", label: "Keep the selection as an object", group: ORGANISE, run: (app) => app.enter() },
  { key: "enter", shift: true, shown: "Shift+Enter", label: "Name it first", group: ORGANISE, run: (app) => app.bar.name.focus() },
  { key: "f2", shown: "F2", label: "Rename", group: ORGANISE, run: (app) => app.renamePicked() },
  { key: "n", shown: "N", label: "Next suggestion", group: ORGANISE, run: (app) => app.suggestions.walk(1) },
  { key: "n", shift: true, shown: "Shift+N", label: "Suggestion before", group: ORGANISE, run: (app) => app.suggestions.walk(-1) },
  { key: "y", shown: "Y", label: "Accept it", group: ORGANISE, run: (app) => app.suggestions.decide("accept") },
  { key: "x", shown: "X", label: "Reject it", group: ORGANISE, run: (app) => app.suggestions.decide("reject") },
  { key: "h", shown: "H", label: "Hide the picked objects", group: ORGANISE, run: (app) => app.hide() },
  { key: "h", shift: true, shown: "Shift+H", label: "Show all", group: ORGANISE, run: (app) => app.showAll() },
  { key: "z", ctrl: true, shown: "Ctrl+Z", label: "Undo", group: EDIT, run: (app) => app.undo() },
  { key: "z", ctrl: true, shift: true, shown: "Ctrl+Shift+Z", label: "Redo", group: EDIT, run: (app) => app.redo() },
  { key: "y", ctrl: true, shown: "", label: "", group: EDIT, run: (app) => app.redo() },
  { key: "delete", shown: "Del", label: "Remove the selection from the scene", group: EDIT, run: (app) => app.edit("remove") },
  { key: "1", shown: "1 2 3", label: "Move, rotate, scale", group: EDIT, run: (app) => app.setMove("translate") },
  { key: "2", shown: "", label: "", group: EDIT, run: (app) => app.setMove("rotate") },
  { key: "3", shown: "", label: "", group: EDIT, run: (app) => app.setMove("scale") },
  { key: "e", ctrl: true, shown: "Ctrl+E", label: "Export", group: EDIT, run: (app) => app.exportDialog.open() },
  { key: "f", shown: "F", label: "Frame the selection", group: LOOK, run: (app) => app.frame(true) },
  { key: "f", shift: true, shown: "Shift+F", label: "Frame everything", group: LOOK, run: (app) => app.frame(false) },
  { key: "v", shown: "V", label: "Orbit or fly", group: LOOK, run: (app) => app.toggleFly() },
  { key: "tab", shown: "Tab", label: "Overlay of objects on and off", group: LOOK, run: (app) => app.toggleOverlay() },
  { key: "?", shown: "?", label: "This page", group: LOOK, run: (app) => app.helpDialog.open() },
  { key: "?", shift: true, shown: "", label: "", group: LOOK, run: (app) => app.helpDialog.open() },
  { key: "flying", shown: "W A S D Q E", label: "Fly; Shift fast, Alt slow", group: LOOK, run: () => false },
  { key: "arrows", shown: "← ↑ → ↓", label: "Orbit; Shift pans; with Move: steps", group: LOOK, run: () => false },
  { key: "+", shown: "+ −", label: "Zoom", group: LOOK, run: (app) => app.stage.zoom(1 / 1.15, app.stage.middle()) },
  { key: "+", shift: true, shown: "", label: "", group: LOOK, run: (app) => app.stage.zoom(1 / 1.15, app.stage.middle()) },
  { key: "=", shown: "", label: "", group: LOOK, run: (app) => app.stage.zoom(1 / 1.15, app.stage.middle()) },
  { key: "-", shown: "", label: "", group: LOOK, run: (app) => app.stage.zoom(1.15, app.stage.middle()) },
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
    const typing = element.matches("input:not([type=radio], [type=checkbox], [type=range]), textarea");
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
      if (key.key !== pressed || Boolean(key.ctrl) !== ctrl) continue;
      if (Boolean(key.shift) !== event.shiftKey) continue;
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
