// Elements of the page, made from script.

const SVG = "http://www.w3.org/2000/svg";

/** An element with properties (names with a dash, and role: attributes), listeners (`on...`) and children. */
export function element(name, properties = {}, ...children) {
  return filled(document.createElement(name), properties, children);
}

/** An SVG element; all properties are attributes. */
export function drawing(name, attributes = {}, ...children) {
  return filled(document.createElementNS(SVG, name), attributes, children, true);
}

function filled(made, properties, children, attributes = false) {
  for (const [key, value] of Object.entries(properties)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (attributes || key.includes("-") || key === "role" || key === "for") made.setAttribute(key, value);
    else made[key] = value;
  }
  made.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return made;
}

/** A slider with its name and its value beside it. write: value to text. */
export function slider(text, { low, high, step, value, write = (v) => v, change }) {
  const shown = element("output", {}, `${write(value)}`);
  const input = element("input", {
    type: "range", min: low, max: high, step, value, "aria-label": text, "aria-valuetext": `${write(value)}`,
    oninput: () => {
      shown.value = `${write(Number(input.value))}`;
      input.setAttribute("aria-valuetext", shown.value);
      change(Number(input.value));
    },
  });
  const label = element("label", {}, element("span", { className: "with" }, text, shown), input);
  label.show = (v) => {
    input.value = v;
    shown.value = `${write(v)}`;
    input.setAttribute("aria-valuetext", shown.value);
  };
  return label;
}

/** A choice: options [[value, text]]. */
export function choice(text, options, value, change) {
  const select = element("select", { "aria-label": text, onchange: () => change(select.value) }, options.map(([key, shown]) => element("option", { value: key }, shown)));
  select.value = value;
  const label = element("label", {}, text, select);
  label.show = (v) => (select.value = v);
  return label;
}

/** A box to tick. */
export function tick(text, value, change) {
  const box = element("input", { type: "checkbox", checked: value, onchange: () => change(box.checked) });
  return element("label", { className: "row" }, box, text);
}

/** Call when what was drawn last is on the screen. */
export function afterPicture(call) {
  requestAnimationFrame(() => requestAnimationFrame(call));
}
