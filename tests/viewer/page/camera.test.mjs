/** The camera's moves by identities: what is held stays, what is turned keeps its distance. */

import assert from "node:assert/strict";
import { test } from "node:test";

import {
  Camera,
  between,
  cross,
  dot,
  norm,
  sub,
  turn,
} from "../../../src/splatseg/viewer/static/camera.js";

function near(actual, expected, tolerance = 1e-9) {
  for (const [i, value] of [actual].flat(2).entries()) {
    assert.ok(Math.abs(value - [expected].flat(2)[i]) < tolerance, `${actual} is not ${expected}`);
  }
}

function camera() {
  const made = new Camera();
  made.width = 800;
  made.height = 600;
  made.radius = 3;
  made.setMatrix([1, 0, 0, 0.3, 0, 0, 1, -4, 0, -1, 0, 1, 0, 0, 0, 1], 4);
  made.orbit(0.7, -0.3);
  return made;
}

function assertRigid(made) {
  near([norm(made.right), norm(made.down), norm(made.forward)], [1, 1, 1]);
  near(dot(made.right, made.forward), 0);
  near(cross(made.right, made.down), made.forward);
}

test("a quarter turn about z takes x to y", () => {
  near(turn([1, 0, 0], [0, 0, 1], Math.PI / 2), [0, 1, 0]);
});

test("matrix and setMatrix are inverse", () => {
  const one = camera();
  const two = new Camera();
  two.setMatrix(one.matrix(), one.distance);
  near(two.matrix(), one.matrix());
  near(two.pivot, one.pivot);
});

test("project undoes unproject", () => {
  const made = camera();
  const { x, y, depth } = made.project(made.unproject(123, 456, 2.5));
  near([x, y, depth], [123, 456, 2.5]);
  near(made.project(made.unproject(400, 300, 1)).x, 400);
});

test("orbiting keeps the pivot in the middle and its distance", () => {
  const made = camera();
  const { pivot, distance } = made;
  made.orbit(-1.1, 0.2);
  assertRigid(made);
  near(norm(sub(made.position, pivot)), distance);
  near([made.project(pivot).x, made.project(pivot).y], [400, 300], 1e-6);
});

test("a drag to the right shows the left side: the camera goes to the left", () => {
  const made = new Camera();
  made.orbit(-0.1, 0);
  assert.ok(made.position[0] < 0);
  made.orbit(0, -0.2);
  assert.ok(made.position[2] > 0, "a drag downwards looks from above");
});

test("orbiting stops short of the poles", () => {
  const made = camera();
  for (let i = 0; i < 50; i++) made.orbit(0, -0.3);
  assertRigid(made);
  assert.ok(dot(made.forward, made.up) > -0.9999);
  assert.ok(dot(made.right, made.up) < 1e-9);
});

test("orbiting takes the roll of a photograph away by and by", () => {
  const made = camera();
  made.right = turn(made.right, made.forward, 0.4);
  made.down = cross(made.forward, made.right);
  made.orbit(0.01, 0);
  const left = dot(made.right, made.up);
  assert.ok(Math.abs(left) > 0.05, "not with a jump");
  for (let i = 0; i < 60; i++) made.orbit(0.01, 0);
  near(dot(made.right, made.up), 0, 1e-5);
});

test("looking around stays where one stands", () => {
  const made = camera();
  const { position, distance } = made;
  made.look(0.4, 0.1);
  near(made.position, position);
  near(made.distance, distance);
});

test("zoom holds what is under the pointer and scales the distance", () => {
  const made = camera();
  const held = made.unproject(650, 80, made.distance);
  const { distance } = made;
  made.zoom(0.5, 650, 80);
  near([made.project(held).x, made.project(held).y], [650, 80], 1e-6);
  near([made.distance, made.project(held).depth], [distance / 2, distance / 2]);
  for (let i = 0; i < 100; i++) made.zoom(0.5, 650, 80);
  assert.ok(made.distance > 0);
});

test("pan moves what is at the pivot's depth with the pointer", () => {
  const made = camera();
  const point = made.unproject(200, 200, made.distance);
  made.pan(30, -20);
  near([made.project(point).x, made.project(point).y], [230, 180], 1e-6);
});

test("framing fits a ball into the shorter side", () => {
  const made = camera();
  made.frame([1, 2, 3], 0.5);
  const middle = made.project([1, 2, 3]);
  near([middle.x, middle.y], [400, 300], 1e-6);
  const half = (0.5 / middle.depth) * made.pixels;
  assert.ok(half < 300 && half > 150, `${half}`);
});

test("a link comes back to the same view", () => {
  const one = camera();
  const two = camera();
  two.orbit(1, 0.2);
  const numbers = one.toLink().split(",");
  assert.ok(two.fromLink(one.toLink()));
  near(two.matrix(), one.matrix(), 1e-4);
  near(two.pivot, one.pivot, 1e-4);
  assertRigid(two);
  assert.equal(two.fromLink(numbers.with(12, "0").join()), false, "no distance");
  for (const text of [
    "",
    "1,2,3",
    one.toLink().replace(/^[^,]+/, "x"),
    one.toLink().replace(/[^,]+$/, "0"),
  ]) {
    assert.equal(two.fromLink(text), false);
  }
});

test("a swing begins and ends where it should and is rigid between", () => {
  const [from, to, out] = [camera(), camera(), camera()];
  to.orbit(1.2, 0.3);
  to.zoom(0.4, 10, 20);
  between(from, to, 0, out);
  near(out.matrix(), from.matrix());
  between(from, to, 1, out);
  near(out.matrix(), to.matrix());
  between(from, to, 0.4, out);
  assertRigid(out);
});

test("focal lengths are of the longer side", () => {
  const made = new Camera();
  made.focal = 0.9;
  [made.width, made.height] = [380, 800];
  assert.equal(made.record().focal, 720);
  const { width, height, focal } = made.record(0.5);
  assert.deepEqual([width, height, focal], [190, 400, 360]);
});
