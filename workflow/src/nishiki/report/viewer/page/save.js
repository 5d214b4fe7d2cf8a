// Files that the page hands over: the picture that is seen, with its scale bar, and what it shows in its metadata.
import { scaleOf } from "viewer/overlay";
import { withTexts } from "viewer/png";
import { copy } from "viewer/state";
import { nameOf } from "viewer/illuminants";

/** Rules of the page for what is drawn over the picture, for a drawing that stands alone. */
function rules() {
  const own = [...document.styleSheets[0].cssRules].filter((rule) => rule instanceof CSSStyleRule && rule.selectorText.startsWith("#overlay "));
  return `svg{font:12px sans-serif;--mark:#f2c14e}${own.map(({ cssText }) => cssText.replaceAll("#overlay ", "")).join("")}`;
}

/** Offer a file to be saved. content: bytes or text. */
export function download(name, type, content) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

/** A sentence for each lamp, then for what else makes the picture. */
export function described({ scene, manifest }, state) {
  const { layer, enhance, strength, ambient, exposure, view } = state, shown = exposure === "auto" ? scene.exposureShown : exposure;
  const lamps = scene.offers.includes("captured lamps") && state.options.lighting !== "free" ? ["Lamp of the capture."] : state.lamps.map((lamp, k) => (
    `Lamp ${k + 1}: azimuth ${lamp.azimuth_deg} degrees from the right upwards, elevation ${lamp.elevation_deg} degrees, ${lamp.distance ? `distance ${lamp.distance} lengths of the object` : "distant"}, ${manifest.illuminants ? nameOf(lamp.illuminant) : "white"}, intensity ${lamp.intensity}.`));
  return [
    ...lamps, `Light from all around ${ambient}.`, typeof shown === "number" && `Exposure ${Number(shown.toPrecision(4))}.`,
    layer !== "appearance" && `Layer ${layer}.`, enhance !== "none" && `Enhancement ${enhance}, strength ${strength}: not what an eye would see.`,
    view.tilt_deg > 0 && `Tilted by ${Math.round(view.tilt_deg)} degrees towards azimuth ${Math.round(view.azimuth_deg)} degrees.`,
  ].filter(Boolean).join("\n");
}

/** Bytes of a PNG of the canvas and what is drawn over it. Beside another page: of this page's picture alone. */
export async function pictureOf(app, overlay) {
  await app.idle();
  const { scene, state, manifest, beside } = app, { canvas } = scene, { clientWidth, clientHeight } = canvas;
  const alone = copy({ ...state, compare: beside ? null : state.compare });
  if (beside) scene.draw(alone);
  const flat = Object.assign(document.createElement("canvas"), { width: canvas.width, height: canvas.height });
  const plane = flat.getContext("2d"), lines = overlay.cloneNode(true), style = document.createElementNS(lines.namespaceURI, "style");
  plane.drawImage(canvas, 0, 0);
  app.redraw();
  style.textContent = rules();
  lines.prepend(style);
  for (const [name, value] of Object.entries({ xmlns: lines.namespaceURI, width: canvas.width, height: canvas.height, viewBox: `0 0 ${clientWidth} ${clientHeight}` })) lines.setAttribute(name, value);
  const image = new Image();
  image.src = `data:image/svg+xml,${encodeURIComponent(new XMLSerializer().serializeToString(lines))}`;
  await image.decode();
  plane.drawImage(image, 0, 0, canvas.width, canvas.height);
  const blob = await new Promise((resolve) => flat.toBlob(resolve, "image/png"));
  const scale = scaleOf(app), { unit } = scene.bounds(), { compare, note, language, ...rest } = alone;
  return withTexts(new Uint8Array(await blob.arrayBuffer()), {
    Title: manifest.title, Description: described(app, alone), ...(note && { Comment: note }), Software: `Nishiki ${manifest.version}`, "Creation Time": new Date().toISOString(),
    Source: `Scene ${manifest.scene}, viewer ${manifest.key}`, ...(scale && unit && { "nishiki:scale": `${Number((1 / scale).toPrecision(6))} ${unit} a pixel` }),
    "nishiki:state": JSON.stringify(compare ? { ...rest, compare } : rest),
  });
}
