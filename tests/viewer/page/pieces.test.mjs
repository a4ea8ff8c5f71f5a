/** Outlines of an id map, the address's fragment, the table of keys, numbers as text. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { bytes, counted, hex, number, percent } from "../../../src/splatseg/viewer/static/dom.js";
import { KEYS, LIST, MOUSE } from "../../../src/splatseg/viewer/static/keys.js";
import { readFragment } from "../../../src/splatseg/viewer/static/socket.js";
import { outline } from "../../../src/splatseg/viewer/static/stage/outline.js";

/** Records lines as "x y x y". */
globalThis.Path2D = class {
  lines = [];
  moveTo(x, y) {
    this.at = `${x} ${y}`;
  }
  lineTo(x, y) {
    this.lines.push(`${this.at} ${x} ${y}`);
  }
};

test("a rectangle of ids has four sides, in one run each", () => {
  const [width, height] = [5, 4];
  const ids = new Uint16Array(width * height);
  for (const y of [1, 2]) for (const x of [1, 2, 3]) ids[y * width + x] = 7;
  const { lines } = outline({ width, height, ids }, 7);
  assert.deepEqual(new Set(lines), new Set(["1 1 4 1", "1 3 4 3", "1 1 1 3", "4 1 4 3"]));
});

test("what touches the border is closed there, and other ids are not outlined", () => {
  const ids = Uint16Array.from([1, 2, 1, 1]);
  const { lines } = outline({ width: 2, height: 2, ids }, 1);
  const total = lines.reduce((sum, line) => {
    const [a, b, c, d] = line.split(" ").map(Number);
    return sum + Math.abs(a - c) + Math.abs(b - d);
  }, 0);
  assert.equal(total, 8);
  assert.equal(outline({ width: 2, height: 2, ids }, 3).lines.length, 0);
});

test("an outline is as long as the sides that differ, of any shape", () => {
  const pictures = [
    [".#..", "###.", ".#.."],
    ["..##", "#..#", "####"],
    ["#..#", ".##.", "#..#"],
  ];
  for (const rows of pictures) {
    const [width, height] = [rows[0].length, rows.length];
    const ids = Uint16Array.from(rows.join(""), (letter) => (letter === "#" ? 1 : 0));
    const at = (x, y) => x >= 0 && y >= 0 && x < width && y < height && rows[y][x] === "#";
    let sides = 0;
    for (let y = 0; y <= height; y++) {
      for (let x = 0; x <= width; x++) {
        sides += Number(at(x, y) !== at(x - 1, y)) + Number(at(x, y) !== at(x, y - 1));
      }
    }
    const { lines } = outline({ width, height, ids }, 1);
    const length = lines.reduce((sum, line) => {
      const [a, b, c, d] = line.split(" ").map(Number);
      return sum + Math.abs(a - c) + Math.abs(b - d);
    }, 0);
    assert.equal(length, sides, rows.join("/"));
  }
});

test("the fragment holds a token, a view, or both in either order", () => {
  assert.deepEqual(readFragment("#abc_-1"), { token: "abc_-1", view: null });
  assert.deepEqual(readFragment("#view=1,2"), { token: null, view: "1,2" });
  assert.deepEqual(readFragment("#abc&view=1,2"), { token: "abc", view: "1,2" });
  assert.deepEqual(readFragment("#view=1,2&abc"), { token: "abc", view: "1,2" });
  assert.deepEqual(readFragment(""), { token: null, view: null });
  assert.deepEqual(readFragment("#other=1"), { token: null, view: null });
});

test("no key means two things", () => {
  const names = KEYS.map(({ key, ctrl, shift }) => `${ctrl} ${shift} ${key}`);
  assert.equal(new Set(names).size, names.length);
});

test("the design's keys are there and shown", () => {
  const has = (key, { ctrl = false, shift = false } = {}) =>
    KEYS.some((row) => row.key === key && row.ctrl === ctrl && row.shift === shift);
  for (const key of [..."crlpbo[]fvh123,.nyx/?", "escape", "enter", "tab", "delete", "f2"]) {
    assert.ok(has(key), key);
  }
  for (const key of [..."fhn"]) assert.ok(has(key, { shift: true }), `shift ${key}`);
  for (const key of [..."zai"]) assert.ok(has(key, { ctrl: true }), `ctrl ${key}`);
  for (const key of [..."za"])
    assert.ok(has(key, { ctrl: true, shift: true }), `ctrl shift ${key}`);
  const shown = [...KEYS, ...MOUSE, ...LIST].filter((row) => row.shown);
  assert.ok(shown.every((row) => row.label));
  assert.ok(shown.some((row) => row.shown === "W A S D Q E"));
});

test("colours go to text and back", () => {
  assert.equal(hex([0, 128, 255]), "#0080ff");
  assert.deepEqual(bytes("#0080ff"), [0, 128, 255]);
});

test("numbers are read easily", () => {
  assert.equal(number(287012), "287\u2009012");
  assert.equal(counted(1, "Gaussian"), "1 Gaussian");
  assert.equal(counted(2, "person", "people"), "2 people");
  assert.equal(percent(0.974), "97 %");
});
