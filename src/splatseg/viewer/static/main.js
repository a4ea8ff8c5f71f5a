/** The page: connects the mirror, the socket, the stage, the tools and the panels. */

import { Camera, mul, unit } from "./camera.js";
import { bytes, clamp } from "./dom.js";
import { Keys } from "./keys.js";
import { Look, replaceFragment } from "./look.js";
import { ExportDialog } from "./panels/export.js";
import { HelpDialog } from "./panels/help.js";
import { JobsPanel } from "./panels/jobs.js";
import { Legend } from "./panels/legend.js";
import { ObjectsPanel } from "./panels/objects.js";
import { SelectionBar } from "./panels/selection.js";
import { StatusLine } from "./panels/status.js";
import { SuggestionsPanel } from "./panels/suggestions.js";
import { Toasts } from "./panels/toasts.js";
import { ToolPanel } from "./panels/tools.js";
import { TopBar } from "./panels/top.js";
import { ViewsPanel } from "./panels/views.js";
import { Socket, readFragment } from "./socket.js";
import { GpuStage } from "./stage/gpu.js";
import { ServerStage } from "./stage/server.js";
import { Stage } from "./stage/stage.js";
import { Store } from "./state.js";
import { BoxTool } from "./tools/box.js";
import { ClickTool } from "./tools/click.js";
import { Gestures } from "./tools/gesture.js";
import { LassoTool } from "./tools/lasso.js";
import { MoveTool } from "./tools/move.js";
import { PolygonTool } from "./tools/polygon.js";
import { SphereTool } from "./tools/sphere.js";
import { StrokeTool } from "./tools/stroke.js";
import { Words } from "./tools/words.js";

/**
 * @typedef {import("./state.js").Vec3} Vec3
 * @typedef {import("./state.js").ToolId} ToolId
 * @typedef {import("./socket.js").Message} Message
 */

const HINT_AFTER = 1200;

export class App {
  constructor() {
    /** Of outlines and handles over the picture. */
    this.accent = "#ff7a33";
    this.store = new Store();
    this.camera = new Camera();
    this.socket = new Socket({
      message: (message) => this.receive(message),
      frame: (data) => this.drawing.receive(data),
      status: (status) => this.connection(status),
    });
    this.server = new ServerStage(this);
    /** Whoever draws while the camera moves: the page, or the server. */
    this.drawing = new GpuStage(this, this.server);
    this.gestures = new Gestures(this);
    this.tools = {
      click: new ClickTool(this),
      box: new BoxTool(this),
      stroke: new StrokeTool(this),
      lasso: new LassoTool(this),
      polygon: new PolygonTool(this),
      sphere: new SphereTool(this),
      move: new MoveTool(this),
    };
    this.toasts = new Toasts();
    this.stage = new Stage(this);
    this.look = new Look(this);
    this.keys = new Keys(this);
    this.words = new Words(this);
    this.jobs = new JobsPanel(this);
    this.exportDialog = new ExportDialog(this);
    this.helpDialog = new HelpDialog(this);
    this.objects = new ObjectsPanel(this);
    this.suggestions = new SuggestionsPanel(this);
    this.views = new ViewsPanel(this);
    this.bar = new SelectionBar(this);
    this.toolPanel = new ToolPanel(this);
    this.top = new TopBar(this);
    this.status = new StatusLine(this);
    this.legend = new Legend(this);
    /** @type {Map<number, (point: Vec3|null) => void>} */
    this.depths = new Map();
    this.depthCount = 0;
    /** Commands of ours that are not answered yet. */
    this.waiting = 0;
    this.keeping = false;
    /** Whether the selection that a double click began is taken back when it comes. */
    this.reverting = false;
    this.hintTimer = 0;
    /** Camera of the link that opened the page. @type {string|null} */
    this.link = null;
    this.started = false;
  }

  start() {
    const { token, view } = readFragment(location.hash);
    this.link = view;
    if (token) replaceFragment(view === null ? "" : `#view=${view}`);
    this.store.changed("tool");
    void this.socket.start(token);
    window.addEventListener("hashchange", () => {
      const next = readFragment(location.hash);
      if (next.token) {
        replaceFragment("");
        void this.socket.start(next.token);
      }
      if (next.view) this.stage.go((camera) => void camera.fromLink(next.view ?? ""));
    });
  }

  /** @param {Message} message @returns {boolean} */
  send(message) {
    return this.socket.send(message);
  }

  /** @param {string} text @param {string} [fix] */
  toast(text, fix = "") {
    this.toasts.show(text, fix);
  }

  /** @param {"connecting"|"open"|"lost"|"refused"|"full"} status */
  connection(status) {
    const { store } = this;
    const was = store.connection;
    if (was === "open" && status !== "open") {
      this.gestures.forget();
      this.jobs.forget();
      this.depths.clear();
      this.waiting = 0;
      this.reverting = false;
    }
    store.connection = status;
    store.changed("connection");
  }

  /** @param {Message} message */
  receive(message) {
    const { store } = this;
    switch (message.type) {
      case "state":
        this.take(/** @type {any} */ (message));
        break;
      case "patch":
        this.patch(/** @type {any} */ (message));
        break;
      case "selected":
        this.selected(/** @type {any} */ (message));
        break;
      case "point": {
        const done = this.depths.get(message.gesture);
        this.depths.delete(message.gesture);
        done?.(message.point);
        break;
      }
      case "clients":
        store.clients = message.n;
        store.changed("status");
        break;
      case "ready":
        store.ready = true;
        store.changed("status");
        break;
      case "hint":
        store.hint = message.view != null ? /** @type {any} */ (message) : null;
        store.changed("hint");
        break;
      case "legend":
        store.legend = /** @type {any} */ (message);
        store.changed("legend");
        break;
      case "progress":
        this.jobs.progress(/** @type {any} */ (message));
        break;
      case "finished":
        this.jobs.finished(/** @type {any} */ (message));
        break;
      case "error":
        this.error(message);
        break;
      default:
    }
  }

  /** @param {import("./state.js").StateMessage} message */
  take(message) {
    this.store.replace(message);
    const scene = /** @type {import("./state.js").SceneInfo} */ (this.store.scene);
    this.camera.radius = scene.radius || 1;
    if (!this.started) {
      this.started = true;
      this.camera.up = unit(scene.up ?? [0, 0, 1]);
      if (!this.link || !this.camera.fromLink(this.link)) this.look.goHome();
      this.stage.resize();
      this.drawing.choose(message.stage);
    }
    if (!scene.modes.includes(this.store.mode)) this.store.mode = scene.modes[0] ?? "colour";
    this.store.changed("mode");
    this.waiting = 0;
    this.drawing.reset();
  }

  /** @param {import("./state.js").PatchMessage} message */
  patch(message) {
    const before = new Set(this.store.byId.keys());
    if (!this.store.patch(message)) {
      this.socket.restart();
      return;
    }
    if (String(message.author) !== this.store.me) return;
    this.waiting = Math.max(0, this.waiting - 1);
    if (!this.keeping) return;
    const fresh = (message.objects ?? []).filter((object) => !before.has(object.id));
    if (fresh.length === 0) return;
    this.keeping = false;
    this.store.pick(fresh.map((object) => object.id));
    this.objects.list.activate(fresh[0].id, true);
  }

  /** @param {any} message */
  selected(message) {
    this.gestures.answered(message);
    this.store.selected = { ...message, stages: message.stages ?? {} };
    this.store.changed("selection", "status");
    if (message.stage !== "final") return;
    if (this.reverting) {
      this.reverting = false;
      this.takeBack();
    }
    clearTimeout(this.hintTimer);
    this.hintTimer = setTimeout(() => {
      if (this.store.document.selection && this.gestures.pending === 0) this.send({ type: "hint" });
    }, HINT_AFTER);
  }

  /** @param {Message} message */
  error({ gesture, id, command, text, fix }) {
    if (id != null && this.jobs.failed({ id, text, fix })) return;
    if (command) this.waiting = Math.max(0, this.waiting - 1);
    if (command === "keep") this.keeping = false;
    if (command === "move") this.tools.move.refused();
    if (gesture != null) {
      const depth = this.depths.get(gesture);
      this.depths.delete(gesture);
      if (!depth) {
        this.reverting = false;
        this.gestures.failed(gesture);
      }
    }
    this.toast(String(text), fix ?? "");
  }

  /**
   * World point of a pixel of the picture, or null where nothing is.
   * @param {[number, number]} pixel
   * @param {(point: Vec3|null) => void} done
   */
  depth([x, y], done) {
    const gesture = 1_000_000_000 + (++this.depthCount % 1_000_000_000);
    this.depths.set(gesture, done);
    if (!this.send({ type: "depth", gesture, camera: this.camera.record(), x, y })) {
      this.depths.delete(gesture);
    }
  }

  /**
   * @param {string} name
   * @param {Record<string, unknown>} args
   * @returns {boolean} Whether it went out.
   */
  command(name, args) {
    const revision = this.waiting === 0 ? this.store.document.revision : null;
    const sent = this.send({ type: "command", name, arguments: args, revision });
    if (sent) this.waiting += 1;
    else
      this.toast(
        "There is no connection to the server.",
        "It comes back by itself; then try again.",
      );
    return sent;
  }

  /** The first click of two selected something, but the pivot was meant. @param {number} gesture */
  revert(gesture) {
    if (gesture !== this.gestures.count) return;
    if (this.gestures.pending === gesture) this.reverting = true;
    else if (gesture === this.gestures.done) this.takeBack();
  }

  takeBack() {
    this.gestures.forget();
    if (this.send({ type: "undo" })) this.waiting += 1;
  }

  undo() {
    if (this.store.undo !== null) this.takeBack();
  }

  redo() {
    if (this.store.redo === null) return;
    this.gestures.forget();
    if (this.send({ type: "redo" })) this.waiting += 1;
  }

  /** @param {ToolId} tool */
  setTool(tool) {
    if (this.store.tool !== tool) this.stage.tool.cancel?.();
    this.store.tool = tool;
    this.store.changed("tool");
  }

  /** @param {import("./tools/move.js").Kind} kind */
  setMove(kind) {
    this.tools.move.kind = kind;
    this.setTool("move");
    const subject = this.tools.move.subject();
    this.stage.setHover(0);
    if (!subject) {
      this.toast("Nothing is selected to move.", "Select a thing or pick an object in the list.");
    } else if (!this.stage.sees(subject.about)) {
      this.toast("The middle of the selection is out of view.", "F frames it, with its handles.");
    }
  }

  /** @param {number} level */
  setLevel(level) {
    const next = clamp(Math.round(20 * level) / 20, 0, 1);
    if (next === this.store.level) return;
    this.store.level = next;
    this.store.changed("level");
    this.gestures.again();
  }

  /** @param {string} mode */
  setMode(mode) {
    const { store } = this;
    if (!store.scene?.modes.includes(mode) || store.mode === mode) return;
    if (store.mode !== "colour") store.previousMode = store.mode;
    store.mode = mode;
    store.changed("mode");
    this.drawing.rest();
  }

  toggleOverlay() {
    const { store } = this;
    if (store.mode !== "colour") this.setMode("colour");
    else {
      const modes = store.scene?.modes ?? [];
      this.setMode(modes.includes(store.previousMode) ? store.previousMode : "objects");
    }
  }

  /** One object alone, or all. @param {number|null} id */
  setOnly(id) {
    this.store.only = id;
    this.store.changed("mode");
    this.drawing.rest();
  }

  /** Brush or radius. @param {number} factor */
  size(factor) {
    const { stroke, sphere } = this.tools;
    if (this.store.tool === "sphere") sphere.setRadius(sphere.radius * factor);
    else stroke.setWidth(stroke.width * factor);
    this.stage.redraw();
  }

  /** The mask that a layer has becomes the selection. @param {string} layer */
  selectLayer(layer) {
    this.gestures.begin({ kind: "layer", text: layer }, { mode: this.store.selectMode });
  }

  /** all, none, invert, grow, shrink, fill, similar. @param {string} kind */
  selectKind(kind) {
    const needs = ["grow", "shrink", "fill", "similar", "none"].includes(kind);
    if (needs && !this.store.document.selection) return;
    this.gestures.begin({ kind });
  }

  /** Their Gaussians become the selection. @param {number[]} ids */
  selectObjects(ids) {
    this.gestures.forget();
    if (ids.length === 0) {
      if (this.store.document.selection) this.selectKind("none");
      return;
    }
    this.command("select_object", { ids, mode: "set" });
  }

  /** @param {string} name "" for the next free one. */
  keep(name) {
    if (!this.store.document.selection) {
      this.toast("Nothing is selected.", "Click a thing first, then Enter keeps it.");
      return;
    }
    const names = new Set(this.store.document.objects.map((object) => object.name));
    let count = this.store.document.objects.length + 1;
    while (names.has(`Object ${count}`)) count += 1;
    this.keeping = this.command("keep", { name: name || `Object ${count}` });
    // The prompt is over: its points go, and the level is of the next one.
    if (this.keeping) this.gestures.forget();
  }

  enter() {
    if (this.stage.tool.enter?.()) return;
    this.bar.keep();
  }

  escape() {
    const cancelled = this.stage.tool.cancel?.() ?? false;
    this.stage.redraw();
    if (cancelled) return;
    if (this.store.photograph !== null) this.stage.photograph.hide();
    else if (this.store.tool !== "click") this.setTool("click");
    else if (document.body.dataset.sheet) this.top.sheet(null);
  }

  /** Select what is in the middle of the picture. @param {KeyboardEvent} event */
  aim(event) {
    const point = { ...this.stage.middle(), shift: event.shiftKey, ctrl: event.ctrlKey };
    this.tools.click.click(point);
    this.stage.redraw();
  }

  renamePicked() {
    const id = [...this.store.picked][0] ?? null;
    if (id !== null) this.objects.rename(id);
    else this.toast("No object is picked.", "Click one in the list, then F2 renames it.");
  }

  hide() {
    const ids = [...this.store.picked];
    if (ids.length > 0) this.command("set_visible", { ids, visible: false });
    else this.toast("No object is picked.", "Click one in the list, then H hides it.");
  }

  showAll() {
    const { objects, isolated } = this.store.document;
    if (isolated?.length) this.command("isolate", { ids: [] });
    const ids = objects.filter((object) => !object.visible).map((object) => object.id);
    if (ids.length > 0) this.command("set_visible", { ids, visible: true });
  }

  /**
   * Remove, duplicate or move the selection, or objects.
   * @param {"remove"|"duplicate"|"move"} kind
   * @param {import("./tools/move.js").Motion} [motion]
   * @param {number[]} [ids]
   * @returns {boolean} Whether it went out.
   */
  edit(kind, motion, ids) {
    const { store, camera } = this;
    const objects = ids ?? (store.document.selection ? undefined : [...store.picked]);
    if (objects?.length === 0) {
      this.toast("Nothing is selected.", "Select a thing or pick an object in the list.");
      return false;
    }
    /** @type {Record<string, unknown>} */
    const args = objects ? { ids: objects } : {};
    const subject = this.tools.move.subject();
    if (kind === "move" && motion) Object.assign(args, motion);
    else if (kind === "duplicate" && subject) {
      args.translation = mul(camera.right, (subject.radius || camera.radius * 0.05) * 1.5);
      args.about = subject.about;
    }
    return this.command(kind, args);
  }

  /** @param {string} colour #rrggbb */
  recolour(colour) {
    this.command("recolour", { colour: bytes(colour) });
  }

  /** @param {string} id Of a panel; on a narrow page it comes up. */
  showPanel(id) {
    if (matchMedia("(max-width: 760px)").matches) this.top.sheet(id);
  }
}

const app = new App();
app.start();
