// Values of a painting's maps: its data layers as textures, and what is known at a pixel.
import { readback, texture } from "viewer/gl";
import { inflate, picture } from "viewer/loader";

/** RGBA bytes of one pixel of a texture, or of a layer of an array texture. */
function readPixel(gl, framebuffer, made, layer, column, row) {
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  if (layer === null) gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, made, 0);
  else gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, made, 0, layer);
  const bytes = readback(gl, column, row, 1, 1);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  return bytes;
}

export class Values {
  /** wait(promise): told of what is on its way. */
  constructor(gl, manifest, tiles, loader, wait) {
    this.codes = null; // promise of the samples of the photographs
    this.gl = gl;
    this.manifest = manifest;
    this.tiles = tiles;
    this.loader = loader;
    this.wait = wait;
    this.layers = new Map(); // by name: {making, texture}
    this.packing = gl.createFramebuffer();
  }

  /** Texture of a data layer; null while it is on its way. */
  layer(layer) {
    this.#load(layer);
    return this.layers.get(layer.name).texture;
  }

  /** Promise of the texture of a data layer. */
  #load(layer) {
    if (!this.layers.has(layer.name)) {
      const entry = { texture: null };
      this.layers.set(layer.name, entry);
      entry.making = this.wait(this.#make(layer).then((made) => (entry.texture = made)));
    }
    return this.layers.get(layer.name).making;
  }

  async #make(layer) {
    const image = await picture(await this.loader.load(layer.block), "image/webp");
    const { gl } = this, made = texture(gl, gl.TEXTURE_2D, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, gl.RED, gl.UNSIGNED_BYTE, image);
    image.close();
    return made;
  }

  /** What is known at a pixel of the map; place: its point in the plane of the scene. */
  async at(column, row, place) {
    const { manifest } = this;
    const layers = Object.fromEntries(await Promise.all(manifest.layers.filter(({ block }) => block).map(async (layer) => {
      const made = await this.#load(layer);
      const at = [Math.floor((column / manifest.columns) * layer.columns), Math.floor((row / manifest.rows) * layer.rows)];
      const code = readPixel(this.gl, this.packing, made, null, ...at)[0];
      const { low, high, top, nothing } = layer.code;
      return [layer.name, code === nothing && layer.map !== "flags" ? null : low + (code / top) * (high - low)];
    })));
    const record = await this.#record(column, row);
    if (!record) return { position_mm: null, normal: null, layers, spectrum: null, gloss: null, photographs: null };
    const { beta, gamma, refractive_index } = manifest.gloss;
    const sigma = layers.sigma_spectrum;
    return {
      position_mm: [...place, layers.height ?? 0],
      normal: record.normal,
      layers,
      spectrum: manifest.basis && {
        nm: manifest.wavelengths_nm,
        reflectance: manifest.wavelengths_nm.map((_, k) => manifest.basis.reduce((sum, base, i) => sum + base[k] * record.coefficients[i], 0)),
        sigma: sigma == null ? null : manifest.wavelengths_nm.map(() => sigma),
      },
      gloss: beta[0].length ? { beta: beta[record.region], gamma_rad: gamma[record.region], refractive_index: refractive_index[record.region] } : null,
      ...(await this.#photographs(column, row)),
    };
  }

  /** What every photograph shows, and what the model predicts, at the sample nearest to a pixel; null without any. */
  async #photographs(column, row) {
    if (!this.manifest.photographs) return { photographs: null };
    const { block, rows, columns, first, step, lights, white, top, nothing } = this.manifest.photographs;
    this.codes ??= inflate(await this.loader.load(block));
    const codes = await this.codes;
    const nearest = (place, start, count) => Math.min(Math.max(Math.round((place - start) / step), 0), count - 1);
    const [y, x] = [nearest(row, first[0], rows), nearest(column, first[1], columns)];
    const value = (kind, light) => codes[((kind * lights.length + light) * rows + y) * columns + x];
    const linear = (code) => (code === nothing ? null : [white * (code / top) ** 2]);
    return {
      photographs: lights.map((view, k) => ({ view, values: linear(value(0, k)), predicted: linear(value(1, k)) })),
      sample_pixels: Math.hypot(first[0] + y * step - row, first[1] + x * step - column),
    };
  }

  /** Normal, coefficients and region of a pixel of the map; null where nothing is known. */
  async #record(column, row) {
    const { size, border, unknown } = this.manifest.tiles;
    const [tileRow, tileColumn] = [row, column].map((k) => Math.floor(k / size));
    const made = await this.tiles.load(0, tileRow, tileColumn), { gl, packing, tiles } = this;
    const place = [column - tileColumn * size + border, row - tileRow * size + border];
    const values = Array.from({ length: tiles.stack }, (_, layer) => [...readPixel(gl, packing, made, layer, ...place)].slice(0, 3)).flat();
    const { normal, colour: code, shading } = this.manifest.code;
    const region = values[3 + code.low.length + (shading?.low.length ?? 0)];
    if (region === unknown) return null;
    const [sx, sy] = values.slice(0, 2).map((value) => value / 127 - 1).map((t) => normal.width * t * (normal.fineness + (1 - normal.fineness) * t * t));
    const square = sx * sx + sy * sy;
    const u = (values[2] / 255) * code.top;
    const chroma = code.low.map((low, k) => low + (values[3 + k] / 255) * (code.high[k] - low));
    return {
      region,
      normal: [2 * sx, 2 * sy, 1 - square].map((value) => value / (1 + square)),
      coefficients: code.direction.map((d, i) => u ** 3 * d + u * u * chroma.reduce((sum, value, k) => sum + value * code.components[k][i], code.mean[i])),
    };
  }
}
