// Arrays of nishiki.report.viewer.page: one deflated block of named arrays.

import { inflate } from "viewer/loader";

const TYPES = {
  int8: Int8Array, int16: Int16Array, int32: Int32Array,
  uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array,
};

/** {name: {values: TypedArray, shape: [..]}} of a deflated block. */
export async function unpackArrays(data) {
  const bytes = await inflate(data);
  const length = new DataView(bytes.buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + length)));
  const arrays = {};
  let at = 4 + length;
  for (const { name, type, shape } of head) {
    const values = new TYPES[type](shape.reduce((a, b) => a * b, 1));
    const out = new Uint8Array(values.buffer);
    const size = values.BYTES_PER_ELEMENT;
    for (let byte = 0; byte < size; byte++) {
      for (let n = 0; n < values.length; n++) out[n * size + byte] = bytes[at++];
    }
    arrays[name] = { values, shape };
  }
  return arrays;
}
