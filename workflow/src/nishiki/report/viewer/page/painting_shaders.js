// Shaders of the painting. Shading follows nishiki.render.plane.kernel term by term.
import { ENHANCE } from "viewer/common_shaders";

/** What a shader of the tiles writes: the picture, codes of its luminance, or the normals. */
export const SHOWN = { display: 0, luminance: 1, normals: 2 };

/** A rectangle of the map: squares of two triangles each, lifted by the relief where RELIEF says so. */
export const TILE_VERTEX = `
uniform vec4 corners;       // left, top, right, bottom in pixels of the level
uniform int cells;          // squares along each side
uniform mat3x2 toClip;
uniform vec4 depth;         // of column, row, height and 1
#if RELIEF
uniform sampler2D relief;
uniform float reliefScale;  // its pixels to one of the level
uniform vec2 lift;
#endif
out vec2 at;                // column and row, in pixels of the level, 0 at the upper left corner

float height() {
#if RELIEF
  vec2 last = vec2(textureSize(relief, 0) - 1), place = clamp(at * reliefScale - 0.5, vec2(0.0), last);
  ivec2 low = ivec2(place), high = ivec2(min(place + 1.0, last));
  vec2 share = fract(place);
  float above = mix(texelFetch(relief, low, 0).r, texelFetch(relief, ivec2(high.x, low.y), 0).r, share.x);
  float below = mix(texelFetch(relief, ivec2(low.x, high.y), 0).r, texelFetch(relief, high, 0).r, share.x);
  return mix(above, below, share.y);
#else
  return 0.0;
#endif
}

void main() {
  int cell = gl_VertexID / 6, corner = gl_VertexID - 6 * cell;
  ivec2 unit = ivec2(cell % cells, cell / cells) + ivec2(50 >> corner & 1, 44 >> corner & 1); // columns 010011, rows 001101
  at = mix(corners.xy, corners.zw, vec2(unit) / float(cells));
  float h = height();
  gl_Position = vec4(toClip * vec3(at, 1.0), dot(depth, vec4(at, h, 1.0)), 1.0);
#if RELIEF
  gl_Position.xy += lift * h;
#endif
}`;

/** Neighbours whose mean the unsharp normals leave, in pixels of the level: within the border of a tile. */
const AROUND = [1, 3].flatMap((r) => [[r, 0], [-r, 0], [0, r], [0, -r], [r, r], [-r, r], [r, -r], [-r, -r]]);

/** GLSL that reads plane k of the tile: constant indices, because indices that vary cost a software rasteriser dearly. */
const plane = (k) => `values${Math.floor(k / 3)}.${"rgb"[k % 3]}`;
const repeat = (count, line) => Array.from({ length: count }, (_, k) => line(k)).join("\n  ");

/** The light of lamp j: of the body, and of the gloss. */
const colourOf = (j, chroma) => `vec3 body = colours[${j} * (CHROMA + 2) + 1]${Array.from({ length: chroma }, (_, k) => ` + colours[${j} * (CHROMA + 2) + ${2 + k}] * chroma${k}`).join("")};
    body = u * u * (u * colours[${j} * (CHROMA + 2)] + body);
    if (enhance == 3) body = mix(body, 0.6 * whites[${j}], strength);
    total += body * diffuse + whites[${j}] * specular;`;

/** Defines: PLANES, CHROMA, TERMS, SHADES (planes of the body shading), LAMPS, LOBES, REGIONS, BLURRED, SHADOWS. */
export const paintingFragment = ({ PLANES, CHROMA, SHADES, LAMPS, LOBES }) => `
uniform sampler2DArray planes;
uniform vec2 origin;             // of the tile with its border, in pixels of the level
uniform float side;
uniform vec2 size;               // of the level, pixels
uniform vec2 normalCode;         // width, fineness
uniform float top;               // of the code of Y^(1/3)
uniform vec2 chromaRange[CHROMA + 1];
#if TERMS > 0
uniform vec2 shadeRange[SHADES + 1];
uniform float shadeMean[5];
uniform float shadeAxes[5 * SHADES + 1];
#endif
uniform vec3 colours[(LAMPS + 1) * (CHROMA + 2)];  // of each lamp, then of the ambient light: along d, along m, each b
uniform vec3 whites[LAMPS + 1];
uniform vec4 lamps[LAMPS + 1];   // direction and 0, or position and 1
uniform vec4 powers[LAMPS + 1];  // intensity, squared reference distance or 0
uniform float ambient;
uniform float pitch;             // of the level's pixels
uniform vec3 toward;             // the eye
uniform float stride;            // pixels of the level between the neighbours whose slopes are compared
uniform float blur;              // variance of the slopes that a pixel of the screen sees, relative to a pixel of the map
uniform sampler2D gloss;         // a row a region: index, entering, transmission, -; then beta, 1 / gamma^2 of each lobe
#if SHADOWS
uniform sampler2DArray visibility;
uniform vec4 shadowPlace;        // scale and offset of its part of the map
#endif
uniform int shown;               // one of SHOWN
in vec2 at;
out vec4 result;
${ENHANCE}
const float LN2 = 0.6931471805599453;

vec4 codes(int layer, vec2 place) { return texture(planes, vec3((place - origin) / side, float(layer))); }

vec3 decodedNormal(vec2 code) {
  vec2 t = code * (255.0 / 127.0) - 1.0;
  vec2 s = normalCode.x * t * (normalCode.y + (1.0 - normalCode.y) * t * t);
  float square = dot(s, s);
  return vec3(2.0 * s, 1.0 - square) / (1.0 + square);
}

/** Raking light and the exaggerated relief show steeper slopes. */
vec3 steeper(vec3 n) { return enhance == 3 || enhance == 5 ? steepened(n, vec3(0, 0, 1)) : n; }

vec2 slopeAt(vec2 place) {
  vec3 n = steeper(decodedNormal(codes(0, clamp(place, vec2(0.5), size - 0.5)).rg));
  return n.xy / max(n.z, 0.2);
}

float phiSquared(float y) {
  // 4 asin(sqrt y)^2 on 0 .. 1/2: nishiki.brdf.torrance_sparrow, to float32
  float y2 = y * y, y4 = y2 * y2;
  float p0 = 4.0 + y4 * (0.3250831164332901 + y4 * (0.2514441746387976 + y4 * (19.258781271350873 + y4 * 6.833702363961254)));
  float p1 = 1.3333333333267587 + y4 * (0.24618257690874587 + y4 * (-0.5556335558766249 + y4 * -30.50231077668275));
  float p2 = 0.7111111123682597 + y4 * (0.19625960148637764 + y4 * (2.8864815084578845 + y4 * 33.05124433607288));
  float p3 = 0.45714276231185713 + y4 * (0.1438696148314901 + y4 * (-8.476775858093276 + y4 * -21.7341795331));
  return y * ((p0 + y * p1) + y2 * (p2 + y * p3));
}

float reflected(float c, float contrast) {
  float g = sqrt(contrast + c * c) + c;
  float ratio = contrast / (g * g);
  float p = (c * g - 1.0) * g / (c * contrast + g);
  return 0.5 * ratio * ratio * (1.0 + p * p);
}

float passed(float c, float contrast, float transmission) {
  return 1.0 - transmission * (1.0 - (1.0 - reflected(clamp(c, 1e-6, 1.0), contrast)) / (1.0 - reflected(1.0, contrast)));
}

float curve(float linear) {
  float v = clamp(linear, 0.0, 1.0);
  return v <= 0.0031308 ? 12.92 * v : 1.055 * pow(v, 1.0 / 2.4) - 0.055;
}

void main() {
  ${repeat(Math.ceil(PLANES / 3), (k) => `vec3 values${k} = codes(${k}, at).rgb;`)}
  int region = 0;
#if REGIONS > 0
  region = int(texelFetch(planes, ivec3(floor(at - origin), ${Math.floor(PLANES / 3)}), 0).${"rgb"[PLANES % 3]} * 255.0 + 0.5);
  if (region == 255) discard;
#endif
  vec3 n = decodedNormal(values0.rg);
  if (shown == ${SHOWN.normals}) {
    result = vec4(n * 0.5 + 0.5, 1.0);
    return;
  }
  n = steeper(n);
  vec2 here = n.xy / max(n.z, 0.2);
  if (enhance == 4) { // away from the mean of the normals around it
    vec3 around = vec3(0.0);
    ${AROUND.map(([x, y]) => `around += decodedNormal(codes(0, clamp(at + vec2(${x}, ${y}), vec2(0.5), size - 0.5)).rg);`).join("\n    ")}
    n = normalize(n + 4.0 * strength * (n - around / ${AROUND.length}.0));
    n.z = max(n.z, 0.05);
  }
  float u = values0.b * top;
  vec4 table = texelFetch(gloss, ivec2(0, region), 0);
  float contrast = (table.x - 1.0) * (table.x + 1.0);
  vec3 v = toward;
  float cosR = dot(n, v);
  float inverseR = cosR > 0.0 ? 1.0 / cosR : 0.0;
#if LOBES > 0
  ${repeat(LOBES, (k) => `vec2 lobe${k} = texelFetch(gloss, ivec2(${k + 1}, region), 0).xy;`)}
#endif
#if BLURRED && LOBES > 0
  vec3 spread = vec3(0.0);
  ${repeat(4, (k) => `{
    vec2 d = slopeAt(at + stride * vec2(${["1, 0", "-1, 0", "0, 1", "0, -1"][k]})) - here;
    spread += vec3(d.x * d.x, d.x * d.y, d.y * d.y);
  }`)}
  spread *= blur / 24.0;
  here = n.xy / max(n.z, 0.2);
#endif
#if TERMS > 0
  ${repeat(SHADES, (k) => `float shade${k} = mix(shadeRange[${k}].x, shadeRange[${k}].y, ${plane(3 + CHROMA + k)});`)}
  ${repeat(5, (m) => `float f${m} = shadeMean[${m}]${Array.from({ length: SHADES }, (_, k) => ` + shade${k} * shadeAxes[${5 * k + m}]`).join("")};`)}
#endif
  float leave = table.z > 0.0 ? passed(cosR, contrast, table.z) : 1.0;
  ${repeat(CHROMA, (k) => `float chroma${k} = mix(chromaRange[${k}].x, chromaRange[${k}].y, ${plane(3 + k)});`)}
  float gain = 1.0;
  if (enhance == 2) {
    vec2 bend = vec2(slopeAt(at + vec2(stride, 0)).x - slopeAt(at - vec2(stride, 0)).x, slopeAt(at - vec2(0, stride)).y - slopeAt(at + vec2(0, stride)).y);
    gain = clamp(1.0 + 6.0 * strength * (bend.x + bend.y), 0.3, 1.7);
  }
  vec3 total = vec3(0.0);
  float diffuse, specular;
  vec2 position = vec2(at.x - size.x / 2.0, size.y / 2.0 - at.y) * pitch;
  ${repeat(LAMPS, (j) => `{
    const int j = ${j};
    vec3 way = lamps[j].xyz - lamps[j].w * vec3(position, 0.0);
    float square = dot(way, way);
    vec3 l = way * inversesqrt(square);
    float e = powers[j].x * (powers[j].y > 0.0 ? powers[j].y / square : 1.0);
#if SHADOWS
    e *= texture(visibility, vec3(at / size * shadowPlace.xy + shadowPlace.zw, float(j))).r;
#endif
    float cosI = dot(n, l);
    float c = max(cosI, 0.0);
    vec3 s = l + v;
    float length2 = dot(s, s);
    specular = 0.0;
#if LOBES > 0
    if (cosI > 0.0 && cosR > 0.0) {
      vec3 x = cross(n, s);
      float len = sqrt(length2), both = cosI + cosR;
      float phi2 = phiSquared(min(dot(x, x) / (2.0 * len * (len + both)), 0.5));
      float fresnel = reflected(min(0.5 * len, 1.0), contrast);
      float fg = fresnel * min(4.0 * both * min(cosI * inverseR, 1.0) / length2, inverseR);
#if BLURRED
      vec2 d = here - s.xy / max(s.z, 1e-3);
      float apart = dot(d, d);
      float nz = max(n.z, 0.2);
      float q = apart > 1e-12 ? phi2 / apart : nz * nz * nz;
      d *= sqrt(q);
#endif
      float sum = 0.0;
#if BLURRED
      ${repeat(LOBES, (k) => `{
        float s2 = 1.0 / (lobe${k}.y * 2.0 * LN2);
        float a = s2 + q * spread.x, b = q * spread.y, cc = s2 + q * spread.z;
        float inverse = 1.0 / (a * cc - b * b);
        float exponent = (cc * d.x * d.x - 2.0 * b * d.x * d.y + a * d.y * d.y) * inverse / (2.0 * LN2);
        sum += lobe${k}.x * exp2(-exponent) * s2 * sqrt(inverse);
      }`)}
#else
      ${repeat(LOBES, (k) => `sum += lobe${k}.x * exp2(-phi2 * lobe${k}.y);`)}
#endif
      specular = sum * fg * e;
    }
#endif
    float w = c * e;
#if TERMS > 0
    float along = max(dot(n, s), 0.0);
    float x2 = along * along / max(length2, 1e-12), x4 = x2 * x2;
    w *= max(f0 + f1 * c + f2 * x4 * x4 + f3 * l.x + f4 * l.y, 0.0);
#endif
    if (table.z > 0.0) w *= passed(cosI, contrast, table.z) * leave;
    if (enhance == 1) {
      specular += e * highlight(n, s * inversesqrt(length2));
      w *= bodyShare();
    }
    diffuse = w * gain;
    if (contrast > 5e7) { diffuse = specular; specular = 0.0; } // a metal mirrors in its colour
    ${colourOf("j", CHROMA)}
  }`)}
  diffuse = gain * ambient * 0.5 * (1.0 + n.z) * table.y * leave;
  specular = 0.0;
#if TERMS > 0
  diffuse *= max(f0 + (f1 + f3 * n.x + f4 * n.y) * (2.0 / 3.0) + f2 * 0.5375, 0.0);
#endif
  { ${colourOf("LAMPS", CHROMA)} }
  if (shown == ${SHOWN.luminance}) {
    // total.y is the luminance: 16 bits of its logarithm
    float code = clamp((log2(max(total.y, 1e-6)) + 20.0) / 32.0, 0.0, 1.0) * 65535.0;
    float high = floor(code / 256.0);
    result = vec4(high / 255.0, floor(code - high * 256.0) / 255.0, 0.0, 1.0);
  } else {
    result = vec4(curve(total.r), curve(total.g), curve(total.b), 1.0);
  }
}`;

/** A data layer with its colours: grey, diverging or flags. */
export const LAYER_FRAGMENT = `
uniform sampler2D codes;
uniform vec2 size;
uniform int colouring;           // 0 grey, 1 diverging, 2 flags
uniform float nothing, scale;
in vec2 at;
out vec4 result;
void main() {
  vec2 extent = vec2(textureSize(codes, 0));
  float code = texelFetch(codes, ivec2(clamp(at / size * extent, vec2(0.0), extent - 1.0)), 0).r * 255.0;
  if (code > nothing - 0.5 && colouring != 2) { result = vec4(0.15, 0.13, 0.18, 1.0); return; }
  float value = clamp(code * scale, 0.0, 1.0);
  vec3 colour = vec3(value);
  if (colouring == 1) colour = value < 0.5 ? mix(vec3(0.1, 0.3, 0.7), vec3(0.95), value * 2.0) : mix(vec3(0.95), vec3(0.7, 0.15, 0.1), value * 2.0 - 1.0);
  if (colouring == 2) {
    int bits = int(code + 0.5);
    colour = vec3(0.12);
    for (int k = 0; k < 8; k++) if ((bits >> k & 1) == 1) colour += 0.55 * (0.5 + 0.5 * cos(6.2832 * (float(k) / 8.0 + vec3(0.0, 0.33, 0.67))));
  }
  result = vec4(colour, 1.0);
}`;
