/** Whom to let draw, the colours of objects, bits, and the changes of the engine's shaders. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { deflateSync } from "node:zlib";

import { Store } from "../../../src/splatseg/viewer/static/state.js";
import { expand, unpacked } from "../../../src/splatseg/viewer/static/stage/binary.js";
import {
  DRAWN,
  LEFT_OUT,
  doubt,
  median,
  paletteOf,
} from "../../../src/splatseg/viewer/static/stage/choice.js";
import { patch } from "../../../src/splatseg/viewer/static/stage/engine.js";

test("renderers in software, and those without a name, are doubted", () => {
  for (const name of [
    "",
    "ANGLE (Google, Vulkan 1.3.0 (SwiftShader Device (Subzero) (0x0000C0DE)), SwiftShader driver)",
    "ANGLE (Mesa, llvmpipe (LLVM 15.0.6, 256 bits), OpenGL 4.5)",
    "Gallium 0.4 on softpipe",
    "ANGLE (Microsoft, Microsoft Basic Render Driver Direct3D11 vs_5_0 ps_5_0, D3D11)",
  ]) {
    assert.notEqual(doubt(name), "", name);
  }
  for (const name of [
    "ANGLE (NVIDIA, NVIDIA GeForce RTX 4090 Direct3D11 vs_5_0 ps_5_0, D3D11)",
    "ANGLE (Apple, ANGLE Metal Renderer: Apple M2, Unspecified Version)",
    "Mali-G78",
  ]) {
    assert.equal(doubt(name), "", name);
  }
});

test("the median of five is the third", () => {
  assert.equal(median([100, 3, 9, 1, 7]), 7);
  assert.equal(median([]), 0);
});

test("bits become bytes, the highest bit first", () => {
  const bytes = new Uint8Array(16).fill(7);
  expand(Uint8Array.of(0b10100001, 0b01000000), 10, bytes);
  assert.deepEqual([...bytes], [255, 0, 255, 0, 0, 0, 0, 255, 0, 255, 7, 7, 7, 7, 7, 7]);
});

test("what zlib packed is unpacked from a byte on", async () => {
  const message = Buffer.concat([Buffer.from("O1234"), deflateSync(Buffer.from("abc"))]);
  const data = Uint8Array.from(message).buffer;
  assert.equal(Buffer.from(await unpacked(data, 5)).toString(), "abc");
});

function store(changes = {}) {
  const made = new Store();
  const object = (id, more) => ({ id, colour: [10 * id, 20, 30], visible: true, ...more });
  const objects = [object(1), object(2, { visible: false }), object(3), object(5000)];
  made.document = { ...made.document, objects };
  Object.assign(made, changes);
  return made;
}

const colour = (palette, code) => [...palette.subarray(4 * code, 4 * code + 4)];

test("objects have no colour, half of one, or nothing else, by the mode", () => {
  assert.deepEqual([...DRAWN].sort(), ["blend", "colour", "objects"]);
  for (const [mode, share, other] of [
    ["colour", 0, [0, 0, 0, 0]],
    ["blend", 128, [0, 0, 0, 0]],
    ["objects", 254, [64, 64, 64, 254]],
  ]) {
    const palette = paletteOf(store({ mode }));
    assert.equal(palette.length, 4 * 256 * 16);
    assert.deepEqual(colour(palette, 0), other);
    assert.deepEqual(colour(palette, 2), [10, 20, 30, share]);
    assert.deepEqual(colour(palette, 3), [20, 20, 30, 255], "hidden");
    assert.deepEqual(colour(palette, 4), [30, 20, 30, share]);
    assert.equal(colour(palette, LEFT_OUT)[3], 255);
  }
});

test("of what is shown alone the rest is hidden", () => {
  const only = paletteOf(store({ only: 2 }));
  assert.deepEqual([0, 2, 3, 4].map((code) => colour(only, code)[3]), [255, 255, 0, 255]);
  const isolated = store();
  isolated.document.isolated = [3];
  const palette = paletteOf(isolated);
  assert.deepEqual([0, 2, 3, 4].map((code) => colour(palette, code)[3]), [255, 255, 255, 0]);
});

test("shaders are changed in whole groups, or not at all", () => {
  const corner = "a + 0.3; b + 0.3; max(mid - radius, 0.1); sqrt(2.0 * x); sqrt(2.0 * y)";
  const whole = () =>
    new Map([
      ["gsplatCornerVS", corner],
      ["gsplatPS", "return (exp(x * -4.0) - EXP4) * INV_EXP4;"],
      ["gsplatCommonVS", "sqrt(max(0.0, log(alpha / alphaClipValue))) * 0.5"],
    ]);
  const chunks = whole();
  assert.deepEqual(patch(chunks, 0.1), []);
  assert.equal(
    chunks.get("gsplatCornerVS"),
    "a + 0.400000; b + 0.400000; max(mid - radius, 0.0001); sqrt(2.77063 * x); sqrt(2.77063 * y)",
  );
  assert.equal(chunks.get("gsplatPS"), "return exp(x * -5.54126);");
  assert.match(chunks.get("gsplatCommonVS"), /clipValue\)\) \/ 5\.54126\)$/i);
  const other = whole();
  other.set("gsplatPS", "return 1.0;");
  assert.deepEqual(patch(other, 0.1), ["shape of a Gaussian"]);
  assert.match(other.get("gsplatCornerVS"), /sqrt\(2\.0 \* x\)/);
  assert.match(other.get("gsplatCornerVS"), /\+ 0\.400000/);
  assert.deepEqual(patch(new Map(), 0.1), ["low pass", "shape of a Gaussian"]);
});
