/**
 * Pictures drawn by the server: newest camera wins, one frame in flight, a still at rest.
 */

import { unpacked } from "./binary.js";

/** @typedef {import("../main.js").App} App */

const REST_AFTER = 180;
const GIVE_UP_AFTER = 8000;
const MEASURES_KEPT = 1000;
const FRAME = 0x46;
const ID_MAP = 0x49;

export class ServerStage {
  /** @param {App} app */
  constructor(app) {
    this.app = app;
    this.id = 0;
    /** Camera whose frame is awaited (0: none). */
    this.inFlight = 0;
    this.wanted = false;
    /** @type {Map<number, number>} */
    this.sent = new Map();
    this.restTimer = 0;
    this.patience = 0;
    this.order = 0;
    this.painted = 0;
    this.measures = 0;
    /** @type {Uint8Array|null} */
    this.lastFrame = null;
    /** Called when the picture at rest of where the camera is has been painted. */
    this.still = () => {};
  }

  /** The camera moved. */
  moved() {
    this.ask(false);
    this.restLater();
  }

  /** A still, once the camera has not moved for a while. */
  restLater() {
    clearTimeout(this.restTimer);
    this.restTimer = setTimeout(() => this.rest(), REST_AFTER);
  }

  /** Nothing more of a move under way: it is made now, and the change is drawn by itself. */
  hold() {
    clearTimeout(this.restTimer);
    this.wanted = false;
  }

  /** A still, now. */
  rest() {
    clearTimeout(this.restTimer);
    this.restTimer = 0;
    this.ask(true);
  }

  /** Nothing that was asked for will come: the connection is new. */
  reset() {
    this.inFlight = 0;
    this.wanted = false;
    this.sent.clear();
    this.rest();
  }

  /** @param {boolean} rest */
  ask(rest) {
    if (this.inFlight && !rest) {
      this.wanted = true;
      return;
    }
    const { store, camera, stage } = this.app;
    // What moves is drawn in CSS pixels: four times as many on a fine screen would be for nobody.
    const scale = rest ? 1 : 1 / stage.ratio;
    const preview = this.app.tools.move.preview();
    const id = this.id + 1;
    const sent = this.app.send({
      type: "camera",
      id,
      ...camera.record(scale),
      mode: store.mode,
      only: store.only,
      rest,
      ids: rest && !preview,
      ...(preview ? { preview } : {}),
    });
    if (!sent) return;
    this.id = id;
    this.wanted = false;
    this.inFlight = id;
    this.sent.set(id, performance.now());
    clearTimeout(this.patience);
    this.patience = setTimeout(() => this.release(), GIVE_UP_AFTER);
  }

  release() {
    this.inFlight = 0;
    if (this.wanted) this.ask(false);
  }

  /** A binary message. @param {ArrayBuffer} data */
  receive(data) {
    if (data.byteLength < 9) return;
    const view = new DataView(data);
    const kind = view.getUint8(0);
    if (kind === FRAME && data.byteLength > 18) void this.frame(view, data);
    if (kind === ID_MAP) void this.ids(view, data);
  }

  /** @param {DataView} view @param {ArrayBuffer} data */
  async frame(view, data) {
    const id = view.getUint32(1, true);
    if (id >= this.inFlight) {
      clearTimeout(this.patience);
      this.inFlight = 0;
      if (this.wanted) this.ask(false);
    }
    const start = this.sent.get(id);
    for (const old of this.sent.keys()) if (old <= id) this.sent.delete(old);
    const order = ++this.order;
    const jpeg = new Blob([new Uint8Array(data, 18)], { type: "image/jpeg" });
    let bitmap;
    try {
      bitmap = await createImageBitmap(jpeg);
    } catch {
      return;
    }
    if (order < this.painted) {
      bitmap.close();
      return;
    }
    this.painted = order;
    this.app.stage.paint(bitmap);
    const rest = view.getUint8(17) === 1;
    if (rest && id === this.id && !this.restTimer) this.still();
    const now = performance.now();
    const { store } = this.app;
    store.frame = {
      width: bitmap.width,
      height: bitmap.height,
      draw: view.getFloat32(5, true),
      encode: view.getFloat32(9, true),
      scale: view.getFloat32(13, true),
      whole: start === undefined ? (store.frame?.whole ?? 0) : now - start,
    };
    bitmap.close();
    if (start !== undefined) this.measure(start, now, rest);
    store.changed("status");
  }

  /** For benchmarks: `performance.getEntriesByName("frame")`. @param {number} start
   * @param {number} end @param {boolean} rest */
  measure(start, end, rest) {
    if (++this.measures > MEASURES_KEPT) {
      performance.clearMeasures("frame");
      this.measures = 1;
    }
    performance.measure("frame", { start, end, detail: { ...this.app.store.frame, rest } });
  }

  /** @param {DataView} view @param {ArrayBuffer} data */
  async ids(view, data) {
    const id = view.getUint32(1, true);
    const width = view.getUint16(5, true);
    const height = view.getUint16(7, true);
    let ids;
    try {
      ids = new Uint16Array(await unpacked(data, 9));
    } catch {
      return;
    }
    if (id !== this.id || ids.length !== width * height) return;
    this.app.stage.setIds({ width, height, ids });
  }
}
