/**
 * Who draws: whether a page's GPU can be trusted to, and in which colours it shows the objects.
 *
 * @typedef {"server"|"gpu"|"forced"} Wanted Forced: however slow it is.
 */

/** Milliseconds a frame, the median of some, from which on the server is better. */
export const SLOWEST = 40;

const SOFTWARE = /swiftshader|llvmpipe|softpipe|basic render|software/i;

/** What the browser draws with; empty where it does not say, or has no WebGL. @returns {string} */
export function rendererName() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const known = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = gl && known ? gl.getParameter(known.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return String(name);
}

/**
 * What speaks against a renderer.
 * @param {string} name @returns {string} Empty for a GPU.
 */
export function doubt(name) {
  if (!name) return "the browser names no GPU";
  return SOFTWARE.test(name) ? "the browser has no GPU" : "";
}

/** @param {number[]} times Milliseconds of some frames. @returns {number} */
export function median(times) {
  const sorted = [...times].sort((a, b) => a - b);
  return sorted[sorted.length >> 1] ?? 0;
}

/** Width and height of the palette: a colour for each code of a Gaussian. */
export const PALETTE = /** @type {const} */ ([256, 16]);
/** Code of Gaussians that are left out; 0 is of no object, others are an object's id + 1. */
export const LEFT_OUT = 4095;
/** Modes whose pictures the page draws; the others are the server's. */
export const DRAWN = new Set(["colour", "blend", "objects"]);

// The alpha of a palette: what share of a Gaussian's own colour its object's replaces.
const HALF = 128;
const WHOLE = 254;
const HIDDEN = 255;
const NO_OBJECT = 64;

/**
 * RGBA of each code, as the page's mirror has the objects.
 * @param {import("../state.js").Store} store
 * @returns {Uint8Array}
 */
export function paletteOf(store) {
  const { mode, only } = store;
  const [width, height] = PALETTE;
  const colours = new Uint8Array(4 * width * height);
  const alone = only !== null || Boolean(store.document.isolated?.length);
  if (mode === "objects") colours.set([NO_OBJECT, NO_OBJECT, NO_OBJECT, WHOLE]);
  if (alone) colours[3] = HIDDEN;
  for (const object of store.document.objects) {
    const code = object.id + 1;
    if (code >= LEFT_OUT) continue;
    const shown = only === null ? store.shows(object) : only === object.id;
    const share = { objects: WHOLE, blend: HALF }[mode] ?? 0;
    colours.set([...object.colour, shown ? share : HIDDEN], 4 * code);
  }
  colours[4 * LEFT_OUT + 3] = HIDDEN;
  return colours;
}
