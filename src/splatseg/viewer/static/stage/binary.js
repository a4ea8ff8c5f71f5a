/** Binary messages of the server: what zlib packed, and bits as bytes. */

/**
 * The rest of a message, unpacked.
 * @param {ArrayBuffer} data @param {number} from Byte that the zlib stream begins at.
 * @returns {Promise<ArrayBuffer>}
 */
export function unpacked(data, from) {
  const packed = new Blob([new Uint8Array(data, from)]).stream();
  return new Response(packed.pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
}

/**
 * Bits as bytes, 255 for each that is set; the highest bit of a byte comes first.
 * @param {Uint8Array} bits @param {number} count @param {Uint8Array} bytes Where they are written.
 */
export function expand(bits, count, bytes) {
  for (let i = 0; i < count; i++) bytes[i] = -((bits[i >> 3] >> (7 - (i & 7))) & 1);
}
