/** Outlines of ids of an id map, as paths in its pixels. */

/** @typedef {{width: number, height: number, ids: Uint16Array}} IdMap */

/**
 * The border between the pixels of an id and all others, in runs.
 * @param {IdMap} map
 * @param {number} id
 * @returns {Path2D}
 */
export function outline(map, id) {
  const path = new Path2D();
  const box = bounds(map, id);
  if (!box) return path;
  const { width, ids } = map;
  const { left, right, top, bottom } = box;
  /** @param {number} x @param {number} y Inside the box, or one beside it. */
  const has = (x, y) =>
    x >= left && x <= right && y >= top && y <= bottom && ids[y * width + x] === id;
  for (let y = top; y <= bottom + 1; y++) {
    let start = -1;
    for (let x = left; x <= right + 1; x++) {
      if (has(x, y - 1) !== has(x, y)) {
        if (start < 0) start = x;
      } else if (start >= 0) {
        path.moveTo(start, y);
        path.lineTo(x, y);
        start = -1;
      }
    }
  }
  for (let x = left; x <= right + 1; x++) {
    let start = -1;
    for (let y = top; y <= bottom + 1; y++) {
      if (has(x - 1, y) !== has(x, y)) {
        if (start < 0) start = y;
      } else if (start >= 0) {
        path.moveTo(x, start);
        path.lineTo(x, y);
        start = -1;
      }
    }
  }
  return path;
}

/**
 * First and last columns and rows that hold an id.
 * @param {IdMap} map
 * @param {number} id
 * @returns {{left: number, right: number, top: number, bottom: number}|null}
 */
function bounds({ width, ids }, id) {
  const first = ids.indexOf(id);
  if (first < 0) return null;
  const top = Math.floor(first / width);
  const bottom = Math.floor(ids.lastIndexOf(id) / width);
  let left = width;
  let right = -1;
  for (let y = top; y <= bottom; y++) {
    const row = ids.subarray(y * width, (y + 1) * width);
    const from = row.indexOf(id);
    if (from < 0) continue;
    left = Math.min(left, from);
    right = Math.max(right, row.lastIndexOf(id));
  }
  return { left, right, top, bottom };
}
