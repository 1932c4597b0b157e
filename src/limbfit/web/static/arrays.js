// Blocks of named arrays, as limbfit/web/__init__.py writes them.
const ARRAY_TYPES = { f4: Float32Array, u4: Uint32Array, u2: Uint16Array, u1: Uint8Array, i4: Int32Array };

/** {arrays: {name: {values, shape}}, facts} of an ArrayBuffer. */
export function readArrays(buffer) {
  const magic = new TextDecoder().decode(new Uint8Array(buffer, 0, 8));
  if (magic !== "LFARRAY1") throw new Error("not a block of arrays");
  const length = new DataView(buffer).getUint32(8, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 12, length)));
  const arrays = {};
  for (const [name, row] of Object.entries(head.arrays)) {
    const count = row.shape.reduce((a, b) => a * b, 1);
    arrays[name] = { values: new ARRAY_TYPES[row.type](buffer, 12 + length + row.at, count), shape: row.shape };
  }
  return { arrays, facts: head.facts };
}

/** The bytes of base64 text as an ArrayBuffer. */
export function bytesOfBase64(text) {
  const binary = atob(text.trim());
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes.buffer;
}
