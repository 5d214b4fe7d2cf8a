// The choice of a lamp's spectrum: a name of the manifest, a black body, or a table of the user's own.
import { choice, element, slider } from "viewer/dom";
import { text } from "viewer/texts";

const COOLEST = 1800, HOTTEST = 12000, USUAL = 3000; // K

/** Wavelengths in nm and powers of a text with two numbers a line; Error where it holds none. */
export function spectrumOf(content) {
  const rows = content.split(/\r?\n/).map((line) => line.trim().split(/[,;\t ]+/).map(Number)).filter((row) => row.length >= 2 && row.every(Number.isFinite));
  rows.sort((a, b) => a[0] - b[0]);
  const wide = rows.length > 1 && rows[0][0] <= 400 && rows.at(-1)[0] >= 700;
  if (!wide || rows.some((row) => row[1] < 0) || !rows.some((row) => row[1] > 0)) throw new Error(text("csv.wrong"));
  return { nm: rows.map((row) => row[0]), power: rows.map((row) => row[1]) };
}

/** Name of an illuminant as the page shows it. */
export function nameOf(illuminant) {
  if (typeof illuminant !== "string") return illuminant.kelvin ? `${illuminant.kelvin} K` : illuminant.csv.name ?? "CSV";
  return illuminant === "capture" ? text("illuminant.capture") : illuminant;
}

/** Controls of one lamp's spectrum. change(illuminant) */
export function illuminantControls(manifest, illuminant, change) {
  const kind = typeof illuminant === "string" ? illuminant : illuminant.kelvin ? "kelvin" : "csv";
  const names = Object.keys(manifest.illuminants).map((name) => [name, text(`illuminant.${name}`)]);
  const file = element("input", {
    type: "file", accept: ".csv,.txt", "aria-label": text("illuminant.csv"),
    onchange: async () => {
      try {
        change({ csv: { ...spectrumOf(await file.files[0].text()), name: file.files[0].name } });
      } catch (error) {
        problem.textContent = error.message;
      }
    },
  });
  const problem = element("p", { className: "hint", role: "alert" });
  const parts = [choice(text("illuminant"), [...names, ["kelvin", text("illuminant.kelvin")], ["csv", text("illuminant.csv")]], kind, (value) => {
    if (value === "csv") file.hidden = false;
    else change(value === "kelvin" ? { kelvin: USUAL } : value);
  }), file, problem];
  file.hidden = kind !== "csv";
  if (kind === "kelvin") parts.push(slider(text("temperature"), { low: COOLEST, high: HOTTEST, step: 50, value: illuminant.kelvin, write: (k) => `${k} K`, change: (kelvin) => change({ kelvin }, true) }));
  return parts;
}
