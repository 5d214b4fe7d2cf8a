"""Compiled shading of a plane scene: body shading and Torrance-Sparrow, all lights, one pass over the pixels.

A light meets a pixel in two numbers only: the irradiance on the facet (diffuse) and the specular term D F G / cos_r.
Colour is linear in both, so that they are summed over the lights that share a spectrum and multiplied by the 3 x K
matrix of that spectrum once (Tominaga and Tanaka 2004, eq. 19, without its loop over wavelengths).

The work goes in blocks of BLOCK pixels of a row.  All intermediate values of a block lie in one flat float64 array, in
lanes of constant distance: the compiler can then prove that no store meets a later load and emits vector instructions.
Branches inside the loops over a block are selections, never early returns, for the same reason.  Every pixel sees the
same operations in the same order whatever the number of threads, so that the bytes do not depend on it.  The threads
are the caller's (`nishiki.threads`): a parallel region of the compiler's would double the time to compile.
All of it is one file, because the cache of the compiler watches only the file of the function that it has compiled.
"""

import numpy as np
from numba import njit

from nishiki.brdf.torrance_sparrow import MIRROR, phi_squared
from nishiki.render.plane.flags import COLOUR_MISSING, NORMAL_MISSING, OVERFLOW, TURNED_AWAY, UNUSABLE

BLOCK = 128  # pixels of a row
# Lanes of the block's scratch array, each BLOCK values long.
_NX, _NY, _NZ, _VX, _VY, _VZ, _COSR, _INVR = (k * BLOCK for k in range(8))
_LX, _LY, _LZ, _E = (k * BLOCK for k in range(8, 12))
_COSI, _PHI2, _FG, _X, _Y, _CONTRAST, _WD, _WS, _BETA, _INVG2 = (k * BLOCK for k in range(12, 22))
_SA, _SB, _SD = (k * BLOCK for k in range(22, 25))
_LEAVE, _ENTER, _SXX, _SXY, _SYY, _DX, _DY, _Q = (k * BLOCK for k in range(25, 33))
_EX, _EY, _LOSS = 33 * BLOCK, 34 * BLOCK, 35 * BLOCK
_LOBES = 36  # first of the lanes that hold beta, 1 / gamma^2 of each lobe
# A facet distribution below 2^-60 counts as 0, as in the scalar form.
_NEGLIGIBLE = 60.0
# Mean of x^8 over a uniform half space, weighted by the cosine, for a facet that faces the eye: 4 int (2u - 1) u^4 du.
_AMBIENT_SKIRT = 0.5375
_LN2_64 = np.log(2.0) / 64.0
_TWO_LN2 = 2.0 * np.log(2.0)
_FLOAT32_MAX = 3.4028234663852886e38
_METAL = 0.5 * MIRROR**2  # contrast of an index of refraction


@njit(cache=True, error_model="numpy")
def exp2_negative(e):
    """2^-e for 0 <= e <= 60, relative error below 4e-12, below 4e-14 for e < 40.

    Without a library call, which would stop vectorisation: for t = e ln 2 / 64 <= 0.65 the Taylor series of exp(-t) to
    t^13, then six squarings.
    """
    t = -e * _LN2_64
    p = 1.0 / 6227020800.0
    p = p * t + 1.0 / 479001600.0
    p = p * t + 1.0 / 39916800.0
    p = p * t + 1.0 / 3628800.0
    p = p * t + 1.0 / 362880.0
    p = p * t + 1.0 / 40320.0
    p = p * t + 1.0 / 5040.0
    p = p * t + 1.0 / 720.0
    p = p * t + 1.0 / 120.0
    p = p * t + 1.0 / 24.0
    p = p * t + 1.0 / 6.0
    p = p * t + 0.5
    p = p * t + 1.0
    p = p * t + 1.0
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    return p * p


@njit(cache=True, error_model="numpy")
def _load_normals(buf, normals, flags, n):
    """Load normals of a block into their lanes; a bad one (zero, NaN, not unit) becomes (0, 0, 1) and a flag."""
    for i in range(n):
        buf[_NX + i] = normals[i, 0]
        buf[_NY + i] = normals[i, 1]
        buf[_NZ + i] = normals[i, 2]
    bad = 0
    for i in range(n):
        x, y, z = buf[_NX + i], buf[_NY + i], buf[_NZ + i]
        good = abs(x * x + y * y + z * z - 1.0) < 0.02  # false for NaN
        buf[_NX + i] = x if good else 0.0
        buf[_NY + i] = y if good else 0.0
        buf[_NZ + i] = z if good else 1.0
        buf[_WD + i] = 0.0 if good else 1.0
        bad += 0 if good else 1
    for i in range(n):
        flags[i] = 0
    if bad > 0:
        for i in range(n):
            flags[i] = NORMAL_MISSING if buf[_WD + i] > 0.0 else 0


@njit(cache=True, error_model="numpy")
def _load_slopes(buf, slopes, n):
    """Covariance of the slopes in a block's pixels into their lanes; the largest sum of variances."""
    most = 0.0
    for i in range(n):
        xx, xy, yy = np.float64(slopes[i, 0]), np.float64(slopes[i, 1]), np.float64(slopes[i, 2])
        buf[_SXX + i] = xx
        buf[_SXY + i] = xy
        buf[_SYY + i] = yy
        most = max(most, xx + yy)
    return most


@njit(cache=True, error_model="numpy")
def _load_gloss(buf, labels, gloss, index, transmission, entering, n):
    """Gloss parameters of a block's regions into their lanes; `labels` is empty where all pixels are region 0."""
    if labels.shape[0] == 0:
        contrast = (index[0] - 1.0) * (index[0] + 1.0)
        for i in range(n):
            buf[_CONTRAST + i] = contrast
            buf[_ENTER + i] = entering[0]
            buf[_LOSS + i] = transmission[0]
        for m in range(gloss.shape[1]):
            value = gloss[0, m]
            for i in range(n):
                buf[(_LOBES + m) * BLOCK + i] = value
        return
    for i in range(n):
        buf[_CONTRAST + i] = (index[labels[i]] - 1.0) * (index[labels[i]] + 1.0)
        buf[_ENTER + i] = entering[labels[i]]
        buf[_LOSS + i] = transmission[labels[i]]
    for m in range(gloss.shape[1]):
        for i in range(n):
            buf[(_LOBES + m) * BLOCK + i] = gloss[labels[i], m]


@njit(cache=True, error_model="numpy")
def _load_shading(buf, shading, n):
    """Load (a, b, d) or (a, b, d, e_x, e_y) of a block's body shading into their lanes; the last two stay 0 else."""
    for i in range(n):
        buf[_SA + i] = shading[i, 0]
        buf[_SB + i] = shading[i, 1]
        buf[_SD + i] = shading[i, 2]
    if shading.shape[1] > 3:
        for i in range(n):
            buf[_EX + i] = shading[i, 3]
            buf[_EY + i] = shading[i, 4]


@njit(cache=True, error_model="numpy")
def _load_positions(buf, plane, row, column, n):
    """Positions on the plane of the samples (row, column + i): plane (3, 3) maps (column, row, 1) to (x, y, 1) w."""
    for i in range(n):
        c = np.float64(column + i)
        w = plane[2, 0] * c + plane[2, 1] * row + plane[2, 2]
        x = plane[0, 0] * c + plane[0, 1] * row + plane[0, 2]
        y = plane[1, 0] * c + plane[1, 1] * row + plane[1, 2]
        buf[_X + i] = x / w if w > 0.0 else 0.0
        buf[_Y + i] = y / w if w > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def _directions(buf, source, n):
    """Compute unit vectors to `source` (homogeneous, 4) from the block's positions into the lanes of the light."""
    sx, sy, sz, w = source[0], source[1], source[2], source[3]
    if w == 0.0:
        for i in range(n):
            buf[_LX + i] = sx
            buf[_LY + i] = sy
            buf[_LZ + i] = sz
        return
    for i in range(n):
        x, y = sx - buf[_X + i], sy - buf[_Y + i]
        inverse = 1.0 / np.sqrt(x * x + y * y + sz * sz)
        buf[_LX + i] = x * inverse
        buf[_LY + i] = y * inverse
        buf[_LZ + i] = sz * inverse


@njit(cache=True, error_model="numpy")
def _view_directions(buf, eye, n):
    _directions(buf, eye, n)
    for i in range(n):
        buf[_VX + i] = buf[_LX + i]
        buf[_VY + i] = buf[_LY + i]
        buf[_VZ + i] = buf[_LZ + i]


@njit(cache=True, error_model="numpy")
def _irradiance(buf, light, n):
    """Irradiance on a facet that faces the light (x, y, z, w, intensity, squared reference distance or 0)."""
    intensity, reference2 = light[4], light[5]
    if reference2 == 0.0:
        for i in range(n):
            buf[_E + i] = intensity
        return
    for i in range(n):
        x, y = light[0] - buf[_X + i], light[1] - buf[_Y + i]
        buf[_E + i] = intensity * reference2 / (x * x + y * y + light[2] * light[2])


@njit(cache=True, error_model="numpy")
def _view_cosines(buf, flags, n):
    for i in range(n):
        c = buf[_NX + i] * buf[_VX + i] + buf[_NY + i] * buf[_VY + i] + buf[_NZ + i] * buf[_VZ + i]
        buf[_COSR + i] = c
        buf[_INVR + i] = 1.0 / c if c > 0.0 else 0.0
    hidden = 0
    for i in range(n):
        hidden += 0 if buf[_COSR + i] > 0.0 else 1
    if hidden > 0:
        for i in range(n):
            if not buf[_COSR + i] > 0.0:
                flags[i] |= TURNED_AWAY


@njit(cache=True, error_model="numpy")
def _half_vector_terms(buf, widest, n):
    """phi^2 and F G / cos_r of a block for one light into their lanes; cos_i and whether any lobe is worth computing.

    Equal to `nishiki.brdf.torrance_sparrow.attenuation`, rewritten with four divisions and two roots a pixel.  With
    s = l + v:  sin^2(phi / 2) = |n x s|^2 / (2 |s| (|s| + n.s)),
    G / cos_r = min(1 / cos_r, 4 n.s min(1, cos_i / cos_r) / |s|^2),
    and with c = |s| / 2, m = n^2 - 1, g = sqrt(m + c^2) + c:
    F = 1/2 (m / g^2)^2 (1 + p^2),  p = (c g - 1) g / (c m + g).
    """
    near = 0
    for i in range(n):
        nx, ny, nz = buf[_NX + i], buf[_NY + i], buf[_NZ + i]
        c_i = nx * buf[_LX + i] + ny * buf[_LY + i] + nz * buf[_LZ + i]
        buf[_COSI + i] = c_i
        sx, sy, sz = buf[_LX + i] + buf[_VX + i], buf[_LY + i] + buf[_VY + i], buf[_LZ + i] + buf[_VZ + i]
        cx, cy, cz = ny * sz - nz * sy, nz * sx - nx * sz, nx * sy - ny * sx
        within = cx * cx + cy * cy + cz * cz <= widest * (sx * sx + sy * sy + sz * sz)
        near += 1 if (c_i > 0.0 and buf[_COSR + i] > 0.0 and within) else 0
    if near == 0:
        return False
    for i in range(n):
        nx, ny, nz = buf[_NX + i], buf[_NY + i], buf[_NZ + i]
        sx, sy, sz = buf[_LX + i] + buf[_VX + i], buf[_LY + i] + buf[_VY + i], buf[_LZ + i] + buf[_VZ + i]
        cx, cy, cz = ny * sz - nz * sy, nz * sx - nx * sz, nx * sy - ny * sx
        length2 = sx * sx + sy * sy + sz * sz
        length = np.sqrt(length2)
        c_i, c_r = buf[_COSI + i], buf[_COSR + i]
        both = c_i + c_r
        y = (cx * cx + cy * cy + cz * cz) / (2.0 * length * (length + both))
        y = y if y < 0.5 else 0.5
        buf[_PHI2 + i] = phi_squared(y)
        c = 0.5 * length
        c = c if c < 1.0 else 1.0
        contrast = buf[_CONTRAST + i]
        g = np.sqrt(contrast + c * c) + c
        ratio = contrast / (g * g)
        p = (c * g - 1.0) * g / (c * contrast + g)
        fresnel = 0.5 * ratio * ratio * (1.0 + p * p)
        inverse_r = buf[_INVR + i]
        slope = c_i * inverse_r
        groove = 4.0 * both * (slope if slope < 1.0 else 1.0) / length2
        bounded = groove if groove < inverse_r else inverse_r
        lit = c_i > 0.0 and c_r > 0.0
        buf[_FG + i] = fresnel * bounded if lit else 0.0
    return True


@njit(cache=True, error_model="numpy")
def _diffuse_cosines(buf, n):
    for i in range(n):
        buf[_COSI + i] = buf[_NX + i] * buf[_LX + i] + buf[_NY + i] * buf[_LY + i] + buf[_NZ + i] * buf[_LZ + i]


@njit(cache=True, error_model="numpy")
def _body_shading(buf, n):
    """Put c max(a + b c + d x^8 + e . l, 0) in the place of c, x = n . h (see `nishiki.brdf.torrance_sparrow`)."""
    for i in range(n):
        nx, ny, nz = buf[_NX + i], buf[_NY + i], buf[_NZ + i]
        sx, sy, sz = buf[_LX + i] + buf[_VX + i], buf[_LY + i] + buf[_VY + i], buf[_LZ + i] + buf[_VZ + i]
        c = buf[_COSI + i]
        along = nx * sx + ny * sy + nz * sz
        along = along if along > 0.0 else 0.0
        length2 = sx * sx + sy * sy + sz * sz
        x2 = along * along / (length2 if length2 > 1e-12 else 1e-12)
        x4 = x2 * x2
        factor = buf[_SA + i] + buf[_SB + i] * c + buf[_SD + i] * (x4 * x4)
        factor += buf[_EX + i] * buf[_LX + i] + buf[_EY + i] * buf[_LY + i]
        buf[_COSI + i] = c * (factor if factor > 0.0 else 0.0)


@njit(cache=True, error_model="numpy", inline="always")
def _passed(c, contrast):
    """1 - F, F exact as in `_half_vector_terms`, for a cosine c > 0."""
    g = np.sqrt(contrast + c * c) + c
    ratio = contrast / (g * g)
    p = (c * g - 1.0) * g / (c * contrast + g)
    return 1.0 - 0.5 * ratio * ratio * (1.0 + p * p)


@njit(cache=True, error_model="numpy")
def _leaving(buf, n):
    """Compute what the surface lets out towards the eye, relative to frontal (`torrance_sparrow.transmittance`)."""
    for i in range(n):
        c, contrast = buf[_COSR + i], buf[_CONTRAST + i]
        c = c if c > 1e-6 else 1e-6
        c = c if c < 1.0 else 1.0
        buf[_LEAVE + i] = 1.0 - buf[_LOSS + i] * (1.0 - _passed(c, contrast) / _passed(1.0, contrast))


@njit(cache=True, error_model="numpy")
def _transmit(buf, n):
    """Multiply the shading of the body by what the surface lets in and out; the cosine is formed anew from n and l."""
    for i in range(n):
        c = buf[_NX + i] * buf[_LX + i] + buf[_NY + i] * buf[_LY + i] + buf[_NZ + i] * buf[_LZ + i]
        contrast = buf[_CONTRAST + i]
        c = c if c > 1e-6 else 1e-6
        c = c if c < 1.0 else 1.0
        enter = 1.0 - buf[_LOSS + i] * (1.0 - _passed(c, contrast) / _passed(1.0, contrast))
        buf[_COSI + i] *= enter * buf[_LEAVE + i]


@njit(cache=True, error_model="numpy")
def _slope_offsets(buf, n):
    """Offset of the normal's slope from the half vector's, scaled to the length phi, and the square of that scale.

    The scale is phi over the length of the offset, so that a lobe without blur depends on phi alone. At the half vector
    itself it is n_z^3: an angle is n_z^2 of a step of slope along the tilt and n_z of one across it.
    """
    for i in range(n):
        nz = buf[_NZ + i]
        nz = nz if nz > 0.2 else 0.2
        sz = buf[_LZ + i] + buf[_VZ + i]
        sz = sz if sz > 1e-3 else 1e-3
        dx = buf[_NX + i] / nz - (buf[_LX + i] + buf[_VX + i]) / sz
        dy = buf[_NY + i] / nz - (buf[_LY + i] + buf[_VY + i]) / sz
        square = dx * dx + dy * dy
        q = buf[_PHI2 + i] / (square if square > 1e-12 else 1.0)
        q = q if square > 1e-12 else nz * nz * nz
        scale = np.sqrt(q)
        buf[_Q + i] = q
        buf[_DX + i] = dx * scale
        buf[_DY + i] = dy * scale


@njit(cache=True, error_model="numpy")
def _add_blurred_lobe(buf, lobe, n):
    """Add `_add_lobe` over slopes of covariance C: D is s^2 / sqrt(det(s^2 + C)) exp(-d (s^2 + C)^-1 d / 2)."""
    source = (_LOBES + 2 * lobe) * BLOCK
    for i in range(n):
        buf[_BETA + i] = buf[source + i]
    for i in range(n):
        buf[_INVG2 + i] = buf[source + BLOCK + i]
    for i in range(n):
        s2 = 1.0 / (buf[_INVG2 + i] * _TWO_LN2)
        q, dx, dy = buf[_Q + i], buf[_DX + i], buf[_DY + i]
        a, b, c = s2 + q * buf[_SXX + i], q * buf[_SXY + i], s2 + q * buf[_SYY + i]
        inverse = 1.0 / (a * c - b * b)
        e = (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) * inverse / _TWO_LN2
        d = exp2_negative(e if e < _NEGLIGIBLE else _NEGLIGIBLE) * s2 * np.sqrt(inverse)
        buf[_WS + i] += buf[_BETA + i] * (d if e < _NEGLIGIBLE else 0.0) * buf[_FG + i] * buf[_E + i]


@njit(cache=True, error_model="numpy")
def _add_lobe(buf, lobe, n):
    """beta D F G / cos_r of one lobe, times the irradiance, to the specular weight."""
    # to lanes of known distance first: loops over lanes of variable distance are not vectorised
    source = (_LOBES + 2 * lobe) * BLOCK
    for i in range(n):
        buf[_BETA + i] = buf[source + i]
    for i in range(n):
        buf[_INVG2 + i] = buf[source + BLOCK + i]
    for i in range(n):
        e = buf[_PHI2 + i] * buf[_INVG2 + i]
        d = exp2_negative(e if e < _NEGLIGIBLE else _NEGLIGIBLE)
        buf[_WS + i] += buf[_BETA + i] * (d if e < _NEGLIGIBLE else 0.0) * buf[_FG + i] * buf[_E + i]


@njit(cache=True, error_model="numpy")
def _add_light(buf, light, visibility, widest, shaded, blurred, lossy, n):
    """One light's diffuse and specular weights of a block, added to those of its group."""
    _directions(buf, light, n)
    _irradiance(buf, light, n)
    for i in range(visibility.shape[0]):
        buf[_E + i] *= visibility[i]
    if widest >= 0.0 and _half_vector_terms(buf, widest, n):
        lobes = (buf.shape[0] // BLOCK - _LOBES) // 2
        if blurred:
            _slope_offsets(buf, n)
        for lobe in range(lobes):
            if blurred:
                _add_blurred_lobe(buf, lobe, n)
            else:
                _add_lobe(buf, lobe, n)
    elif widest < 0.0:
        _diffuse_cosines(buf, n)
    if shaded:
        _body_shading(buf, n)
    if lossy:
        _transmit(buf, n)
    for i in range(n):
        c = buf[_COSI + i] if buf[_CONTRAST + i] < _METAL else 0.0
        buf[_WD + i] += (c if c > 0.0 else 0.0) * buf[_E + i]


@njit(cache=True, error_model="numpy")
def _flush(buf, total, sigma, matrix, offset, white, n):
    """Colour of a group: total_c += (sum_k A_ck sigma_k + offset_c) W_d + white_c W_s; clears the weights.

    Four coefficients at a time (their number is padded with zeros), to pass over the block less often.
    """
    for i in range(n):
        if buf[_CONTRAST + i] >= _METAL:  # its gloss has the colour of the coefficients
            buf[_WD + i] += buf[_WS + i]
            buf[_WS + i] = 0.0
    for c in range(total.shape[0]):
        base, gloss = offset[c], white[c]
        for k in range(0, sigma.shape[0], 4):
            a0, a1, a2, a3 = matrix[c, k], matrix[c, k + 1], matrix[c, k + 2], matrix[c, k + 3]
            s0, s1, s2, s3 = sigma[k], sigma[k + 1], sigma[k + 2], sigma[k + 3]
            out = total[c]
            for i in range(n):
                value = base + ((a0 * s0[i] + a1 * s1[i]) + (a2 * s2[i] + a3 * s3[i]))
                out[i] += value * buf[_WD + i] + gloss * buf[_WS + i]
            base, gloss = 0.0, 0.0
    for i in range(n):
        buf[_WD + i] = 0.0
        buf[_WS + i] = 0.0


@njit(cache=True, error_model="numpy")
def _load_colours(sigma, coefficients, n):
    """Coefficients of a block, one lane each.  One that is not finite shows in the total, and is looked for there."""
    for k in range(coefficients.shape[1]):
        lane = sigma[k]
        for i in range(n):
            lane[i] = coefficients[i, k]


@njit(cache=True, error_model="numpy")
def _store(buf, out, flags, total, sigma, n):
    """Totals to float32; what does not fit there, and what rests on missing input, becomes 0 (its flag says why)."""
    for i in range(n):
        buf[_WD + i] = 0.0
    for c in range(total.shape[0]):
        for i in range(n):
            value = abs(total[c, i])
            buf[_WD + i] = buf[_WD + i] if value <= buf[_WD + i] else value
    bad = 0
    for i in range(n):
        bad += 0 if buf[_WD + i] <= _FLOAT32_MAX else 1
    for i in range(n):
        bad += flags[i] & NORMAL_MISSING
    if bad > 0:
        _mark_bad(buf, flags, total, sigma, n)
    for c in range(total.shape[0]):
        line = total[c]
        for i in range(n):
            out[i, c] = np.float32(line[i])


@njit(cache=True, error_model="numpy")
def _mark_bad(buf, flags, total, sigma, n):
    for i in range(n):
        known = True
        for k in range(sigma.shape[0]):
            known = known and np.isfinite(sigma[k, i])
        if not known:
            flags[i] |= COLOUR_MISSING
        elif not buf[_WD + i] <= _FLOAT32_MAX:
            flags[i] |= OVERFLOW
        if flags[i] & UNUSABLE != 0:
            for c in range(total.shape[0]):
                total[c, i] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def shade(first, last, maps, finish, lamps, colours, view, pictures):
    """Fill rows first .. last - 1 of: sum over the lights of (A sigma + a0) E c f + white E beta D F G / cos_r.

    c = max(n.l, 0), f the factor of the body shading; of a metal (index MIRROR) A sigma E beta D G / cos_r. maps:
    normals (R, C, 3), coefficients (R, C, K), shading (R, C, 3
    or 5) or (0, 0, 0): f = 1, and slopes (R, C, 3), covariance of the slopes in a pixel, or (0, 0, 0): none, float32;
    labels (R, C) uint8 or (0, 0): all pixels row 0; finish: gloss (regions, 2 lobes): beta, 1 / gamma^2 of each lobe;
    index (regions,); transmission (regions,): share of the surface's loss that the body's light suffers, entering
    (regions,): what is left of ambient light on its way in; lights (L, 6): x, y, z, w, intensity, squared reference
    distance; group (L,) row of matrices (G, channels, K, padded with zeros to fours), offsets and whites (G, channels),
    in rising order; visibility (L, R, C) float32 or (0, 0, 0): all 1; plane (3, 3) maps (column, row, 1) to the plane;
    eye (4,) homogeneous; ambient: irradiance of group 0's uniform half space; widest: largest sin^2 phi at which a lobe
    counts, negative for a matte scene; out (R, C, channels) float32, flags (R, C) uint8.
    """
    normals, coefficients, shading, slopes, labels = maps
    (gloss, index, transmission, entering, widest), (lights, group, visibility) = finish, lamps
    (matrices, offsets, whites), (plane, eye, ambient), (out, flags) = colours, view, pictures
    columns = coefficients.shape[1]
    no_labels, no_visibility = np.empty(0, np.uint8), np.empty(0, np.float32)
    buf = np.zeros((_LOBES + gloss.shape[1]) * BLOCK)
    sigma = np.zeros((matrices.shape[2], BLOCK))
    whole = np.int64(BLOCK)  # a constant as an argument would have functions compiled for it alone
    total = np.empty((out.shape[2], BLOCK))
    positions, lossy = eye[3] != 0.0, transmission.max() > 0.0
    for j in range(lights.shape[0]):
        positions = positions or lights[j, 3] != 0.0
    # what is the same for all pixels is written to its lanes once
    _load_gloss(buf, no_labels, gloss, index, transmission, entering, whole)
    _view_directions(buf, eye, whole)
    for row in range(first, last):
        for start in range(0, columns, BLOCK):
            n = min(BLOCK, columns - start)
            end = start + n
            mark = flags[row, start:end]
            _load_normals(buf, normals[row, start:end], mark, n)
            if labels.shape[0] > 0:
                _load_gloss(buf, labels[row, start:end], gloss, index, transmission, entering, n)
            reach = widest
            if slopes.shape[0] > 0 and widest >= 0.0:
                reach += _NEGLIGIBLE * _TWO_LN2 * _load_slopes(buf, slopes[row, start:end], n)
            if shading.shape[0] > 0:
                _load_shading(buf, shading[row, start:end], n)
            _load_colours(sigma, coefficients[row, start:end], n)
            if positions:
                _load_positions(buf, plane, np.float64(row), start, n)
            if eye[3] != 0.0:
                _view_directions(buf, eye, n)
            _view_cosines(buf, mark, n)
            for i in range(n):
                buf[_WD + i] = ambient * 0.5 * (1.0 + buf[_NZ + i])
            if lossy:
                _leaving(buf, n)
                for i in range(n):
                    buf[_WD + i] *= buf[_ENTER + i] * buf[_LEAVE + i]
            if shading.shape[0] > 0:
                for i in range(n):
                    tilt = buf[_EX + i] * buf[_NX + i] + buf[_EY + i] * buf[_NY + i]
                    mean = buf[_SA + i] + (buf[_SB + i] + tilt) * (2.0 / 3.0) + buf[_SD + i] * _AMBIENT_SKIRT
                    buf[_WD + i] *= mean if mean > 0.0 else 0.0
            for c in range(total.shape[0]):
                for i in range(n):
                    total[c, i] = 0.0
            current = 0
            for j in range(lights.shape[0]):
                if group[j] != current:
                    _flush(buf, total, sigma, matrices[current], offsets[current], whites[current], n)
                    current = group[j]
                visible = visibility[j, row, start:end] if visibility.shape[0] > 0 else no_visibility
                _add_light(buf, lights[j], visible, reach, shading.shape[0] > 0, slopes.shape[0] > 0, lossy, n)
            _flush(buf, total, sigma, matrices[current], offsets[current], whites[current], n)
            _store(buf, out[row, start:end], mark, total, sigma, n)
