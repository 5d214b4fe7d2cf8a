// Blocks of data: classic scripts beside the page, or elements inside it. Neither needs fetch, which file:// forbids.
//
// A block is base64 of its bytes. As a file it is a script that calls nishikiData("NAME", "data:...;base64,..."); inside
// the page it is <script type="application/octet-stream;base64" id="data-NAME">.

const waiting = new Map();

globalThis.nishikiData = (name, url) => waiting.get(name)?.(bytes(url.slice(url.indexOf(",") + 1)));

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
    const inlined = document.getElementById(`data-${name}`);
    const data = inlined ? bytes(inlined.textContent) : await this.#script(name);
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
      element.src = `${this.folder}/${name}.js`;
      document.head.append(element);
    });
  }
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
