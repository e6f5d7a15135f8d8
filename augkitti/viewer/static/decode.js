// Packed columns in, typed arrays out: what augkitti/viewer/columns.py packed, undone.
"use strict";

const ARRAYS = { int32: Int32Array, int16: Int16Array, uint16: Uint16Array, uint8: Uint8Array };

/** @param {string} base64 text of the packed bytes @param {Array} contents table of contents @returns {Promise<Object>} */
async function decodeColumns(base64, contents) {
  const stream = new Blob([bytesOf(base64)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const body = new Uint8Array(await new Response(stream).arrayBuffer());
  const columns = {};
  let at = 0;
  for (const { name, type, rows, each } of contents) {
    const values = new ARRAYS[type](rows * each);
    const width = values.BYTES_PER_ELEMENT;
    const count = rows * each;
    for (let c = 0; c < each; c++) {
      let sum = 0;
      for (let row = 0; row < rows; row++) {
        let coded = 0;
        for (let plane = 0, from = at + c * rows + row; plane < width; plane++, from += count) {
          coded |= body[from] << (8 * plane);
        }
        sum = (sum + ((coded >>> 1) ^ -(coded & 1))) | 0;
        values[row * each + c] = sum; // a narrow array wraps round, as the differences did
      }
    }
    columns[name] = values;
    at += width * count;
  }
  return columns;
}

function bytesOf(base64) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}
