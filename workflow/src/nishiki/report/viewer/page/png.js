// Texts inside a PNG file (iTXt chunks of the PNG specification, 11.3.3.4).

const TABLE = Uint32Array.from({ length: 256 }, (_, n) => {
  for (let bit = 0; bit < 8; bit++) n = n & 1 ? 0xedb88320 ^ (n >>> 1) : n >>> 1;
  return n;
});
const HEADER_END = 8 + 25; // signature and IHDR, which comes first

/** CRC-32 of bytes. @param {Uint8Array} bytes */
export function crc32(bytes) {
  let crc = 0xffffffff;
  for (const byte of bytes) crc = TABLE[(crc ^ byte) & 255] ^ (crc >>> 8);
  return (crc ^ 0xffffffff) >>> 0;
}

/** A chunk with its length and checksum. @param {string} type @param {Uint8Array} data */
function chunk(type, data) {
  const made = new Uint8Array(data.length + 12), view = new DataView(made.buffer);
  view.setUint32(0, data.length);
  made.set(new TextEncoder().encode(type), 4);
  made.set(data, 8);
  view.setUint32(data.length + 8, crc32(made.subarray(4, data.length + 8)));
  return made;
}

/** A PNG with texts by keyword (1 to 79 letters of ASCII), put behind its header.
 * @param {Uint8Array} png @param {Record<string, string>} texts */
export function withTexts(png, texts) {
  const chunks = Object.entries(texts).map(([keyword, text]) => chunk("iTXt", new TextEncoder().encode(`${keyword}\0\0\0\0\0${text}`)));
  const made = new Uint8Array(png.length + chunks.reduce((sum, { length }) => sum + length, 0));
  let at = HEADER_END;
  made.set(png.subarray(0, at));
  for (const each of chunks) {
    made.set(each, at);
    at += each.length;
  }
  made.set(png.subarray(HEADER_END), at);
  return made;
}
