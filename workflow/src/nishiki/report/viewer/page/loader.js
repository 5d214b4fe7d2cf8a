// Blocks of data: classic scripts beside the page, or elements inside it. Neither needs fetch, which file:// forbids.
//
// Inside the page a block is <script type="application/octet-stream;base64" id="data-NAME">. As a file it is a script that
// calls nishikiData("NAME", BYTES, "..."), whose text is the bytes themselves: read as windows-1252, every byte is one
// character, so that a block takes a quarter less than in base64.

const waiting = new Map();
// What windows-1252 makes of the bytes 128 ... 159; all others keep their number.
const BYTES = new Uint8Array(0x2200).map((_, k) => k);
[..."\u20ac\x81\u201a\u0192\u201e\u2026\u2020\u2021\u02c6\u2030\u0160\u2039\u0152\x8d\u017d\x8f\x90\u2018\u2019\u201c\u201d\u2022\u2013\u2014\u02dc\u2122\u0161\u203a\u0153\x9d\u017e\u0178"].forEach((letter, k) => (BYTES[letter.charCodeAt(0)] = 128 + k));

globalThis.nishikiData = (name, length, text) => {
  const out = new Uint8Array(text.length);
  for (let i = 0; i < out.length; i++) out[i] = BYTES[text.charCodeAt(i)];
  if (out.length === length) waiting.get(name)?.(out);
  else console.error(`block ${name}: ${out.length} bytes, expected ${length}`);
};

/** Blocks by name, the last used kept up to a number of bytes. */
export class Loader {
  constructor(folder = "data", limit = 1 << 27) {
    this.folder = folder;
    this.limit = limit;
    this.held = 0;
    this.blocks = new Map();
  }

  /** Promise of the bytes (Uint8Array) of a block. */
  load(name) {
    const known = this.blocks.get(name);
    this.blocks.delete(name);
    const block = known ?? this.#read(name);
    this.blocks.set(name, block);
    return block;
  }

  async #read(name) {
    const inlined = await inlinedText(name);
    const data = inlined === null ? await this.#script(name) : bytes(inlined);
    this.held += data.length;
    for (const [other, block] of this.blocks) {
      if (this.held <= this.limit) break;
      if (other === name) continue;
      this.blocks.delete(other);
      block.then((dropped) => (this.held -= dropped.length), () => {});
    }
    return data;
  }

  #script(name) {
    return new Promise((resolve, reject) => {
      const element = document.createElement("script");
      const done = () => (waiting.delete(name), element.remove());
      waiting.set(name, (data) => (done(), resolve(data)));
      element.onerror = () => (done(), this.blocks.delete(name), reject(new Error(`${this.folder}/${name}.js is missing`)));
      element.charset = "windows-1252";
      element.src = `${this.folder}/${name}.js`;
      document.head.append(element);
    });
  }
}

/** Text of a block inside the page, once the parser has read all of it; null where the page holds no such block. */
async function inlinedText(name) {
  for (;;) {
    const element = document.getElementById(`data-${name}`), loading = document.readyState === "loading";
    if (element && (element.nextSibling || !loading)) return element.textContent;
    if (!loading) return null;
    await parsed();
  }
}

/** When the parser has read more of the page. */
function parsed() {
  return new Promise((/** @type {(value?: void) => void} */ resolve) => {
    const watch = new MutationObserver(() => done());
    const done = () => (watch.disconnect(), document.removeEventListener("readystatechange", done), resolve());
    watch.observe(document.body, { childList: true });
    document.addEventListener("readystatechange", done);
  });
}

/** Bytes of base64 text. */
export function bytes(text) {
  const binary = atob(text);
  const out = new Uint8Array(binary.length);
  for (let i = 0; i < out.length; i++) out[i] = binary.charCodeAt(i);
  return out;
}

/** An image in PNG, JPEG or WebP, its values untouched. */
export function picture(data, type) {
  return createImageBitmap(new Blob([data], { type }), { colorSpaceConversion: "none", premultiplyAlpha: "none" });
}

/** Promise of the bytes behind a zlib stream. */
export async function inflate(data) {
  const stream = new Blob([data]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
