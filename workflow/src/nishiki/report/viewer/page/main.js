// The page: one canvas; the pointer moves a painting's lamp, or turns an object.
import { Loader } from "viewer/loader";
import { ObjectScene } from "viewer/object";
import { Orbit } from "viewer/orbit";
import { Painting } from "viewer/painting";

const manifest = JSON.parse(document.getElementById("manifest").textContent);
const canvas = document.getElementById("canvas");
const state = {
  lamps: [{ azimuth_deg: 90, elevation_deg: 45, distance: null, radius_deg: 0.75, intensity: 1, illuminant: "D65" }],
  ambient: 0.05, exposure: "auto", view: { x: 0, y: 0, zoom: 1, tilt_deg: 0, azimuth_deg: 0 }, layer: "appearance",
  enhance: "none", strength: 0.5, compare: null, options: {}, note: "", language: "en",
};
canvas.width = innerWidth;
canvas.height = innerHeight;
const scenes = { painting: Painting, object: ObjectScene };
const scene = await scenes[manifest.chain].open(canvas, manifest, new Loader());
let asked = false;

function redraw() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => {
    asked = false;
    scene.draw(state, { x: 0, y: 0, width: canvas.width, height: canvas.height });
  });
}

scene.onready = redraw;
if (manifest.chain !== "painting") {
  canvas.tabIndex = 0;
  new Orbit(canvas, scene, () => state, (view) => {
    state.view = view;
    redraw();
  });
}
canvas.addEventListener("pointermove", (event) => {
  if (!event.buttons || manifest.chain !== "painting") return;
  const x = (2 * event.offsetX) / canvas.clientWidth - 1, y = 1 - (2 * event.offsetY) / canvas.clientHeight;
  const reach = Math.min(Math.hypot(x, y), 0.995);
  Object.assign(state.lamps[0], { azimuth_deg: (Math.atan2(y, x) * 180) / Math.PI, elevation_deg: (Math.acos(reach) * 180) / Math.PI });
  redraw();
});
addEventListener("resize", () => {
  canvas.width = innerWidth;
  canvas.height = innerHeight;
  redraw();
});
window.nishiki = {
  scene, state,
  set: (changes) => (Object.assign(state, changes), redraw()),
  idle: async () => {
    do await new Promise((resolve) => setTimeout(resolve, 20));
    while (asked || scene.busy);
  },
};
redraw();
