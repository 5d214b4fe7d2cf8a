// The lamps: a pad that shows the half space above the object from its front, and the controls of the lamp chosen.
import { drawing, element, slider } from "viewer/dom";
import { illuminantControls, nameOf } from "viewer/illuminants";
import { LAMP, MOST_LAMPS } from "viewer/state";
import { text } from "viewer/texts";

const LOWEST = 3; // degrees of elevation
const [NEAREST, FARTHEST] = [0.6, 6]; // distance in lengths of the object; beyond it the lamp is at infinity
const INFINITE = FARTHEST + 0.1;

/** Direction of a point (x right, y up) of the unit disc: elevation 90 in its middle. */
export function directionAt(x, y) {
  const reach = Math.min(Math.hypot(x, y), Math.cos((LOWEST * Math.PI) / 180));
  const azimuth = (Math.atan2(y, x) * 180) / Math.PI;
  return { azimuth_deg: Math.round(10 * (azimuth < 0 ? azimuth + 360 : azimuth)) / 10, elevation_deg: Math.round((10 * Math.acos(reach) * 180) / Math.PI) / 10 };
}

/** Point of the unit disc where a lamp stands. */
export function pointOf({ azimuth_deg, elevation_deg }) {
  const reach = Math.cos((elevation_deg * Math.PI) / 180), azimuth = (azimuth_deg * Math.PI) / 180;
  return [reach * Math.cos(azimuth), reach * Math.sin(azimuth)];
}

/** The section "light". app: {state, manifest, lamp (index), change(), rebuild(), say(text)}. */
export function lampsSection(app) {
  const { state } = app;
  if (app.scene.offers.includes("captured lamps") && state.options.lighting !== "free") return capturedSection(app);
  app.lamp = Math.max(Math.min(app.lamp, state.lamps.length - 1), 0);
  const lamp = state.lamps[app.lamp], ambient = ambientControl(app);
  const add = element("button", { type: "button", onclick: () => {
    const opposite = lamp ? { azimuth_deg: (lamp.azimuth_deg + 180) % 360, illuminant: lamp.illuminant } : {};
    state.lamps.push({ ...LAMP, ...opposite });
    app.lamp = state.lamps.length - 1;
    app.rebuild();
  } }, text("lamp.add"));
  if (!lamp) return [add, ambient];
  const marks = drawing("g");
  const pad = drawing("svg", { class: "pad", viewBox: "-108 -108 216 216", tabindex: 0, role: "application", "aria-label": text("pad") },
    drawing("circle", { class: "sky", r: 100 }), ...[30, 60].map((e) => drawing("circle", { class: "ring", r: 100 * Math.cos((e * Math.PI) / 180) })), marks);
  const sliders = {};
  const place = (direction, spoken) => {
    Object.assign(state.lamps[app.lamp], direction);
    show();
    app.change();
    if (spoken) app.say(text("lamp.at", { azimuth: Math.round(lamp.azimuth_deg), elevation: Math.round(lamp.elevation_deg) }));
  };
  const show = () => {
    marks.replaceChildren(...state.lamps.map((each, k) => {
      const [x, y] = pointOf(each);
      return drawing("g", { class: "lamp", "aria-current": k === app.lamp, transform: `translate(${100 * x} ${-100 * y})`, "data-lamp": k },
        drawing("circle", { r: 8 }), drawing("text", {}, `${k + 1}`));
    }));
    sliders.azimuth?.show(state.lamps[app.lamp].azimuth_deg);
    sliders.elevation?.show(state.lamps[app.lamp].elevation_deg);
  };
  const at = (event) => {
    const box = pad.getBoundingClientRect(), radius = (box.width * 100) / 216;
    return [(event.clientX - box.left - box.width / 2) / radius, (box.top + box.height / 2 - event.clientY) / radius];
  };
  pad.addEventListener("pointerdown", (event) => {
    const mark = event.target.closest(".lamp");
    if (mark && Number(mark.dataset.lamp) !== app.lamp) {
      app.lamp = Number(mark.dataset.lamp);
      app.rebuild();
      return;
    }
    pad.setPointerCapture(event.pointerId);
    place(directionAt(...at(event)));
  });
  pad.addEventListener("pointermove", (event) => event.buttons && place(directionAt(...at(event))));
  pad.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-0.06, 0], ArrowRight: [0.06, 0], ArrowUp: [0, 0.06], ArrowDown: [0, -0.06] }[event.key];
    if (!step) return;
    event.preventDefault();
    const [x, y] = pointOf(state.lamps[app.lamp]);
    place(directionAt(x + step[0], y + step[1]), true);
  });
  app.showLamp = show; // the lamp is also dragged over the picture
  sliders.azimuth = slider(text("azimuth"), { low: 0, high: 360, step: 1, value: lamp.azimuth_deg, write: (v) => `${Math.round(v)}°`, change: (azimuth_deg) => place({ azimuth_deg }) });
  sliders.elevation = slider(text("elevation"), { low: LOWEST, high: 90, step: 1, value: lamp.elevation_deg, write: (v) => `${Math.round(v)}°`, change: (elevation_deg) => place({ elevation_deg }) });
  const set = (name) => (value) => {
    state.lamps[app.lamp][name] = value;
    app.change();
  };
  show();
  return [
    pad,
    element("div", { className: "buttons", role: "group", "aria-label": text("lamps") },
      state.lamps.map((each, k) => element("button", { type: "button", "aria-pressed": k === app.lamp, title: app.manifest.illuminants ? nameOf(each.illuminant) : "", onclick: () => ((app.lamp = k), app.rebuild()) }, text("lamp", { number: k + 1 }))),
      state.lamps.length < MOST_LAMPS && add,
      state.lamps.length > 1 && element("button", { type: "button", onclick: () => (state.lamps.splice(app.lamp, 1), app.rebuild()) }, text("lamp.remove"))),
    sliders.azimuth, sliders.elevation,
    ...(app.manifest.illuminants ? illuminantControls(app.manifest, lamp.illuminant, (illuminant, continued) => {
      state.lamps[app.lamp].illuminant = illuminant;
      if (continued) app.change();
      else app.rebuild();
    }) : [element("p", { className: "hint" }, text("lamps.white"))]),
    slider(text("intensity"), { low: 0, high: 3, step: 0.05, value: lamp.intensity, write: (v) => v.toFixed(2), change: set("intensity") }),
    app.scene.offers.includes("softness") && slider(text("softness"), { low: 0, high: 20, step: 0.25, value: lamp.radius_deg, write: (v) => `${v}°`, change: set("radius_deg") }),
    slider(text("distance"), { low: NEAREST, high: INFINITE, step: 0.1, value: lamp.distance ?? INFINITE, write: (v) => (v > FARTHEST ? text("distance.infinite") : text("distance.lengths", { length: v.toFixed(1) })),
      change: (v) => set("distance")(v > FARTHEST ? null : v) }),
    ambient,
    ...exposureControls(app),
  ].filter(Boolean);
}

/** Under the lamps of the capture nothing can be moved. */
function capturedSection(app) {
  const free = element("button", { type: "button", onclick: () => {
    app.state.options = { ...app.state.options, lighting: "free" };
    app.rebuild();
  } }, text("lamps.free"));
  return [element("p", { className: "hint" }, text("lamps.captured")), free, ...exposureControls(app)];
}

function ambientControl(app) {
  const { state } = app;
  return slider(text("ambient"), { low: 0, high: 0.5, step: 0.01, value: state.ambient, write: (v) => v.toFixed(2), change: (v) => ((state.ambient = v), app.change()) });
}

function exposureControls(app) {
  const { state } = app, offered = ["auto", "sheet"].find((kind) => app.scene.offers.includes(`exposure ${kind}`)), automatic = offered && state.exposure === "auto";
  const box = element("input", { type: "checkbox", checked: automatic, onchange: () => {
    state.exposure = box.checked ? "auto" : 1;
    app.rebuild();
  } });
  const parts = offered ? [element("label", { className: "row" }, box, text(`exposure.${offered}`))] : [];
  if (!automatic) parts.push(slider(text("exposure"), { low: -4, high: 4, step: 0.1, value: state.exposure === "auto" ? 0 : Math.log2(state.exposure), write: (v) => `${v > 0 ? "+" : ""}${v.toFixed(1)} EV`, change: (v) => ((state.exposure = Number((2 ** v).toPrecision(3))), app.change()) }));
  return parts;
}
