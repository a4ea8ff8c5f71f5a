/**
 * PlayCanvas, which draws Gaussians in the page. This module alone knows it.
 *
 * Two streams go with each Gaussian, the code of its object and whether it is selected. They are
 * mixed into its colour, as the server does it, where the engine copies Gaussians to its buffer.
 *
 * @typedef {import("../camera.js").Camera} Camera
 */

import { expand } from "./binary.js";
import { PALETTE } from "./choice.js";

// Not a literal in the import: types of the engine's 2.5 MB are not for us to check.
const ENGINE = "../vendor/playcanvas-2.23.3.min.mjs";

const NEAR = 0.01;
const FAR = 1e5;
/** Degrees that the camera turns until harmonics are evaluated anew. */
const HARMONICS_AFTER = 1;
/** A Gaussian ends where its alpha falls below 1/255: at exp(-REACH). */
const REACH = Math.log(255);

const MODIFIER = `
uniform sampler2D palette;
void modifySplatCenter(inout vec3 center) {}
void modifySplatRotationScale(vec3 from, vec3 to, inout vec4 rotation, inout vec3 scale) {}
void modifySplatColor(vec3 center, inout vec4 color) {
  uint code = loadObjectCode().r;
  vec4 own = texelFetch(palette, ivec2(int(code & 255u), int(code >> 8u)), 0);
  if (own.a > 0.998) color.a = 0.0;
  color.rgb = mix(color.rgb, own.rgb, min(own.a * (255.0 / 254.0), 1.0));
  color.rgb = mix(color.rgb, vec3(1.0, 0.451, 0.0), 0.6 * float(loadSelected().r) / 255.0);
}`;

/**
 * Changes of the engine's shaders towards our renderer. The changes of a group depend on each
 * other: where one finds nothing to change, the group is left out.
 * @param {number} lowPass Square pixels.
 * @returns {Record<string, [chunk: string, from: string, to: string][]>}
 */
function patches(lowPass) {
  const reach = REACH.toFixed(5);
  const half = (REACH / 2).toFixed(5);
  // The engine counts in half pixels, so that its 0.3 are 0.075 square pixels.
  const variance = (4 * lowPass).toFixed(6);
  return {
    "low pass": [
      ["gsplatCornerVS", "+ 0.3", `+ ${variance}`],
      ["gsplatCornerVS", "max(mid - radius, 0.1)", "max(mid - radius, 0.0001)"],
    ],
    "shape of a Gaussian": [
      ["gsplatCornerVS", "sqrt(2.0 *", `sqrt(${half} *`],
      ["gsplatPS", "(exp(x * -4.0) - EXP4) * INV_EXP4", `exp(x * -${reach})`],
      [
        "gsplatCommonVS",
        "sqrt(max(0.0, log(alpha / alphaClipValue))) * 0.5",
        `sqrt(max(0.0, log(alpha / alphaClipValue)) / ${reach})`,
      ],
    ],
  };
}

/**
 * Apply them.
 * @param {Map<string, string>} chunks Shaders by name.
 * @param {number} lowPass
 * @returns {string[]} Groups that were left out.
 */
export function patch(chunks, lowPass) {
  const missing = [];
  for (const [name, group] of Object.entries(patches(lowPass))) {
    if (!group.every(([chunk, from]) => chunks.get(chunk)?.includes(from))) {
      missing.push(name);
      continue;
    }
    for (const [chunk, from, to] of group) {
      chunks.set(chunk, /** @type {string} */ (chunks.get(chunk)).replaceAll(from, to));
    }
  }
  return missing;
}

export class Engine {
  /**
   * @param {any} pc The module. @param {any} app Of PlayCanvas. @param {any} device
   * @param {HTMLCanvasElement} canvas
   */
  constructor(pc, app, device, canvas) {
    this.pc = pc;
    this.app = app;
    this.device = device;
    this.canvas = canvas;
    /** Orders of Gaussians that the engine's worker has found. */
    this.sorted = 0;
    this.count = 0;
    app.scene.on("gsplat:sorted", () => void (this.sorted += 1));
    this.eye = new pc.Entity("eye");
    this.eye.addComponent("camera", {
      clearColor: new pc.Color(0, 0, 0, 1),
      nearClip: NEAR,
      farClip: FAR,
      toneMapping: pc.TONEMAP_NONE,
      horizontalFov: true,
    });
    app.root.addChild(this.eye);
    this.things = new pc.Entity("things");
    app.root.addChild(this.things);
    this.pose = new pc.Mat4();
    this.turn = new pc.Quat();
    /** @type {any} */
    this.palette = null;
  }

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{lowPass: number, antialiased: boolean}} drawn How the Gaussians are meant.
   * @returns {Promise<Engine>}
   */
  static async open(canvas, { lowPass, antialiased }) {
    const pc = await import(ENGINE);
    const device = await pc.createGraphicsDevice(canvas, {
      deviceTypes: ["webgl2"],
      antialias: false,
      alpha: false,
      powerPreference: "high-performance",
    });
    const options = new pc.AppOptions();
    options.graphicsDevice = device;
    options.componentSystems = [pc.CameraComponentSystem, pc.GSplatComponentSystem];
    options.resourceHandlers = [pc.GSplatHandler];
    const app = new pc.AppBase(canvas);
    app.init(options);
    // Frames are drawn when we say so: an idle page costs nothing.
    app.requestAnimationFrame = () => {};
    app.start();
    const { gsplat } = app.scene;
    // 32 bytes a Gaussian; of the other 24 the eight-bit scales are seen.
    gsplat.dataFormat = pc.GSPLATDATA_LARGE;
    gsplat.antiAlias = antialiased;
    gsplat.alphaClipForward = 1 / 255;
    gsplat.minPixelSize = 0;
    gsplat.colorUpdateAngle = HARMONICS_AFTER;
    const chunks = pc.ShaderChunks.get(device, pc.SHADERLANGUAGE_GLSL);
    const missing = patch(chunks, lowPass);
    if (missing.length > 0) {
      console.warn(`The stage draws less exactly: ${missing.join(", ")} not found in the engine.`);
    }
    return new Engine(pc, app, device, canvas);
  }

  /** Gaussians, in the order of the file. @param {Response} response A PLY file. */
  async load(response) {
    const { pc, app } = this;
    const file = { url: "scene.ply", filename: "scene.ply", contents: response };
    const asset = new pc.Asset("scene", "gsplat", file, { reorder: false });
    await new Promise((done, failed) => {
      asset.once("load", done);
      asset.once("error", failed);
      app.assets.add(asset);
      app.assets.load(asset);
    });
    const { format, numSplats } = asset.resource;
    this.count = numSplats;
    format.addExtraStreams([
      { name: "objectCode", format: pc.PIXELFORMAT_R16U, storage: pc.GSPLAT_STREAM_INSTANCE },
      { name: "selected", format: pc.PIXELFORMAT_R8U, storage: pc.GSPLAT_STREAM_INSTANCE },
    ]);
    this.things.addComponent("gsplat", { asset });
    const [width, height] = PALETTE;
    this.palette = new pc.Texture(this.device, {
      width,
      height,
      format: pc.PIXELFORMAT_RGBA8,
      mipmaps: false,
      minFilter: pc.FILTER_NEAREST,
      magFilter: pc.FILTER_NEAREST,
    });
    this.things.gsplat.setWorkBufferModifier({ glsl: MODIFIER });
    this.things.gsplat.setParameter("palette", this.palette);
  }

  /** @param {Uint8Array} colours RGBA by code. */
  setPalette(colours) {
    this.palette.lock().set(colours);
    this.palette.unlock();
    this.changed();
  }

  /** @param {Uint16Array} codes Of each Gaussian. */
  setCodes(codes) {
    this.write("objectCode", (texels) => texels.set(codes));
  }

  /** @param {Uint8Array} bits Of each Gaussian whether it is selected. */
  setSelection(bits) {
    const start = performance.now();
    this.write("selected", (texels) => expand(bits, this.count, texels));
    performance.measure("selection", { start, detail: { count: this.count } });
  }

  /** @param {string} stream @param {(texels: any) => void} fill */
  write(stream, fill) {
    const texture = this.things.gsplat.getInstanceTexture(stream);
    fill(texture.lock());
    texture.unlock();
    this.changed();
  }

  changed() {
    this.things.gsplat.workBufferUpdate = this.pc.WORKBUFFER_UPDATE_ONCE;
  }

  /** A frame of a camera. @param {Camera} camera */
  draw(camera) {
    const { canvas, device, eye } = this;
    if (canvas.width !== camera.width || canvas.height !== camera.height) {
      device.resizeCanvas(camera.width, camera.height);
    }
    // The engine's cameras look along -z with y up.
    const { right: r, down: d, forward: f, position: p } = camera;
    const columns = [...r, 0, -d[0], -d[1], -d[2], 0, -f[0], -f[1], -f[2], 0, ...p, 1];
    this.pose.set(columns);
    eye.setPosition(p[0], p[1], p[2]);
    eye.setRotation(this.turn.setFromMat4(this.pose));
    eye.camera.fov = (2 * Math.atan(camera.width / 2 / camera.pixels) * 180) / Math.PI;
    this.app.tick(performance.now());
  }

  /** Until what was asked of the GPU is done. */
  async finished() {
    const { gl } = this.device;
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (!gl.isContextLost() && gl.getSyncParameter(sync, gl.SYNC_STATUS) !== gl.SIGNALED) {
      await new Promise((done) => setTimeout(done, 1));
    }
    gl.deleteSync(sync);
  }

  close() {
    const { gl } = this.device;
    this.app.destroy();
    gl.getExtension("WEBGL_lose_context")?.loseContext();
    this.canvas.remove();
  }
}
