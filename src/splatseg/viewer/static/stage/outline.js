/** Outlines of ids of an id map, as paths in its pixels. */

/** @typedef {{width: number, height: number, ids: Uint16Array}} IdMap */

/**
 * The border between the pixels of an id and all others, in runs.
 * @param {IdMap} map
 * @param {number} id
 * @returns {Path2D}
 */
export function outline(map, id) {
  const { width, height, ids } = map;
  const path = new Path2D();
  for (let y = 0; y <= height; y++) {
    let start = -1;
    for (let x = 0; x <= width; x++) {
      const above = y > 0 && x < width && ids[(y - 1) * width + x] === id;
      const below = y < height && x < width && ids[y * width + x] === id;
      if (above !== below) {
        if (start < 0) start = x;
      } else if (start >= 0) {
        path.moveTo(start, y);
        path.lineTo(x, y);
        start = -1;
      }
    }
  }
  for (let x = 0; x <= width; x++) {
    let start = -1;
    for (let y = 0; y <= height; y++) {
      const left = x > 0 && y < height && ids[y * width + x - 1] === id;
      const here = x < width && y < height && ids[y * width + x] === id;
      if (left !== here) {
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
