// Lamps of an object as a camera has them: those of the capture, fixed to the camera, or the state's own.
import { centreOf } from "viewer/cameras";
import { freeLamps } from "viewer/free_lamps";
import { add, apply, multiply, transpose } from "viewer/matrices";
import { MOST_LAMPS } from "viewer/state";

const TO_LAMP_FRAME = [[1, 0, 0], [0, -1, 0], [0, 0, -1]];
const [AT_A_PLACE, DISTANT, ENVIRONMENT] = [0, 1, 2];

/** Rows right, up and towards the camera. */
export const lampFrame = (camera) => multiply(TO_LAMP_FRAME, camera.rotation);

/** Whether a state's own lamps light the object. */
export const hasFreeLamps = (state) => state.options?.lighting === "free";

/** Vector from a point, whose own vector to the camera is `away`, towards the captured lamp. */
export function towardsCaptured(lighting, light, camera, away) {
  const vector = apply(transpose(lampFrame(camera)), lighting.vectors[light]);
  return lighting.kind === "camera" || lighting.kind === "position" ? add(away, vector) : vector;
}

/** Uniforms of the captured light. */
export function capturedUniforms({ lighting }, light, camera) {
  const frame = lampFrame(camera), vector = apply(transpose(frame), lighting.vectors[light]);
  const form = { environment: ENVIRONMENT, direction: DISTANT, position: AT_A_PLACE, camera: AT_A_PLACE }[lighting.kind];
  const place = form === AT_A_PLACE ? add(centreOf(camera), vector) : vector;
  const lamp = { form, vector: place, colour: [1, 1, 1], reference: form === AT_A_PLACE ? lighting.reference : 0 };
  const harmonics = form === ENVIRONMENT && lighting.harmonics[light].map((row) => {
    return row.length === 3 ? row : new Array(3).fill(row.reduce((a, b) => a + b, 0) / row.length);
  });
  return uniforms([lamp], frame, harmonics || none());
}

/** The state's own lamps, each with point `k` of its disc; see free_lamps.js. */
export function ownLamps({ centre, radius }, state, camera, k) {
  return freeLamps((state.lamps ?? []).slice(0, MOST_LAMPS), lampFrame(camera), centre, radius, k);
}

/** Uniforms of the state's own lamps and of its even light. */
export function freeUniforms(manifest, state, camera) {
  const lamps = ownLamps(manifest, state, camera, 0).map(({ near, vector, strength, distance }) => {
    return { form: near ? AT_A_PLACE : DISTANT, vector, colour: new Array(3).fill(strength), reference: near ? distance : 0 };
  });
  const harmonics = none();
  if (state.ambient) {
    harmonics[0] = new Array(3).fill(state.ambient);
    lamps.push({ form: ENVIRONMENT, vector: [0, 0, 0], colour: [1, 1, 1], reference: 0 });
  }
  return uniforms(lamps, lampFrame(camera), harmonics);
}

const none = () => new Array(9).fill([0, 0, 0]);
const DARK = { form: DISTANT, vector: [0, 0, 1], colour: [0, 0, 0], reference: 0 };

function uniforms(lamps, frame, harmonics) {
  const padded = Array.from({ length: MOST_LAMPS + 1 }, (_, n) => lamps[n] ?? DARK);
  return {
    lamps: lamps.length, form: padded.map((l) => l.form), lampVector: padded.map((l) => l.vector),
    lampColour: padded.map((l) => l.colour), reference: padded.map((l) => l.reference), lampFrame: frame, harmonics,
  };
}
