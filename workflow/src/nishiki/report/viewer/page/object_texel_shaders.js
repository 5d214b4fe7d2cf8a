// Shaders of an object's texels, which lie in one atlas texture, tile beside tile: where they are, who sees them, and the encoded
// model plus its residual (nishiki.render.object.renderer).

import { ENCODING, ENHANCE, REACHES } from "viewer/common_shaders";
import { MOST_LAMPS } from "viewer/state";
import { CAMERA } from "viewer/object_shaders";

/** Quads around triangles on the charts, one for each tile that a triangle is near to. */
export const SURFACE_VERTEX = `
uniform sampler2D corners;      // six texels a triangle: position and row, normal and column of each corner
uniform int size, tilesAcross, atlasSize;
layout(location = 0) in ivec4 place; // triangle, tile, row and column of its cell
flat out int triangle;
flat out ivec2 firstTexel;      // of the tile, on its chart
flat out ivec2 origin;          // of the tile, in the atlas
vec4 corner(int n) {
  int at = place.x * 6 + n, width = textureSize(corners, 0).x;
  return texelFetch(corners, ivec2(at % width, at / width), 0);
}
void main() {
  vec2 a = vec2(corner(0).w, corner(1).w), b = vec2(corner(2).w, corner(3).w), c = vec2(corner(4).w, corner(5).w);
  triangle = place.x;
  firstTexel = place.zw * (size - 1);
  origin = ivec2(place.y / tilesAcross, place.y % tilesAcross) * size;
  vec2 low = clamp(floor(min(a, min(b, c))) - 1.0 - vec2(firstTexel), vec2(0), vec2(size));
  vec2 high = clamp(ceil(max(a, max(b, c))) + 2.0 - vec2(firstTexel), vec2(0), vec2(size));
  vec2 at = vec2(origin) + mix(low, high, vec2(gl_VertexID / 2, gl_VertexID % 2));
  gl_Position = vec4(at.yx / float(atlasSize) * 2.0 - 1.0, 0, 1);
}`;

/** Position and normal of every texel: those of the nearest triangle, continued past its border in its plane. */
export const SURFACE_FRAGMENT = `
uniform sampler2D corners;
uniform int size;
flat in int triangle;
flat in ivec2 firstTexel, origin;
layout(location = 0) out vec4 position;
layout(location = 1) out vec4 normal;
vec4 corner(int n) {
  int at = triangle * 6 + n, width = textureSize(corners, 0).x;
  return texelFetch(corners, ivec2(at % width, at / width), 0);
}
void main() {
  vec2 point = vec2(ivec2(gl_FragCoord.yx) - origin + firstTexel);
  vec4 p[3], n[3];
  vec2 q[3];
  for (int k = 0; k < 3; k++) {
    p[k] = corner(2 * k);
    n[k] = corner(2 * k + 1);
    q[k] = vec2(p[k].w, n[k].w);
  }
  vec2 ab = q[1] - q[0], ac = q[2] - q[0], ap = point - q[0];
  float det = ab.x * ac.y - ab.y * ac.x;
  vec3 plane = vec3(-1);        // barycentric, beyond the border too
  if (det != 0.0) {
    plane.yz = vec2(ap.x * ac.y - ap.y * ac.x, ab.x * ap.y - ab.y * ap.x) / det;
    plane.x = 1.0 - plane.y - plane.z;
  }
  vec3 nearest = plane;
  float square = 0.0;
  if (min(plane.x, min(plane.y, plane.z)) < 0.0) {
    square = 1e30;
    for (int k = 0; k < 3; k++) {
      int next = (k + 1) % 3;
      vec2 edge = q[next] - q[k];
      float along = dot(edge, edge) > 0.0 ? clamp(dot(point - q[k], edge) / dot(edge, edge), 0.0, 1.0) : 0.0;
      vec2 off = point - q[k] - along * edge;
      if (dot(off, off) < square) {
        square = dot(off, off);
        nearest = vec3(0);
        nearest[k] = 1.0 - along;
        nearest[next] = along;
      }
    }
  }
  if (square > 2.0) discard;
  vec3 at = nearest.x * p[0].xyz + nearest.y * p[1].xyz + nearest.z * p[2].xyz;
  if (square > 0.0 && det != 0.0) {
    vec3 x = p[1].xyz - p[0].xyz, y = p[2].xyz - p[0].xyz;
    float stretch = sqrt(length(cross(x, y)) / abs(det));
    vec2 part = plane.yz - nearest.yz;
    vec3 step = part.x * x + part.y * y;
    float longest = 1.5 * stretch * sqrt(square);
    at += step * min(1.0, longest / max(length(step), 1e-30));
  }
  position = vec4(at, 1);
  normal = vec4(normalize(nearest.x * n[0].xyz + nearest.y * n[1].xyz + nearest.z * n[2].xyz), 1);
  gl_FragDepth = min(square / 4.0, 1.0);
}`;

/** How well a captured view sees each texel, 0..1 (nishiki.render.object.pixels). */
export const VISIBILITY_FRAGMENT = `${CAMERA}
uniform sampler2D positions, normals, depths;
uniform vec3 eye;
out vec4 result;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 position = texelFetch(positions, at, 0);
  result = vec4(0);
  if (position.w == 0.0) return;
  float cosine = dot(normalize(eye - position.xyz), texelFetch(normals, at, 0).xyz);
  vec3 seen = project(position.xyz);
  if (cosine <= 0.0 || seen.z <= 0.0 || seen.x < -0.5 || seen.y < -0.5 ||
      seen.x > pictureSize.x - 0.5 || seen.y > pictureSize.y - 0.5) return;
  ivec2 last = ivec2(pictureSize) - 1, pixel = min(ivec2(seen.xy + 0.5), last);
  float deepest = 0.0;
  for (int r = max(pixel.y - 1, 0); r <= min(pixel.y + 1, last.y); r++) {
    for (int c = max(pixel.x - 1, 0); c <= min(pixel.x + 1, last.x); c++) {
      deepest = max(deepest, texelFetch(depths, ivec2(c, last.y - r), 0).r); // rows of a framebuffer run up
    }
  }
  float slope = sqrt(max(1.0 - cosine * cosine, 0.0)) / max(cosine, 0.05);
  float footprint = inversesqrt(abs(focal.x * focal.z));
  if (seen.z <= deepest + 1.5 * footprint * seen.z * (0.5 + slope)) result = vec4(min(cosine / 0.25, 1.0));
}`;

/** What a view's picture differs from the model at the texels that it sees; bicubic (R. Keys, IEEE ASSP 29, 1981). */
export const LENT_FRAGMENT = `${CAMERA}
uniform sampler2D positions, visible, picture, model;
out vec4 result;
float cubic(float x) {          // of a distance in pixels, with a slope of -0.75 at 1
  x = abs(x);
  return x < 1.0 ? (1.25 * x - 2.25) * x * x + 1.0 : x < 2.0 ? ((-0.75 * x + 3.75) * x - 6.0) * x + 3.0 : 0.0;
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy), last = ivec2(pictureSize) - 1;
  vec4 position = texelFetch(positions, at, 0);
  result = vec4(0);
  if (position.w == 0.0 || texelFetch(visible, at, 0).r == 0.0) return;
  vec2 place = project(position.xyz).xy, first = floor(place), part = place - first;
  for (int r = -1; r < 3; r++) {
    for (int c = -1; c < 3; c++) {
      vec3 value = texelFetch(picture, clamp(ivec2(first) + ivec2(c, r), ivec2(0), last), 0).rgb;
      result.rgb += cubic(part.x - float(c)) * cubic(part.y - float(r)) * value;
    }
  }
  result.rgb -= texelFetch(model, at, 0).rgb;
}`;

/** The triangles as a lamp sees them. */
export const SHADOW_VERTEX = `
uniform sampler2D corners;      // six texels a triangle
uniform mat4 toLamp;
void main() {
  int at = gl_VertexID * 2, width = textureSize(corners, 0).x;
  gl_Position = toLamp * vec4(texelFetch(corners, ivec2(at % width, at / width), 0).xyz, 1);
}`;

/** What one sample of the lamps' discs adds to the sums: codes of 8 bits hold 17 of them without rounding. */
const SAMPLE = 15;

/** Texels that are lit by one point of each lamp's disc, to be added up: four lamps a texture. */
export const LIT_FRAGMENT = `${REACHES}
uniform sampler2D positions, normals;
uniform int lamps;
uniform float lift;             // along the normal, in the unit of the object
layout(location = 0) out vec4 first;
layout(location = 1) out vec4 second;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 position = texelFetch(positions, at, 0);
  if (position.w == 0.0) discard;
  vec3 lifted = position.xyz + lift * texelFetch(normals, at, 0).xyz;
  vec4 low = vec4(0), high = vec4(0);
  for (int n = 0; n < lamps; n++) {
    float lit = reaches(n, lifted) * ${SAMPLE}.0 / 255.0;
    if (n < 4) low[n] = lit;
    else high[n - 4] = lit;
  }
  first = low;
  second = high;
}`;

/** Texels as a camera sees them under the lamps: the encoded model plus the residual of the captured views around. */
export const texelFragment = (srgb) => `${ENCODING}${ENHANCE}
#define LAMPS ${MOST_LAMPS + 1} // one more, for the even light beside the state's own
uniform sampler2D positions, normals, diffuse, specular;
uniform sampler2D plainNormals; // normals of the surface without its relief
uniform sampler2D residual0, residual1, visible0, visible1;
uniform int views;              // that lend their residual: 0, 1 or 2
uniform vec2 weights;
uniform vec3 eye;
uniform int lamps, form[LAMPS]; // 0: at a place, 1: distant, 2: an irradiance over the normal
uniform vec3 lampVector[LAMPS], lampColour[LAMPS];
uniform float reference[LAMPS]; // distance at which a lamp at a place counts 1; 0: everywhere
uniform sampler2D lit0, lit1;   // sums of LIT_FRAGMENT
uniform float samples;          // that they are of; 0: no lamp is shaded
uniform mat3 lampFrame;
uniform vec3 harmonics[9];
out vec4 result;
float alphaSquared(float y) {   // 4 asin(sqrt y)^2
  float y2 = y * y;
  float low = (3.9999998616316295 + y * 1.333368353707692) + y2 * (0.7096755135127832 + y * 0.47921577031967355);
  float high = (0.1619777507791828 + y * 0.8785672549192072) + y2 * (-1.0769357168334217 + y * 1.285807095824729);
  return y * (low + y2 * y2 * high);
}
float share(int n, ivec2 at) {  // of a lamp's disc that a texel sees
  if (samples == 0.0 || form[n] == 2) return 1.0;
  return (n < 4 ? texelFetch(lit0, at, 0)[n] : texelFetch(lit1, at, 0)[n - 4]) * 255.0 / (${SAMPLE}.0 * samples);
}
vec3 irradiance(vec3 normal) {
  vec3 n = lampFrame * normal;
  vec3 total = harmonics[0] + n.x * harmonics[1] + n.y * harmonics[2] + n.z * harmonics[3];
  total += n.x * n.y * harmonics[4] + n.y * n.z * harmonics[5] + n.z * n.x * harmonics[6];
  total += (n.x * n.x - n.y * n.y) * harmonics[7] + (3.0 * n.z * n.z - 1.0) * harmonics[8];
  return max(total, 0.0);
}
vec3 code(vec3 v) { return ${srgb ? "encoded(v)" : "v"}; }
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 position = texelFetch(positions, at, 0), kd = texelFetch(diffuse, at, 0), ks = texelFetch(specular, at, 0);
  if (position.w == 0.0) discard;
  vec3 normal = texelFetch(normals, at, 0).xyz, view = normalize(eye - position.xyz);
  if (enhance == 5) normal = steepened(normal, normalize(texelFetch(plainNormals, at, 0).xyz));
  float cosR = dot(normal, view);
  vec3 body = vec3(0), gloss = vec3(0), shine = vec3(0);
  for (int n = 0; n < lamps; n++) {
    vec3 light = lampVector[n];
    float level = 1.0;
    if (form[n] == 0) {
      light -= position.xyz;
      float square = dot(light, light);
      light *= inversesqrt(square);
      if (reference[n] > 0.0) level = reference[n] * reference[n] / square;
    }
    level *= share(n, at);
    float cosI = dot(normal, light);
    vec3 lit = form[n] == 2 ? irradiance(normal) : vec3(max(cosI, 0.0) * level * bodyShare());
    body += lampColour[n] * lit;
    vec3 bisector = light + view;
    float square = dot(bisector, bisector);
    vec3 off = normal - (square > 1e-30 ? bisector * inversesqrt(square) : vec3(0));
    float alpha2 = alphaSquared(min(0.25 * dot(off, off), 0.5));
    if (cosI > 0.0 && cosR > 0.0) {
      float slope = 1.0 + alpha2 / (4.0 * kd.w * kd.w);
      gloss += lampColour[n] * level / max(cosR, 0.05) / (slope * slope);
      if (form[n] < 2) shine += lampColour[n] * level * highlight(normal, bisector * inversesqrt(square));
    }
  }
  body *= kd.rgb;
  gloss = gloss * ks.rgb + shine;
  vec2 share = views == 1 ? vec2(1, 0) : vec2(0);
  if (views == 2) {
    vec2 seen = vec2(texelFetch(visible0, at, 0).r, texelFetch(visible1, at, 0).r);
    vec2 part = weights * seen;
    share = min(seen.x, seen.y) >= 1.0 || part.x + part.y <= 1e-6 ? weights : part / (part.x + part.y);
  }
  result = vec4(code(body + gloss), 1);
  if (views > 0) result.rgb += share.x * texelFetch(residual0, at, 0).rgb;
  if (views > 1) result.rgb += share.y * texelFetch(residual1, at, 0).rgb;
}`;
