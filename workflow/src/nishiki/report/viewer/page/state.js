// What the page shows, as plain JSON; a bookmark is what differs from the first state, in the address after #.

export const MOST_LAMPS = 8;
export const LAMP = { azimuth_deg: 90, elevation_deg: 45, distance: null, radius_deg: 0.75, intensity: 1, illuminant: "D65" };

/** The state in which a scene opens. view: of the scene's kind. */
export const firstState = (view, language) => ({
  lamps: [{ ...LAMP }], ambient: 0.05, exposure: "auto", view, layer: "appearance", enhance: "none", strength: 0.5,
  compare: null, options: {}, note: "", language,
});

/** A copy that shares nothing. */
export const copy = (value) => JSON.parse(JSON.stringify(value));

/** Text after # that brings a state back; the language is left to who opens it. */
export function bookmark(state, first) {
  const { language, ...rest } = state;
  const changed = Object.entries(rest).filter(([key, value]) => JSON.stringify(value) !== JSON.stringify(first[key]));
  return changed.length ? encodeURIComponent(JSON.stringify(Object.fromEntries(changed), rounded)) : "";
}

const rounded = (key, value) => (typeof value === "number" ? Number(value.toPrecision(6)) : value);

/** The state of a bookmark: `first` where the text says nothing, or is none. */
export function fromBookmark(hash, first) {
  try {
    const changes = JSON.parse(decodeURIComponent(hash.replace(/^#/, "")));
    const known = Object.fromEntries(Object.entries(changes).filter(([key]) => key in first));
    return { ...copy(first), ...known };
  } catch {
    return copy(first);
  }
}
