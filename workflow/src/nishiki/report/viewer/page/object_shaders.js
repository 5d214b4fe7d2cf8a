// Shaders of an object's pixels: each is one bilinear look-up among texels (nishiki.render.object.renderer); see
// object_texel_shaders.js.

import { ENCODING } from "viewer/common_shaders";

/** From the object to a camera's picture. */
export const CAMERA = `
uniform mat3 rotation;          // world to camera
uniform vec3 translation;
uniform vec3 focal;             // of columns, skew, of rows
uniform vec2 principal, pictureSize; // columns, rows
uniform float distortion[5];    // Brown's k1, k2, p1, p2, k3
vec3 project(vec3 world) {      // column, row and depth
  vec3 seen = rotation * world + translation;
  vec2 at = seen.xy / seen.z;
  float square = dot(at, at);
  float radial = 1.0 + square * (distortion[0] + square * (distortion[1] + square * distortion[4]));
  float p1 = distortion[2], p2 = distortion[3];
  vec2 bent = at * radial + vec2(
    2.0 * p1 * at.x * at.y + p2 * (square + 2.0 * at.x * at.x),
    p1 * (square + 2.0 * at.y * at.y) + 2.0 * p2 * at.x * at.y);
  return vec3(focal.x * bent.x + focal.y * bent.y + principal.x, focal.z * bent.y + principal.y, seen.z);
}
`;

const TO_SCREEN = `
uniform vec2 depthRange;        // nearest and farthest depth of the object
vec4 toScreen(vec3 world) {
  vec3 at = project(world);
  vec2 ndc = (at.xy + 0.5) / pictureSize * 2.0 - 1.0;
  float near = depthRange.x, far = depthRange.y;
  float z = ((far + near) * at.z - 2.0 * far * near) / (far - near);
  return at.z > 0.0 ? vec4(ndc.x * at.z, -ndc.y * at.z, z, at.z) : vec4(0, 0, 2, 1);
}
`;

/** The triangles as a camera sees them. What a pixel shows is found from its centre, not from interpolated values:
 * rasterisers move corners to a grid that can be as coarse as 1/16 pixel. */
export const MESH_VERTEX = `${CAMERA}${TO_SCREEN}
uniform sampler2D corners;      // six texels a triangle: position and row, normal and column of each corner
uniform isampler2D charts;
flat out vec2 first;            // pixel of the first corner
flat out vec4 toWeights;        // from pixels to the weights of the other two
flat out vec3 depthsOfCorners;
flat out vec2 place0, place1, place2;
flat out int chart;
vec4 corner(int n) {
  int at = gl_VertexID / 3 * 6 + n, width = textureSize(corners, 0).x;
  return texelFetch(corners, ivec2(at % width, at / width), 0);
}
void main() {
  vec4 a = corner(0), b = corner(2), c = corner(4);
  vec3 p = project(a.xyz), q = project(b.xyz), r = project(c.xyz);
  gl_Position = toScreen(gl_VertexID % 3 == 0 ? a.xyz : gl_VertexID % 3 == 1 ? b.xyz : c.xyz);
  first = p.xy;
  vec2 x = q.xy - p.xy, y = r.xy - p.xy;
  float area = x.x * y.y - x.y * y.x;
  toWeights = vec4(y.y, -y.x, -x.y, x.x) / (area == 0.0 ? 1.0 : area);
  depthsOfCorners = vec3(p.z, q.z, r.z);
  place0 = vec2(a.w, corner(1).w);
  place1 = vec2(b.w, corner(3).w);
  place2 = vec2(c.w, corner(5).w);
  int triangle = gl_VertexID / 3;
  chart = texelFetch(charts, ivec2(triangle % 1024, triangle / 1024), 0).x;
}`;

const PIXEL = `
uniform vec2 pictureSize;
flat in vec2 first;
flat in vec4 toWeights;
flat in vec3 depthsOfCorners;
vec3 overDepth() {              // weights of the corners on the picture, over their depths
  vec2 off = vec2(gl_FragCoord.x - 0.5, pictureSize.y - 0.5 - gl_FragCoord.y) - first;
  vec2 part = vec2(dot(toWeights.xy, off), dot(toWeights.zw, off));
  return vec3(1.0 - part.x - part.y, part) / depthsOfCorners;
}
`;

export const DEPTH_FRAGMENT = `${PIXEL}
out vec4 result;
void main() {
  vec3 weights = overDepth();
  result = vec4(1.0 / (weights.x + weights.y + weights.z), 0, 0, 1);
}`;

export const COVERAGE_FRAGMENT = `
out vec4 result;
void main() { result = vec4(1); }`;

/** What a pixel shows as its tile and texel, for reading; other numbers are in the shader. */
export const PLACE_LAYER = 4;

/** Pixels of the mesh: linear light and coverage of the appearance, or the colour of a layer. */
export const meshFragment = (srgb) => `${ENCODING}${PIXEL}
uniform sampler2D texels;
uniform isampler2D grids, cells; // first cell, rows and columns of each chart; tile of each cell
uniform int size, tilesAcross, layer; // layer: 0 appearance, 1 values as they are, 2 greys, 3 normals, 4 tile and texel
uniform float ceiling;
uniform vec2 range;
uniform vec4 channel;
flat in vec2 place0, place1, place2;
flat in int chart;
out vec4 result;
vec4 lookUp(sampler2D source, ivec2 at, vec2 part) {
  vec4 upper = mix(texelFetch(source, at, 0), texelFetch(source, at + ivec2(1, 0), 0), part.y);
  vec4 lower = mix(texelFetch(source, at + ivec2(0, 1), 0), texelFetch(source, at + ivec2(1, 1), 0), part.y);
  return mix(upper, lower, part.x);
}
vec3 linear(vec4 value) {
  return ${srgb ? "decoded(value.rgb)" : "value.rgb"};
}
void main() {
  result = vec4(0, 0, 0, layer == ${PLACE_LAYER} ? -1 : 1);
  if (chart < 0) return;
  vec3 weights = overDepth();
  weights /= weights.x + weights.y + weights.z;
  vec2 texel = weights.x * place0 + weights.y * place1 + weights.z * place2;
  ivec3 grid = texelFetch(grids, ivec2(chart % 1024, chart / 1024), 0).xyz;
  float stride = float(size - 1);
  ivec2 cell = clamp(ivec2(floor(texel / stride)), ivec2(0), grid.yz - 1);
  int number = grid.x + cell.x * grid.z + cell.y;
  int tile = texelFetch(cells, ivec2(number % 1024, number / 1024), 0).x;
  if (tile < 0) return;
  vec2 inside = clamp(texel - vec2(cell) * stride, vec2(0), vec2(stride));
  ivec2 corner = min(ivec2(inside), ivec2(size - 2));
  ivec2 at = ivec2(tile % tilesAcross, tile / tilesAcross) * size + corner.yx;
  vec4 value = lookUp(texels, at, inside - vec2(corner));
  if (layer == ${PLACE_LAYER}) result = vec4(at, inside - vec2(corner));
  else if (layer == 3) result = vec4(normalize(value.xyz) * 0.5 + 0.5, 1);
  else if (layer == 2) result = vec4(vec3((dot(value, channel) - range.x) / (range.y - range.x)), 1);
  else if (layer == 1) result = vec4((value.rgb - range.x) / (range.y - range.x), 1);
  else result = vec4(clamp(linear(value), 0.0, ceiling), 1);
}`;

/** Lines of the cameras' positions. */
export const LINES_VERTEX = `${CAMERA}${TO_SCREEN}
layout(location = 0) in vec4 position; // and number of the camera
uniform float chosen;
out vec3 colour;
void main() {
  gl_Position = toScreen(position.xyz);
  colour = abs(position.w - chosen) < 0.75 ? vec3(1, 0.45, 0.05) : vec3(0.12, 0.3, 0.55);
}`;

export const LINES_FRAGMENT = `
in vec3 colour;
out vec4 result;
void main() { result = vec4(colour, 1); }`;

/** From linear light to the canvas, over an even background (nishiki.render.display.develop). At the object's edge the
 * light is carried on by one pixel (nishiki.render.object.pixels.extend) and weighted with the part that is covered. */
export const DISPLAY_FRAGMENT = `${ENCODING}
uniform sampler2D picture, coverage, overlay;
uniform float exposure, ceiling;
uniform vec3 background;        // linear
uniform bool coded, lined;      // the values are to be shown as they are; there are lines on top
out vec4 result;
vec4 at(ivec2 place) {
  bool inside = all(greaterThanEqual(place, ivec2(0))) && all(lessThan(place, textureSize(picture, 0)));
  return inside ? texelFetch(picture, place, 0) : vec4(0);
}
vec3 carriedOn(ivec2 place) {
  vec3 sum = vec3(0);
  float weight = 0.0;
  for (int y = -1; y <= 1; y++) {
    for (int x = -1; x <= 1; x++) {
      vec4 near = at(place + ivec2(x, y)), far = at(place + 2 * ivec2(x, y));
      if (near.a == 0.0) continue;
      float share = x == 0 || y == 0 ? 1.0 : 0.5;
      sum += share * (near.rgb + (far.a > 0.0 ? 0.5 * (near.rgb - far.rgb) : vec3(0)));
      weight += share;
    }
  }
  return weight > 0.0 ? clamp(sum / weight, 0.0, ceiling) : vec3(0);
}
void main() {
  ivec2 place = ivec2(gl_FragCoord.xy);
  vec4 value = at(place);
  float covered = texelFetch(coverage, place, 0).r;
  if (covered > 0.0 && value.a == 0.0) value.rgb = carriedOn(place);
  vec3 behind = background * (1.0 - covered);
  vec3 shown = coded ? mix(encoded(background), value.rgb, covered) :
    encoded(clamp(value.rgb * exposure * covered + behind, 0.0, 1.0));
  vec4 line = lined ? texelFetch(overlay, place, 0) : vec4(0);
  result = vec4(clamp(mix(shown, line.rgb / max(line.a, 1e-6), line.a), 0.0, 1.0), 1);
}`;
