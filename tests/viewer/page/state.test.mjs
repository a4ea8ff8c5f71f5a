/** The mirror: patches give what Python's document is, and are refused out of order. */

import assert from "node:assert/strict";
import { test } from "node:test";

import { SUGGESTION, Store } from "../../../src/splatseg/viewer/static/state.js";

const object = (id, more = {}) => ({
  id,
  name: `thing ${id}`,
  class: "",
  colour: [1, 2, 3],
  visible: true,
  locked: false,
  count: 10,
  confidence: 0.5,
  source: "click",
  ...more,
});

function opened() {
  const store = new Store();
  store.replace({
    type: "state",
    version: 1,
    scene: { name: "toys", count: 5, up: null, centre: [0, 0, 0], radius: 1, home: {} },
    views: [{ name: "a/b.jpg" }],
    layers: ["objects"],
    source: null,
    words: false,
    modes: ["colour", "objects"],
    features: ["layer"],
    document: {
      revision: 4,
      objects: [object(1), object(2), object(3)],
      selection: { count: 7, confidence: 1 },
      suggestions: [{ id: 5, name: "seat", count: 1, score: 1 }],
      edits: [],
      isolated: [],
    },
    undo: "Keep thing 3",
    redo: null,
    clients: 2,
    me: 12,
    ready: false,
    fitting: null,
  });
  return store;
}

const patch = (more) => ({
  type: "patch",
  from: 4,
  to: 5,
  objects: [],
  gone: [],
  order: null,
  suggestions: null,
  selection: null,
  edits: null,
  isolated: null,
  undo: "Rename",
  redo: null,
  author: "12",
  ...more,
});

test("state is taken as it is", () => {
  const store = opened();
  assert.equal(store.me, "12");
  assert.equal(store.ready, false);
  assert.deepEqual(store.scene.layers, ["objects"]);
  assert.equal(store.view("a/b.jpg").name, "a/b.jpg");
  assert.equal(store.view("c"), null);
  assert.ok(store.features.has("layer"));
  assert.equal(store.suggestion, 5);
});

test("a patch changes, adds, removes and orders objects", () => {
  const store = opened();
  const next = patch({
    objects: [object(2, { name: "mug" }), object(9)],
    gone: [1],
    order: [9, 3, 2],
  });
  assert.equal(store.patch(next), true);
  assert.deepEqual(
    store.document.objects.map(({ id, name }) => [id, name]),
    [
      [9, "thing 9"],
      [3, "thing 3"],
      [2, "mug"],
    ],
  );
  assert.equal(store.document.revision, 5);
  assert.equal(store.undo, "Rename");
  assert.equal(store.byId.has(1), false);
});

test("without an order new objects come last and the others stay", () => {
  const store = opened();
  store.patch(patch({ objects: [object(9), object(1, { visible: false })] }));
  assert.deepEqual(
    store.document.objects.map(({ id }) => id),
    [1, 2, 3, 9],
  );
  assert.equal(store.byId.get(1).visible, false);
});

test("a selection alone leaves the very same lists, so that no row is made again", () => {
  const store = opened();
  const { objects, suggestions } = store.document;
  store.patch(patch({ selection: { count: 1, confidence: 1 } }));
  assert.equal(store.document.objects, objects);
  assert.equal(store.document.suggestions, suggestions);
  store.patch(patch({ from: 5, to: 6, order: [3, 2, 1] }));
  assert.deepEqual(
    store.document.objects.map(({ id }) => id),
    [3, 2, 1],
  );
});

test("null leaves suggestions and edits, and ends the selection", () => {
  const store = opened();
  store.selected = { stage: "final" };
  store.patch(patch({}));
  assert.equal(store.document.selection, null);
  assert.equal(store.selected, null);
  assert.equal(store.document.suggestions.length, 1);
  store.patch(patch({ from: 5, to: 6, suggestions: [], edits: [{ kind: "move", count: 3 }] }));
  assert.equal(store.document.suggestions.length, 0);
  assert.equal(store.suggestion, null);
  assert.equal(store.document.edits.length, 1);
});

test("a patch of another revision is refused and changes nothing", () => {
  const store = opened();
  const before = store.document;
  assert.equal(store.patch(patch({ from: 3, gone: [1] })), false);
  assert.equal(store.document, before);
});

test("what is gone is not picked, and not shown alone", () => {
  const store = opened();
  store.pick([1, 2]);
  store.only = 1;
  let modes = 0;
  store.on(["mode"], () => modes++);
  store.patch(patch({ gone: [1] }));
  assert.deepEqual([...store.picked], [2]);
  assert.equal(store.only, null);
  assert.equal(modes, 1);
});

test("isolation hides the others", () => {
  const store = opened();
  store.patch(patch({ isolated: [2], objects: [object(3, { visible: false })] }));
  assert.deepEqual(
    store.document.objects.map((item) => store.shows(item)),
    [false, true, false],
  );
  store.patch(patch({ from: 5, to: 6, isolated: [] }));
  assert.deepEqual(
    store.document.objects.map((item) => store.shows(item)),
    [true, true, false],
  );
});

test("ids of the id map have the names of objects and suggestions", () => {
  const store = opened();
  assert.equal(store.nameOf(0), "");
  assert.equal(store.nameOf(2 + 1), "thing 2");
  assert.equal(store.nameOf(SUGGESTION + 5), "seat");
  assert.equal(store.nameOf(SUGGESTION + 6), "");
});

test("a listener of two topics is called once", () => {
  const store = new Store();
  let calls = 0;
  store.on(["document", "picked"], () => calls++);
  store.changed("document", "picked");
  assert.equal(calls, 1);
});
