// Shaders of the object's viewer. Texels lie in one atlas texture, tile beside tile; a pixel is one bilinear look-up
// among texels, each the encoded model plus its residual (nishiki.render.object.renderer).

const HEAD = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp isampler2D;
`;

/** Quads around triangles on the charts, one for each tile that a triangle is near to. */
export const SURFACE_VERTEX = `${HEAD}
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
export const SURFACE_FRAGMENT = `${HEAD}
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

const CAMERA = `
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
export const MESH_VERTEX = `${HEAD}${CAMERA}${TO_SCREEN}
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

export const DEPTH_FRAGMENT = `${HEAD}${PIXEL}
out vec4 result;
void main() {
  vec3 weights = overDepth();
  result = vec4(1.0 / (weights.x + weights.y + weights.z), 0, 0, 1);
}`;

export const COVERAGE_FRAGMENT = `${HEAD}
out vec4 result;
void main() { result = vec4(1); }`;

/** One triangle over the whole of a framebuffer. */
export const SCREEN_VERTEX = `${HEAD}
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }`;

/** How well a captured view sees each texel, 0..1 (nishiki.render.object.visibility). */
export const VISIBILITY_FRAGMENT = `${HEAD}${CAMERA}
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

export const ENCODING = `
vec3 encoded(vec3 v) {
  return mix(1.055 * pow(max(v, 0.0031308), vec3(1.0 / 2.4)) - 0.055, 12.92 * v, vec3(lessThanEqual(v, vec3(0.0031308))));
}
vec3 decoded(vec3 v) {
  return mix(pow((max(v, 0.04045) + 0.055) / 1.055, vec3(2.4)), v / 12.92, vec3(lessThanEqual(v, vec3(0.04045))));
}
`;

export const LAMPS = 8;

/** Texels as a camera sees them under the lamps: the encoded model plus the residual of the captured views around. */
export const texelFragment = (parts, srgb) => `${HEAD}${ENCODING}
#define PARTS ${parts}
#define LAMPS ${LAMPS}
uniform sampler2D positions, normals, diffuse, specular;
uniform sampler2D residual0[PARTS], residual1[PARTS], visible0, visible1;
uniform int views;              // that lend their residual: 0, 1 or 2
uniform vec2 weights;
uniform vec3 eye;
uniform int lamps, form[LAMPS]; // 0: at a place, 1: distant, 2: an irradiance over the normal
uniform vec3 lampVector[LAMPS], lampColour[LAMPS];
uniform float reference[LAMPS]; // distance at which a lamp at a place counts 1; 0: everywhere
uniform mat3 lampFrame;
uniform vec3 harmonics[9];
layout(location = 0) out vec4 result0;
#if PARTS > 1
layout(location = 1) out vec4 result1;
#endif
float alphaSquared(float y) {   // 4 asin(sqrt y)^2
  float y2 = y * y;
  float low = (3.9999998616316295 + y * 1.333368353707692) + y2 * (0.7096755135127832 + y * 0.47921577031967355);
  float high = (0.1619777507791828 + y * 0.8785672549192072) + y2 * (-1.0769357168334217 + y * 1.285807095824729);
  return y * (low + y2 * y2 * high);
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
  float cosR = dot(normal, view);
  vec3 body = vec3(0), gloss = vec3(0);
  for (int n = 0; n < lamps; n++) {
    vec3 light = lampVector[n];
    float strength = 1.0;
    if (form[n] == 0) {
      light -= position.xyz;
      float square = dot(light, light);
      light *= inversesqrt(square);
      if (reference[n] > 0.0) strength = reference[n] * reference[n] / square;
    }
    float cosI = dot(normal, light);
    vec3 lit = form[n] == 2 ? irradiance(normal) : vec3(max(cosI, 0.0) * strength);
    body += lampColour[n] * lit;
    vec3 bisector = light + view;
    float square = dot(bisector, bisector);
    vec3 off = normal - (square > 1e-30 ? bisector * inversesqrt(square) : vec3(0));
    float alpha2 = alphaSquared(min(0.25 * dot(off, off), 0.5));
    if (cosI > 0.0 && cosR > 0.0) {
      float ratio = 0.5 * alpha2 / (kd.w * kd.w);
      gloss += lampColour[n] * (ratio < 40.0 ? strength / max(cosR, 0.05) * exp(-ratio) : 0.0);
    }
  }
  body *= kd.rgb;
  gloss *= ks.rgb;
  vec2 share = views == 1 ? vec2(1, 0) : vec2(0);
  if (views == 2) {
    vec2 seen = vec2(texelFetch(visible0, at, 0).r, texelFetch(visible1, at, 0).r);
    vec2 part = weights * seen;
    share = min(seen.x, seen.y) >= 1.0 || part.x + part.y <= 1e-6 ? weights : part / (part.x + part.y);
  }
#if PARTS > 1
  result0 = vec4(code(body), 1);
  result1 = vec4(code(gloss), 1);
  if (views > 0) result1.rgb += share.x * texelFetch(residual0[1], at, 0).rgb;
  if (views > 1) result1.rgb += share.y * texelFetch(residual1[1], at, 0).rgb;
#else
  result0 = vec4(code(body + gloss), 1);
#endif
  if (views > 0) result0.rgb += share.x * texelFetch(residual0[0], at, 0).rgb;
  if (views > 1) result0.rgb += share.y * texelFetch(residual1[0], at, 0).rgb;
}`;

/** Pixels of the mesh: linear light and coverage of the appearance, or the colour of a layer. */
export const meshFragment = (parts, srgb) => `${HEAD}${ENCODING}${PIXEL}
#define PARTS ${parts}
uniform sampler2D texels[PARTS];
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
  result = vec4(0, 0, 0, layer == 4 ? -1 : 1);
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
  vec4 value = lookUp(texels[0], at, inside - vec2(corner));
  if (layer == 4) result = vec4(at, inside - vec2(corner));
  else if (layer == 3) result = vec4(normalize(value.xyz) * 0.5 + 0.5, 1);
  else if (layer == 2) result = vec4(vec3((dot(value, channel) - range.x) / (range.y - range.x)), 1);
  else if (layer == 1) result = vec4((value.rgb - range.x) / (range.y - range.x), 1);
  else {
    vec3 light = linear(value);
#if PARTS > 1
    light += linear(lookUp(texels[1], at, inside - vec2(corner)));
#endif
    result = vec4(clamp(light, 0.0, ceiling), 1);
  }
}`;

/** Lines of the cameras' positions. */
export const LINES_VERTEX = `${HEAD}${CAMERA}${TO_SCREEN}
layout(location = 0) in vec4 position; // and number of the camera
uniform float chosen;
out vec3 colour;
void main() {
  gl_Position = toScreen(position.xyz);
  colour = abs(position.w - chosen) < 0.75 ? vec3(1, 0.45, 0.05) : vec3(0.12, 0.3, 0.55);
}`;

export const LINES_FRAGMENT = `${HEAD}
in vec3 colour;
out vec4 result;
void main() { result = vec4(colour, 1); }`;

/** From linear light to the canvas, over an even background (nishiki.render.display.developed). At the object's edge the
 * light is carried on by one pixel (nishiki.render.object.pixels.extend) and weighted with the part that is covered. */
export const DISPLAY_FRAGMENT = `${HEAD}${ENCODING}
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
