// Parts of shaders that the scenes of objects and of cloths share.

import { MOST_LAMPS } from "viewer/state";

/** One triangle over the whole of a framebuffer. */
export const SCREEN_VERTEX = `
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }`;

/** sRGB, IEC 61966-2-1. */
export const ENCODING = `
vec3 encoded(vec3 v) {
  return mix(1.055 * pow(max(v, 0.0031308), vec3(1.0 / 2.4)) - 0.055, 12.92 * v, vec3(lessThanEqual(v, vec3(0.0031308))));
}
vec3 decoded(vec3 v) {
  return mix(pow((max(v, 0.04045) + 0.055) / 1.055, vec3(2.4)), v / 12.92, vec3(lessThanEqual(v, vec3(0.04045))));
}
`;

/** Emphases of a picture that no eye would see; shaders know them by their numbers. */
export const ENHANCEMENTS = ["none", "specular", "curvature", "raking", "unsharp", "relief"];

/** Number of a state's enhancement. */
export const enhancementOf = ({ enhance }) => Math.max(ENHANCEMENTS.indexOf(enhance), 0);

/** What the enhancements do to a normal, to the light of the body and to the gloss. */
export const ENHANCE = `
uniform int enhance;            // number in ENHANCEMENTS
uniform float strength;         // 0 to 1
vec3 steepened(vec3 n, vec3 m) { // slopes against the direction m
  float along = dot(n, m);
  return normalize(along * m + (1.0 + 4.0 * strength) * (n - along * m));
}
float bodyShare() { return enhance == 1 ? 1.0 - 0.8 * strength : 1.0; }
float highlight(vec3 n, vec3 h) { return enhance == 1 ? 0.6 * strength * pow(max(dot(n, h), 0.0), 60.0) : 0.0; }
`;

/** Whether light of lamp n reaches a place that stands `lift` above the surface; see shadow_maps.js. */
export const REACHES = `
uniform mat4 toLamp[${MOST_LAMPS}];
uniform sampler2DArray shadows;
uniform float shadowBias;       // in depths of a map
float reaches(int n, vec3 lifted) {
  vec4 seen = toLamp[n] * vec4(lifted, 1);
  vec3 place = seen.xyz / seen.w * 0.5 + 0.5;
  if (any(lessThan(place.xy, vec2(0))) || any(greaterThan(place.xy, vec2(1)))) return 1.0;
  return textureLod(shadows, vec3(place.xy, n), 0.0).r < min(place.z, 1.0) - shadowBias ? 0.0 : 1.0;
}
`;
