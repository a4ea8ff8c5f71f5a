/**
 * Gaussians drawn in the page while the camera moves; at rest the server's still takes over.
 *
 * What the page cannot draw is the server's: other modes, and everything until the Gaussians are
 * there. Where drawing fails or is slow, the server draws from then on, and the status line says so.
 *
 * @typedef {import("../main.js").App} App
 * @typedef {import("./server.js").ServerStage} ServerStage
 * @typedef {import("./choice.js").Wanted} Wanted
 */

import { el } from "../dom.js";
import { unpacked } from "./binary.js";
import { DRAWN, SLOWEST, doubt, median, paletteOf, rendererName } from "./choice.js";
import { Engine } from "./engine.js";

const CODES = 0x4f;
const SELECTION = 0x53;
const FIRST_WITHIN = 10_000;
const RELOAD_AFTER = 400;
const TIMED = 5;
/** Milliseconds after the last move in which the order of the Gaussians may still change. */
const LINGERS = 3000;

const LOST = "the graphics context was lost";

export class GpuStage {
  /** @param {App} app @param {ServerStage} server */
  constructor(app, server) {
    this.app = app;
    this.server = server;
    /** @type {Wanted} */
    this.wanted = "server";
    /** Why the server draws although the page should. */
    this.reason = "";
    /** Of the Gaussians that are loaded or on their way. @type {number|null} */
    this.version = null;
    /** @type {Uint16Array|null} */
    this.codes = null;
    /** @type {Uint8Array|null} */
    this.bits = null;
    /** Which of several loads, and of several messages, is the last. */
    this.loads = 0;
    this.arrivals = { codes: 0, bits: 0 };
    /** That draws. @type {Engine|null} */
    this.engine = null;
    this.until = 0;
    this.moveTime = 0;
    this.frame = 0;
    server.still = () => this.hide();
    app.store.on(["document", "mode"], () => this.recolour());
    document.addEventListener("securitypolicyviolation", (event) => {
      if (event.effectiveDirective === "worker-src") this.fail("its worker is blocked");
    });
    window.addEventListener("error", (event) => {
      if (event.filename?.startsWith("blob:")) this.fail("its worker failed");
    });
  }

  /** For the status line. @returns {string} */
  get says() {
    if (this.reason) return `server draws: ${this.reason}`;
    if (this.wanted === "server") return "server draws";
    return this.engine ? "page draws" : "server draws, the page loads";
  }

  /** Another one draws from now on. @param {Wanted} wanted */
  choose(wanted) {
    if (wanted === this.wanted && !this.reason) return;
    this.unload();
    this.wanted = wanted;
    this.reason = wanted === "gpu" ? doubt(rendererName()) : "";
    this.tell();
  }

  /** Say to the server and to the person who draws. */
  tell() {
    const stage = this.wanted === "server" || this.reason ? "server" : "gpu";
    const { socket, store } = this.app;
    if (socket.stage !== stage) this.app.send({ type: "stage", stage });
    socket.stage = stage;
    store.changed("status");
  }

  /** The server draws from now on. @param {string} reason */
  fail(reason) {
    if (this.app.socket.stage === "server") return;
    this.unload();
    this.reason = reason;
    this.tell();
    this.server.rest();
  }

  unload() {
    this.loads += 1;
    this.hide();
    this.engine?.close();
    this.engine = null;
    this.version = null;
  }

  /** The camera moved. */
  moved() {
    if (!this.engine || !DRAWN.has(this.app.store.mode)) {
      this.hide();
      this.server.moved();
      return;
    }
    this.server.restLater();
    this.moveTime ||= performance.now();
    this.until = performance.now() + LINGERS;
    if (!this.frame) this.frame = requestAnimationFrame(() => this.step());
  }

  /** A still, now. */
  rest() {
    this.server.rest();
  }

  /** The connection is new; the server tells the streams again. */
  reset() {
    this.server.reset();
  }

  /** A binary message. @param {ArrayBuffer} data */
  receive(data) {
    const kind = data.byteLength > 9 ? new DataView(data).getUint8(0) : 0;
    if (kind === CODES) void this.objects(data);
    else if (kind === SELECTION) void this.selection(data);
    else this.server.receive(data);
  }

  step() {
    this.frame = 0;
    const { app, engine, server } = this;
    const start = performance.now();
    if (!engine || start > this.until) return;
    engine.draw(app.camera);
    engine.canvas.hidden = false;
    const end = performance.now();
    const whole = end - (this.moveTime || start);
    const { width, height } = engine.canvas;
    app.store.frame = { width, height, draw: end - start, encode: 0, scale: 1, whole };
    if (this.moveTime) server.measure(this.moveTime, end, false);
    this.moveTime = 0;
    app.store.changed("status");
    this.frame = requestAnimationFrame(() => this.step());
  }

  /** The server's picture is seen. */
  hide() {
    this.until = 0;
    this.moveTime = 0;
    if (this.engine) this.engine.canvas.hidden = true;
  }

  recolour() {
    this.engine?.setPalette(paletteOf(this.app.store));
  }

  /** @param {ArrayBuffer} data */
  async objects(data) {
    const order = ++this.arrivals.codes;
    const view = new DataView(data);
    const [version, count] = [view.getUint32(1, true), view.getUint32(5, true)];
    const codes = new Uint16Array(await unpacked(data, 9));
    if (order !== this.arrivals.codes || codes.length !== count) return;
    this.codes = codes;
    if (version !== this.version) await this.load(version);
    else this.engine?.setCodes(codes);
  }

  /** @param {ArrayBuffer} data */
  async selection(data) {
    const order = ++this.arrivals.bits;
    const version = new DataView(data).getUint32(1, true);
    const bits = new Uint8Array(await unpacked(data, 9));
    if (order !== this.arrivals.bits) return;
    this.bits = bits;
    if (version === this.version) this.engine?.setSelection(bits);
  }

  /** Load the Gaussians of a version. @param {number} version */
  async load(version) {
    const again = this.version !== null;
    this.unload();
    this.version = version;
    const load = this.loads;
    const current = () => load === this.loads;
    this.app.store.changed("status");
    // Of several edits in a row the last counts.
    if (again) await new Promise((done) => setTimeout(done, RELOAD_AFTER));
    if (!current()) return;
    const canvas = el("canvas", { id: "gpu", "aria-hidden": "true", hidden: true });
    this.app.stage.picture.after(canvas);
    canvas.addEventListener("webglcontextlost", () => current() && this.fail(LOST));
    const facts = /** @type {import("../state.js").SceneInfo} */ (this.app.store.scene);
    /** @type {Engine|null} */
    let engine = null;
    try {
      engine = await Engine.open(canvas, {
        lowPass: facts.low_pass,
        antialiased: facts.antialiased,
      });
      const response = await this.app.socket.fetch(`/gaussians?version=${version}`);
      if (!response.ok) throw new Error(`the Gaussians did not come (${response.status})`);
      await engine.load(response);
      if (engine.count !== this.codes?.length) throw new Error("other Gaussians came");
      await this.first(engine, current);
    } catch (error) {
      if (current()) this.fail(error instanceof Error ? error.message : String(error));
    }
    if (!current() || !engine) {
      if (engine) engine.close();
      else canvas.remove();
      return;
    }
    this.engine = engine;
    this.dress(engine);
    this.app.store.changed("status");
  }

  /** What is known of the Gaussians, to an engine. @param {Engine} engine */
  dress(engine) {
    engine.setPalette(paletteOf(this.app.store));
    if (this.codes) engine.setCodes(this.codes);
    if (this.bits) engine.setSelection(this.bits);
  }

  /**
   * The first picture, and how long frames take.
   * @param {Engine} engine @param {() => boolean} current
   */
  async first(engine, current) {
    this.dress(engine);
    const screen = () => new Promise((done) => requestAnimationFrame(done));
    await screen(); // a page that nobody sees draws nothing
    const began = performance.now();
    while (engine.sorted === 0) {
      if (performance.now() - began > FIRST_WITHIN) throw new Error("no picture in 10 s");
      engine.draw(this.app.camera);
      await screen();
      if (!current()) return;
    }
    const times = [];
    for (let i = 0; i <= TIMED; i++) {
      const start = performance.now();
      engine.draw(this.app.camera);
      await engine.finished();
      if (i > 0) times.push(performance.now() - start);
      await screen();
      if (!current()) return;
    }
    const took = median(times);
    performance.measure("stage", { start: began, detail: { frame: took } });
    if (took > SLOWEST && this.wanted !== "forced") {
      throw new Error(`the page took ${took.toFixed(0)} ms for a frame`);
    }
  }
}
