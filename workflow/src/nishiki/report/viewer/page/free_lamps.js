// The state's lamps in the frame of a scene, each with one point of its disc at a time.
import { add, apply, cross, normalised, scale, transpose } from "viewer/matrices";

export const SAMPLES = 16; // points of a lamp's disc
const GOLDEN = 2.399963229728653; // radians between points of a spiral that covers a disc evenly

/** Lamps for sample `k`: near, vector (unit vector to a distant lamp, or the place of a near one), shadow (the same for the
 * point of the disc), strength, and distance at which a near lamp has its strength.
 *
 * frame: rows right, up and towards the eye, in which the state's directions are; centre, radius: of what is lit. */
export function freeLamps(lamps, frame, centre, radius, k) {
  const reach = Math.sqrt((k + 0.5) / SAMPLES), angle = GOLDEN * k;
  return lamps.map((lamp) => {
    const [azimuth, elevation] = [lamp.azimuth_deg, lamp.elevation_deg].map((v) => (v * Math.PI) / 180);
    const seen = [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
    const towards = apply(transpose(frame), seen);
    const x = normalised(cross(Math.abs(towards[0]) < 0.6 ? [1, 0, 0] : [0, 1, 0], towards)), y = cross(towards, x);
    const near = lamp.distance !== null && lamp.distance !== undefined, distance = near ? 2 * radius * lamp.distance : 1;
    const wide = distance * Math.tan(((lamp.radius_deg ?? 0) * Math.PI) / 180) * reach;
    const off = add(scale(x, wide * Math.cos(angle)), scale(y, wide * Math.sin(angle)));
    const vector = near ? add(centre, scale(towards, distance)) : towards;
    return { near, vector, shadow: near ? add(vector, off) : normalised(add(towards, off)), strength: lamp.intensity ?? 1, distance };
  });
}
