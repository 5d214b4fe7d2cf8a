// What is shown: the appearance, an enhancement of it, or a layer with its legend.
import { choice, element, slider, tick } from "viewer/dom";
import { copy } from "viewer/state";
import { text } from "viewer/texts";

const RAKING_DEG = 10; // elevation of the lamp in raking light
const PRESETS = {
  plain: () => ({}),
  raking: (first, [lamp]) => ({ lamps: [{ ...first.lamps[0], ...lamp, elevation_deg: RAKING_DEG, distance: null }] }),
  specular: () => ({ enhance: "specular" }),
  unsharp: () => ({ enhance: "unsharp" }),
  relief: () => ({ enhance: "relief" }),
};
const BARS = { grey: "linear-gradient(to right,#000,#fff)", diverging: "linear-gradient(to right,#2166ac,#f7f7f7,#b2182b)" };

/** Buttons that bring the picture as it opens, in raking light, or enhanced; the view stays. What was captured under one lamp
 * opens under it, and is enhanced under lamps of its own. */
export function presets(app) {
  const { state, first, scene } = app, { lighting, ...others } = state.options;
  const offered = Object.entries(PRESETS).filter(([name]) => ["plain", "raking", ...scene.enhancements].includes(name));
  return element("div", { className: "buttons", role: "group", "aria-label": text("presets") }, offered.map(([name, made]) => {
    const options = scene.offers.includes("captured lamps") && name !== "plain" ? { ...others, lighting: "free" } : others;
    const { lamps, layer, enhance, strength } = first, wanted = { lamps, layer, enhance, strength, options, ...made(first, state.lamps) };
    const pressed = Object.entries(wanted).every(([key, value]) => JSON.stringify(state[key]) === JSON.stringify(value));
    return element("button", { type: "button", "aria-pressed": `${pressed}`, onclick: () => app.set(copy(wanted)) }, text(`preset.${name}`));
  }));
}

/** The section "layers" of a painting, an object or a cloth. */
export function layersSection(app) {
  const { state, scene } = app;
  const names = scene.layers().map(({ name, label_key }) => [name, text(label_key ?? `layer.${name}`)]);
  const parts = [choice(text("layer"), names, state.layer, (layer) => {
    state.layer = layer;
    app.rebuild();
  })];
  if (state.layer === "appearance") {
    parts.push(choice(text("enhance"), scene.enhancements.map((name) => [name, text(`enhance.${name}`)]), state.enhance, (enhance) => {
      state.enhance = enhance;
      app.rebuild();
    }));
    if (state.enhance !== "none") {
      parts.push(slider(text("strength"), { low: 0, high: 1, step: 0.05, value: state.strength, write: (v) => v.toFixed(2), change: (v) => ((state.strength = v), app.change()) }));
      parts.push(element("p", { className: "hint" }, text("enhance.hint")));
    }
  }
  const options = scene.options?.() ?? [], shown = (name) => state.options[name] ?? options.find((each) => each.name === name).value;
  for (const option of options) {
    if (!option.when || shown(option.when[0]) === option.when[1]) parts.push(optionControl(app, option));
  }
  return parts;
}

/** An option of the scene: {name, label_key, values: [[value, label_key]], value}, with `colour` a colour, with neither yes
 * or no; when: [other option, its value] that it depends on. */
function optionControl(app, { name, label_key, values, colour, value }) {
  const set = (chosen) => {
    app.state.options = { ...app.state.options, [name]: chosen };
    app.rebuild();
  };
  const shown = app.state.options[name] ?? value;
  if (colour) return element("label", {}, text(label_key), element("input", { type: "color", value: shown, "aria-label": text(label_key), onchange: (event) => set(event.target.value) }));
  if (!values) return tick(text(label_key), shown, set);
  return choice(text(label_key), values.map(([key, label]) => [key, text(label)]), shown, set);
}

/** The legend of the layer that is shown, in its place on the picture. */
export function showLegend(app, place) {
  const layer = app.scene.layers().find(({ name }) => name === app.state.layer);
  place.hidden = !layer || layer.name === "appearance";
  if (place.hidden) return;
  const bar = BARS[layer.map];
  const number = (value) => `${Number(value.toPrecision(3))}${layer.unit ? ` ${layer.unit}` : ""}`;
  const ends = bar ? [
    element("div", { className: "bar", style: `background:${bar}` }),
    element("div", { className: "ends" }, ...layer.range.map((value) => element("span", {}, number(value)))),
  ] : [element("div", {}, text(`legend.${layer.map}`))];
  place.replaceChildren(element("strong", {}, text(layer.label_key ?? `layer.${layer.name}`)), ...ends);
}
