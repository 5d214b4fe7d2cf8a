// Shaders of the cloth's viewer: nishiki.render.cloth on a mesh, with its BRDF from a table (render/cloth/scene.py).

import { ENCODING, ENHANCE, REACHES } from "viewer/common_shaders";
import { MOST_LAMPS } from "viewer/state";

/** Depth of the cloth as a lamp sees it. */
export const SHADOW_VERTEX = `
layout(location = 0) in vec3 place;
uniform mat4 toLamp;
void main() { gl_Position = toLamp * vec4(place, 1); }`;

export const CLOTH_VERTEX = `
layout(location = 0) in vec3 place;
layout(location = 1) in vec4 normal; // w: whether it is paper
layout(location = 2) in vec4 weft;
layout(location = 3) in vec4 around; // openness of front and back, and how far up the open directions point
uniform mat4 toScreen;
out vec3 at, towards, along;
out vec4 open;
flat out float paper;
void main() {
  gl_Position = toScreen * vec4(place, 1);
  at = place;
  towards = normal.xyz;
  along = weft.xyz;
  open = around;
  paper = normal.w;
}`;

/** What a pixel's point sends to the eye, or a layer of it. */
export const CLOTH_FRAGMENT = `
#define LAMPS ${MOST_LAMPS}
const float PI = 3.14159265358979;
const float FADES = 1.8;        // distance, in radii of the cloth, from which on the paper fades away
in vec3 at, towards, along;
in vec4 open;
flat in float paper;
uniform vec3 eye, centre;
uniform float radius;
uniform int layer;              // 0 appearance, 1 normals, 2 weft, 3 openness, 4 place, 5 reflectance of the first lamp
uniform int lamps;
uniform bool near[LAMPS];
uniform vec3 lampVector[LAMPS]; // unit vector to a distant lamp, or the place of a near one
uniform float lampStrength[LAMPS], reference[LAMPS]; // distance at which a near lamp has its strength
uniform float lift;             // along the normal, in the unit of the scene
uniform float above, below;     // radiance of the room
uniform vec3 back;              // share of even light that the cloth sends back, mean over views
uniform float reflectance, leastCosine; // of the paper; of the angle between normal and eye
uniform sampler3D table;
uniform int sides, rings, turns;
uniform float edge, largest;
uniform sampler2D shares;
uniform bool dyed;
uniform vec3 dye;
uniform sampler2D glossAlbedo;
uniform float meanAlbedo;
out vec4 result;

vec3 stored(vec3 i, vec3 o) {   // f times both cosines
  vec3 sum = i + o, apart = i - o;
  float twiceCosine = length(sum), twiceSine = length(apart);
  vec3 h = sum / twiceCosine, t = twiceSine > 1e-6 ? apart / twiceSine : vec3(1, 0, 0);
  float p = -1.0 / (1.0 + h.z), xy = h.x * h.y * p;
  vec3 x = vec3(1.0 + h.x * h.x * p, xy, -h.x), y = vec3(xy, 1.0 + h.y * h.y * p, -h.y);
  float turn = atan(dot(t, y), dot(t, x)) / (2.0 * PI);
  float ring = min(atan(twiceSine, twiceCosine) / max(atan(h.z, abs(t.z)), 1e-6), 1.0);
  vec2 q = h.xy / (abs(h.x) + abs(h.y) + h.z);
  vec2 square = (clamp(vec2(q.x + q.y, q.x - q.y) / edge, -1.0, 1.0) * 0.5 + 0.5) * float(sides - 1);
  float low = min(floor(square.y), float(sides - 2));
  vec3 here = vec3(turn + 0.5 / float(turns), 0, (square.x + 0.5) / float(sides));
  float row = ring * float(rings - 1) + 0.5, rows = float(rings * sides);
  here.y = (low * float(rings) + row) / rows;
  vec3 first = textureLod(table, here, 0.0).rgb;
  here.y = ((low + 1.0) * float(rings) + row) / rows;
  vec3 value = largest * mix(first, textureLod(table, here, 0.0).rgb, square.y - low);
  return value * value;
}
float azimuth(vec3 v) { return atan(v.y, v.x) / (2.0 * PI); }
float polar(vec3 v) { return atan(length(v.xy), v.z) / (PI / 2.0); }
float albedoOfGloss(vec3 v) {
  vec2 size = vec2(textureSize(glossAlbedo, 0));
  return textureLod(glossAlbedo, vec2(azimuth(v) + 0.5 / size.x, polar(v)), 0.0).r;
}
vec3 shareOf(vec3 v) {
  vec2 last = vec2(textureSize(shares, 0)) - 1.0;
  return textureLod(shares, (vec2(fract(azimuth(v)), polar(v)) * last + 0.5) / (last + 1.0), 0.0).rgb;
}
vec3 reflected(vec3 i, vec3 o) { // pi f cos theta_i
  if (paper > 0.5) return vec3(reflectance * i.z);
  vec3 value = PI * stored(i, o) / o.z;
  if (dyed) value += dye * i.z * (1.0 - albedoOfGloss(i)) * (1.0 - albedoOfGloss(o)) / max(1.0 - meanAlbedo, 1e-3);
  return value;
}
${ENHANCE}${REACHES}void main() {
  vec3 view = normalize(eye - at), face = normalize(cross(dFdx(at), dFdy(at)));
  if (dot(face, view) < 0.0) face = -face;                // towards the eye
  float side = gl_FrontFacing ? 1.0 : -1.0;
  vec3 n = normalize(towards) * side, t = along * side;
  if (dot(n, face) < 0.0) n = face;
  float facing = dot(n, view);
  if (facing < leastCosine) n = normalize(n + (leastCosine - facing) * view);
  t = normalize(t - dot(t, n) * n);
  mat3 frame = mat3(t, cross(n, t), n);
  vec3 outgoing = view * frame;
  outgoing.z = max(outgoing.z, 1e-4);
  float free = gl_FrontFacing ? open.x : open.y, up = gl_FrontFacing ? open.z : open.w;
  if (layer == 1) result = vec4(n * 0.5 + 0.5, 1);
  else if (layer == 2) result = vec4(t * 0.5 + 0.5, 1);
  else if (layer == 3) result = vec4(vec3(free), 1);
  else if (layer == 4) result = vec4(at, 1.0 + side);
  if (layer > 0 && layer < 5) return;
  vec3 light = vec3(0);
  for (int k = 0; k < lamps; k++) {
    vec3 d = lampVector[k];
    float level = lampStrength[k];
    if (near[k]) {
      d -= at;
      level *= reference[k] * reference[k] / dot(d, d);
      d = normalize(d);
    }
    vec3 incident = d * frame;
    if (incident.z <= 0.0) continue;
    vec3 value = reflected(incident, outgoing);
    if (layer == 5) {
      result = vec4(value / incident.z, incident.z);
      return;
    }
    if (paper < 0.5) value = bodyShare() * value + highlight(vec3(0, 0, 1), normalize(incident + outgoing));
    light += level * value * reaches(k, at + lift * n);
  }
  if (layer == 5) {
    result = vec4(0);
    return;
  }
  vec3 share = paper > 0.5 ? vec3(reflectance) : shareOf(outgoing), sent = paper > 0.5 ? vec3(reflectance) : back;
  light += mix(below, above, up) * share * free / (1.0 - min(sent, 0.95) * (1.0 - free));
  float faded = paper > 0.5 ? 1.0 - smoothstep(FADES, 2.0 * FADES, distance(at, centre) / radius) : 1.0;
  result = vec4(light, 1) * faded;
}`;

/** From linear light to the canvas, over white (nishiki.render.display.develop with its shoulder). */
export const DEVELOP_FRAGMENT = `
uniform sampler2D picture;
uniform float exposure;
uniform bool coded;             // the values are to be shown as they are
out vec4 result;
const vec3 LUMINANCE = vec3(0.2126, 0.7152, 0.0722);
const float START = 0.6;
${ENCODING}vec3 shoulder(vec3 linear) {
  float y = max(dot(linear, LUMINANCE), 0.0), t = max(y - START, 0.0) / (1.0 - START);
  float bent = y > START ? START + (1.0 - START) * t / (1.0 + t) : y;
  vec3 value = linear * (bent / max(y, 1e-12));
  float top = max(value.r, max(value.g, value.b));
  float grey = top > 1.0 ? (1.0 - bent) / max(top - bent, 1e-12) : 1.0;
  return bent + (value - bent) * clamp(grey, 0.0, 1.0);
}
void main() {
  vec4 value = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
  vec3 shown = coded ? value.rgb + (1.0 - value.a) : encoded(clamp(shoulder(value.rgb * exposure) + (1.0 - value.a), 0.0, 1.0));
  result = vec4(shown, 1);
}`;
