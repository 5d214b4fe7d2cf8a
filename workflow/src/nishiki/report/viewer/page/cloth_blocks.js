// Surfaces and materials of a cloth's page, from their blocks of data to the graphics processor.
import { attribute, texture } from "viewer/gl";

/** A surface on the GPU: its vertex array, and how many corners its triangles have, those of the cloth first. */
export function uploadSurface(gl, arrays, step) {
  const made = gl.createVertexArray();
  const [vertices, normals, weft, triangles] = ["vertices", "normals", "weft", "triangles"].map((name) => summed(arrays[name].values, 3));
  const cloth = arrays.cloth.values;
  gl.bindVertexArray(made);
  attribute(gl, 0, Float32Array.from(vertices, (v) => v * step), 3);
  attribute(gl, 1, four(normals, (n) => (cloth[n] ? 0 : 32767)), 4);
  attribute(gl, 2, four(weft, () => 0), 4);
  attribute(gl, 3, arrays.around.values, 4);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  // triangles of the cloth first: the paper throws no shadow on it
  const ofCloth = [], ofPaper = [];
  for (let n = 0; n < triangles.length; n += 3) (cloth[triangles[n]] ? ofCloth : ofPaper).push(triangles[n], triangles[n + 1], triangles[n + 2]);
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint32Array.from([...ofCloth, ...ofPaper]), gl.STATIC_DRAW);
  gl.bindVertexArray(null);
  return { made, all: triangles.length, cloth: ofCloth.length };
}

/** A material on the GPU: the table of its BRDF, its largest value, shares of even light, and what a dye needs. */
export function uploadMaterial(gl, arrays, { sides, rings, turns, steps }) {
  const { codes, largest, shares, albedo, albedo_of_views, mean_albedo } = arrays;
  const values = summed(codes.values, sides * sides * turns * 3);
  const table = texture(gl, gl.TEXTURE_3D, gl.LINEAR, gl.REPEAT);
  const data = new Float32Array(turns * rings * sides * sides * 4);
  let from = 0;
  for (let ring = 0; ring < rings; ring++) {
    for (let u = 0; u < sides; u++) {
      for (let v = 0; v < sides; v++) {
        let to = 4 * turns * (ring + rings * (v + sides * u));
        for (let turn = 0; turn < turns; turn++, to += 4) {
          for (let c = 0; c < 3; c++) data[to + c] = values[from++] / steps;
        }
      }
    }
  }
  gl.texImage3D(gl.TEXTURE_3D, 0, gl.RGBA16F, turns, rings * sides, sides, 0, gl.RGBA, gl.FLOAT, data);
  const gloss = albedo && { albedo: wide(gl, albedo, 1, gl.REPEAT), mean: mean_albedo.values[0], views: albedo_of_views };
  return { table, largest: largest.values[0], shares, gloss };
}

/** A filtered texture of rows of one or three channels. */
function wide(gl, { values, shape: [rows, columns] }, channels, wrap) {
  const made = texture(gl, gl.TEXTURE_2D, gl.LINEAR, wrap), padded = new Float32Array(4 * rows * columns);
  for (let n = 0; n < rows * columns; n++) for (let c = 0; c < 3; c++) padded[4 * n + c] = values[channels * n + (c % channels)];
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, columns, rows, 0, gl.RGBA, gl.FLOAT, padded);
  return made;
}

/** Texture of the share of even light that a material sends to each view, and its mean (nishiki.render.cloth.models). */
export function sharesOf(gl, material, dye) {
  const name = `${dye}`;
  if (material.shown !== name) {
    if (material.shareTexture) gl.deleteTexture(material.shareTexture);
    const { values, shape } = dye ? material.gloss.views : material.shares;
    const sent = dye ? Float32Array.from({ length: 3 * values.length }, (_, n) => {
      const a = values[Math.floor(n / 3)];
      return Math.min(Math.max(a + (1 - a) * dye[n % 3], 0), 1);
    }) : values;
    const back = [0, 1, 2].map((c) => sent.filter((_, n) => n % 3 === c).reduce((sum, v) => sum + v, 0) / (sent.length / 3));
    Object.assign(material, { shown: name, shareTexture: wide(gl, { values: sent, shape }, 3, gl.CLAMP_TO_EDGE), back });
  }
  return { shares: material.shareTexture, back: material.back };
}

/** Rows of `width` integers, each the sum of the differences up to it, in the type of the differences. */
function summed(values, width) {
  for (let n = width; n < values.length; n++) values[n] += values[n - width];
  return values;
}

/** Rows of three and a fourth number. */
function four(values, fourth) {
  const out = new Int16Array((values.length / 3) * 4);
  for (let n = 0; n < values.length / 3; n++) out.set([values[3 * n], values[3 * n + 1], values[3 * n + 2], fourth(n)], 4 * n);
  return out;
}
