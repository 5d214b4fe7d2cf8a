// Colours of a painting under lamps of any spectrum, as the shader takes them.
import * as colour from "viewer/colour";

export class Colours {
  /** manifest: with the codes of colour, the basis of the spectra and the illuminants. */
  constructor(manifest) {
    this.manifest = manifest;
    this.spectra = new Map();
  }

  /** XYZ of a lamp's spectrum: {matrix (3, K), white}. */
  #spectrum(choice) {
    const key = JSON.stringify(choice);
    if (!this.spectra.has(key)) {
      const { manifest } = this, power = colour.powerOf(choice, manifest);
      const white = colour.whiteOf(power, manifest.cmf);
      const d65 = () => colour.whiteOf(colour.powerOf("D65", manifest), manifest.cmf);
      const matrix = manifest.basis
        ? colour.xyzMatrix(power, manifest.basis, manifest.cmf)
        : colour.product(colour.adaptation(d65(), white), colour.inverse(colour.srgbMatrix()));
      this.spectra.set(key, { matrix, white });
    }
    return this.spectra.get(key);
  }

  /** Uniforms for illuminants, the ambient light's last: linear sRGB of the display at this exposure, or XYZ where it is null. */
  uniforms(choices, exposure) {
    const { direction, mean, components } = this.manifest.code.colour;
    const first = this.#spectrum(choices[0]).white;
    const toDisplay = exposure === null
      ? [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
      : colour.product(colour.srgbMatrix(), colour.adaptation(first)).map((row) => row.map((value) => value * exposure));
    const colours = [], whites = [];
    for (const choice of choices) {
      const { matrix, white } = this.#spectrum(choice);
      const shown = colour.product(toDisplay, matrix);
      for (const vector of [direction, mean, ...components]) colours.push(...colour.apply(shown, vector));
      whites.push(...colour.apply(toDisplay, white));
    }
    return { colours: new Float32Array(colours), whites: new Float32Array(whites) };
  }
}
