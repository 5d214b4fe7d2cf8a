"""Fit Lambert and one Torrance-Sparrow lobe by compiled variable projection: one width, linear strengths.

Left to the compiler, a sum is either added one by one (slow) or in an order of the compiler's choice, which differs
between a kernel just compiled and the same kernel loaded from the cache.  Here LANES partial sums, each over every
LANES-th product, are added in halves: the same bytes everywhere, on processors of any vector length.

A point has observations y_oc = K_d,c q_o + K_s,c a_o D(phi_o; gamma).  For a given gamma both strengths of a channel
are a 2 x 2 linear problem with K >= 0, so only log gamma is searched:

* a global grid of half widths with the ratio 2.  One step down is the fourth power, because D(phi; gamma / 2) =
  D(phi; gamma)^4: the whole grid costs one exponential an observation;
* then Gauss-Newton on the projected residual (Kaufman's Jacobian; Golub & Pereyra, Inverse Problems 19, 2003, R1),
  held inside the bracket by the sign of the exact derivative and replaced by bisection where it would leave it.

Sums over the observations are products of rows, fast and in a fixed order; everything else is element by element.  No
fast math: infinities and NaN keep their meaning, and results are the same bytes everywhere.
"""

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 8  # partial sums


@intrinsic
def dot_rows(_context, matrix, i, j):
    """sum over k of matrix[i, k] matrix[j, k]; matrix: C-contiguous, its columns a multiple of LANES (not checked)."""
    real = matrix.dtype

    def generate(context, builder, signature, arguments):
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        columns = cgutils.unpack_tuple(builder, array.shape)[1]
        vector = ir.VectorType(context.get_value_type(real), LANES)
        rows = [builder.gep(array.data, [builder.mul(row, columns)]) for row in arguments[1:]]
        total = cgutils.alloca_once(builder, vector)
        builder.store(ir.Constant(vector, None), total)
        index = columns.type
        steps = ir.Constant(index, 0), columns, ir.Constant(index, LANES)
        with cgutils.for_range_slice(builder, *steps, index) as (k, _):
            places = [builder.bitcast(builder.gep(row, [k]), vector.as_pointer()) for row in rows]
            values = [builder.load(place, align=real.bitwidth // 8) for place in places]
            builder.store(builder.fadd(builder.load(total), builder.fmul(*values)), total)
        return _in_halves(builder, builder.load(total))

    return real(matrix, types.intp, types.intp), generate


def _in_halves(builder, vector):
    """Sum a vector's elements: its upper half added to its lower, until one is left."""
    count = LANES
    while count > 1:
        count //= 2
        mask = ir.VectorType(ir.IntType(32), count)
        undefined = ir.Constant(vector.type, ir.Undefined)
        low, high = (
            builder.shuffle_vector(vector, undefined, ir.Constant(mask, list(range(first, first + count))))
            for first in (0, count)
        )
        vector = builder.fadd(low, high)
    return builder.extract_element(vector, ir.Constant(ir.IntType(32), 0))


GRID_RATIO = 2.0  # of neighbouring widths of the coarse search
REFINEMENTS = 24  # steps at most
_EXP2 = (  # 2^-f on 0 .. 1 interpolated at Chebyshev nodes, relative error 2.5e-9
    np.float32(0.9999999986201363),
    np.float32(-0.6931470452096826),
    np.float32(0.24022433120843853),
    np.float32(-0.05549093211490295),
    np.float32(0.009579859772968908),
    np.float32(-0.0012755401353185156),
    np.float32(0.00010932892393299026),
)
_E_MAX, _E_SCALE, _ZERO = np.float32(32), np.float32(1 / 32), np.float32(0)
_TWO_LN2 = float(2.0 * np.log(2.0))
_GRID_FLOOR = 1e-9  # D below it is 0 on the grid: its powers would end in slow subnormal numbers
# What is reported of a point, in this order
GAMMA, CURVATURE, RSS, RSS_DIFFUSE, USED, NEAREST, LIT, SCALE = range(8)
REPORT = 8  # figures a point, by their names above
# Rows of the scratch of a point, before one row for each channel's observations
_PHI2, _A, _Q, _D, _LOBE, _REST, _ONES, _ROWS = range(8)


@njit(cache=True, error_model="numpy")
def _lobe_values(w, inverse):
    """Row _D = 2^-(phi^2 inverse), inverse = 1 / gamma^2.

    float64: exp2.  float32: 2^-(e / 32) by polynomial, squared five times (relative error 2e-6), 0 beyond e = 32.
    """
    if w.itemsize == 4:
        for o in range(w.shape[1]):
            e = w[_PHI2, o] * inverse
            f = (e if e < _E_MAX else _E_MAX) * _E_SCALE
            p = _EXP2[4] + f * (_EXP2[5] + f * _EXP2[6])
            p = _EXP2[0] + f * (_EXP2[1] + f * (_EXP2[2] + f * (_EXP2[3] + f * p)))
            p *= p
            p *= p
            p *= p
            p *= p
            p *= p
            w[_D, o] = p if e < _E_MAX else _ZERO
    else:
        for o in range(w.shape[1]):
            w[_D, o] = np.exp2(-w[_PHI2, o] * inverse)


@njit(cache=True, error_model="numpy")
def _inverse_determinant(w, a, b, d):
    """1 / (a d - b^2), or 0 where the two columns are collinear within the rounding of w's type."""
    tolerance = w.dtype.type(1e-5) if w.itemsize == 4 else w.dtype.type(1e-12)
    det = a * d - b * b
    return 1 / det if det > tolerance * a * d else det - det


@njit(cache=True, error_model="numpy")
def _strengths(a, b, d, inverse, u, v, k0):
    """Non-negative least squares in two unknowns, relative to the fit by the diffuse column alone.

    The observations are y = y' + k0 q, k0 >= 0 the best strength of the diffuse column alone.  a, b, d: the products
    s.s, s.q, q.q of the lobe's and the diffuse column; u, v: s.y' and q.y'; inverse: of the determinant, 0 if
    collinear.  Returns K_s, K_d - k0, and what K_s takes off sum y'^2: a difference that no subtraction of large sums
    blurs.  If an unconstrained strength is negative the optimum lies where one is 0, and is the better of those two.
    """
    zero = a - a
    s = (d * u - b * v) * inverse
    t = (a * v - b * u) * inverse
    if inverse > 0 and s >= 0 and k0 + t >= 0:
        return s, t, s * u + t * v
    u_all = u + k0 * b
    s = u_all / a if u_all > 0 and a > 0 else zero
    gain = s * u_all - k0 * k0 * d
    if gain > 0:
        return s, -k0, gain
    return zero, zero, zero


@njit(cache=True, error_model="numpy")
def _grid_step(w, floor):
    """Row _LOBE = a D at this half width, and D to its fourth power for the next; returns (s.s, s.q)."""
    for o in range(w.shape[1]):
        d = w[_D, o]
        w[_LOBE, o] = w[_A, o] * d
        d *= d
        d *= d
        w[_D, o] = d if d > floor else floor - floor
    return dot_rows(w, _LOBE, _LOBE), dot_rows(w, _LOBE, _Q)


@njit(cache=True, error_model="numpy")
def _grid_search(w, channels, d, v, log_max, steps):
    """Index of the best half width of the grid, gamma_max / 2^index; of equally good ones the widest."""
    real = w.dtype.type
    margin = real(1.00001) if w.itemsize == 4 else real(1 + 1e-12)
    _lobe_values(w, real(np.exp(-2 * log_max)))
    best, index = real(-1), 0
    for step in range(steps):
        a, b = _grid_step(w, real(_GRID_FLOOR))
        if a <= 0:
            break
        inverse = _inverse_determinant(w, a, b, d)
        gain = real(0)
        for c in range(channels):
            u = dot_rows(w, _LOBE, _ROWS + c)
            gain += _strengths(a, b, d, inverse, u, v[0, c], v[1, c])[2]
        if gain > best * margin:
            best, index = gain, step
    return index


@njit(cache=True, error_model="numpy")
def _columns_at(w, inverse):
    """Row _D = the lobe's column s, row _LOBE = its derivative j by log gamma; returns s.s, s.q, j.j, j.s, j.q."""
    _lobe_values(w, inverse)
    rate = w.dtype.type(_TWO_LN2) * inverse
    for o in range(w.shape[1]):
        s = w[_A, o] * w[_D, o]
        w[_D, o] = s
        w[_LOBE, o] = s * w[_PHI2, o] * rate
    a, b = dot_rows(w, _D, _D), dot_rows(w, _D, _Q)
    return a, b, dot_rows(w, _LOBE, _LOBE), dot_rows(w, _LOBE, _D), dot_rows(w, _LOBE, _Q)


@njit(cache=True, error_model="numpy")
def _residual_products(w, row, kd, ks):
    """(residual . j, residual . residual) of one channel, from the residuals themselves: no cancellation."""
    for o in range(w.shape[1]):
        w[_REST, o] = w[row, o] - kd * w[_Q, o] - ks * w[_D, o]
    return dot_rows(w, _REST, _LOBE), dot_rows(w, _REST, _REST)


@njit(cache=True, error_model="numpy")
def _evaluate(w, channels, d, v, t, strengths):
    """Strengths at log gamma = t; returns (slope, curvature, rss) of the projected problem.

    slope: minus half the derivative of the sum of squares by t (exact); curvature: Kaufman's approximation of half the
    second derivative, sum_c K_s,c^2 |P j|^2 with j the lobe's derivative and P the projection off the active columns.
    """
    real = w.dtype.type
    a, b, jj, js, jq = _columns_at(w, real(np.exp(-2 * t)))
    inverse = _inverse_determinant(w, a, b, d)
    one_left = max(jj - js * js / a, real(0)) if a > 0 else real(0)
    both_left = one_left
    if inverse > 0:
        both_left = max(jj - (js * js * d - 2 * js * jq * b + jq * jq * a) * inverse, real(0))
    slope, curvature, rss = real(0), real(0), real(0)
    for c in range(channels):
        ks, kd, _ = _strengths(a, b, d, inverse, dot_rows(w, _D, _ROWS + c), v[0, c], v[1, c])
        along, square = _residual_products(w, _ROWS + c, kd, ks)
        kd += v[1, c]
        slope += ks * along
        rss += square
        curvature += ks * ks * (both_left if kd > 0 else one_left)
        strengths[c, 0] = ks
        strengths[c, 1] = kd
    return slope, curvature, rss


@njit(cache=True, error_model="numpy")
def _refine(w, channels, d, v, t, lo, hi, strengths):
    """Safeguarded Gauss-Newton in t = log gamma between lo and hi; leaves everything evaluated at the t it returns."""
    settled = 1e-3 if w.itemsize == 4 else 1e-9  # of the step before: what is left is far smaller
    moved = settled
    for k in range(REFINEMENTS + 1):
        slope, curvature, rss = _evaluate(w, channels, d, v, t, strengths)
        if moved < settled or k == REFINEMENTS or not (slope != 0 and curvature > 0):
            break
        if slope > 0:
            lo = t
        else:
            hi = t
        new = t + slope / curvature
        if not lo <= new <= hi:
            new = 0.5 * (lo + hi)
        moved = abs(new - t)
        t = new
    return t, curvature, rss


@njit(cache=True, error_model="numpy")
def _scale_row(w, row, weight_row):
    """Multiply a row by the roots of the weights and divide it by its mean absolute value, which is returned."""
    real = w.dtype.type
    for o in range(w.shape[1]):
        w[row, o] *= w[weight_row, o]
        w[_REST, o] = abs(w[row, o])
    total = dot_rows(w, _REST, _ONES)
    if not total > 0:
        return real(1)
    mean = total / real(w.shape[1])
    scale = 1 / mean
    for o in range(w.shape[1]):
        w[row, o] *= scale
    return mean


@njit(cache=True, error_model="numpy")
def _load(phi, amplitude, attenuation, diffuse, weights, w):
    """Copy one point into the scratch, with the roots of its weights in row _D; returns how many observations count.

    An observation in which any value is not finite, or whose weight is not positive, gets weight 0 and value 0.
    """
    w[:] = 0
    w[_ONES] = 1
    zero = w.dtype.type(0)
    observations, channels = amplitude.shape
    used = 0
    for o in range(observations):
        check = phi[o] + attenuation[o] + diffuse[o] + weights[o]
        for c in range(channels):
            check += amplitude[o, c]
        good = (check - check == zero) & (weights[o] > zero)
        used += good
        w[_D, o] = np.sqrt(weights[o]) if good else zero
        w[_PHI2, o] = phi[o] * phi[o] if good else zero
        w[_A, o] = attenuation[o] if good else zero
        w[_Q, o] = diffuse[o] if good else zero
        for c in range(channels):
            w[_ROWS + c, o] = amplitude[o, c] if good else zero
    return used


@njit(cache=True, error_model="numpy")
def _scale(w, channels):
    """Weight the columns and scale them to a mean of 1; returns the scales of the lobe, of q, and of the observations.

    The scaling makes the fit equivariant under any radiometric scale that the float type can hold.
    """
    top_a = _scale_row(w, _A, _D)
    top_q = _scale_row(w, _Q, _D)
    total = w.dtype.type(0)
    for c in range(channels):
        for o in range(w.shape[1]):
            w[_ROWS + c, o] *= w[_D, o]
            w[_REST, o] = abs(w[_ROWS + c, o])
        total += dot_rows(w, _REST, _ONES)
    top_y = total / w.dtype.type(w.shape[1] * channels) if total > 0 else w.dtype.type(1)
    inverse = 1 / top_y
    for c in range(channels):
        for o in range(w.shape[1]):
            w[_ROWS + c, o] *= inverse
    return top_a, top_q, top_y


@njit(cache=True, error_model="numpy")
def _deflate(w, row, d, v):
    """Take the best diffuse-only fit off a row: v = (q . what is left, its strength k0 >= 0)."""
    zero = w.dtype.type(0)
    product = dot_rows(w, _Q, row)
    k0 = product / d if product > 0 and d > 0 else zero
    for o in range(w.shape[1]):
        w[row, o] -= k0 * w[_Q, o]
    v[0] = dot_rows(w, _Q, row)
    v[1] = k0


@njit(cache=True, error_model="numpy")
def _summarise(w, channels, gamma, report):
    """Summarise the residual of the diffuse term, the observation nearest to the mirror direction, and the lit ones."""
    report[RSS_DIFFUSE] = 0
    for c in range(channels):
        report[RSS_DIFFUSE] += dot_rows(w, _ROWS + c, _ROWS + c)
    nearest, lit, limit = w.dtype.type(1e30), 0, 4 * gamma * gamma
    for o in range(w.shape[1]):
        phi2 = w[_PHI2, o] if w[_A, o] > 0 else w.dtype.type(1e30)
        nearest = phi2 if phi2 < nearest else nearest
        lit += phi2 < limit  # within two half widths: D above 1 / 16
    report[NEAREST], report[LIT] = np.sqrt(nearest), lit


@njit(cache=True, error_model="numpy")
def _solve_point(phi, amplitude, attenuation, diffuse, weights, log_min, log_max, w, v, pairs, report):
    """One point from load to report; pairs (channels, 2) receive K_s and K_d in the units of the observations."""
    channels = amplitude.shape[1]
    step = np.log(GRID_RATIO)
    report[USED] = _load(phi, amplitude, attenuation, diffuse, weights, w)
    top_a, top_q, top_y = _scale(w, channels)
    d = dot_rows(w, _Q, _Q)
    for c in range(channels):
        _deflate(w, _ROWS + c, d, v[:, c])
    index = _grid_search(w, channels, d, v, log_max, int(np.ceil((log_max - log_min) / step)) + 1)
    t = max(log_max - index * step, log_min)
    t, curvature, rss = _refine(w, channels, d, v, t, max(t - step, log_min), min(t + step, log_max), pairs)
    report[GAMMA], report[CURVATURE], report[RSS], report[SCALE] = np.exp(t), curvature, rss, top_y
    _summarise(w, channels, report[GAMMA], report)
    for c in range(channels):
        pairs[c, 0] *= top_y / top_a
        pairs[c, 1] *= top_y / top_q


@njit(cache=True, error_model="numpy", nogil=True)
def project_points(phi, amplitude, attenuation, diffuse, weights, log_min, log_max, strengths, reports):
    """Fit every point, releasing the interpreter's lock; all arrays C-contiguous of one float type.

    phi, attenuation, diffuse, weights: (points, observations); amplitude: (points, observations, channels).  Writes
    strengths (points, channels, 2), K_s then K_d, and reports (points, REPORT).  Sums of squares in a report are in
    units of the squared SCALE of the point.
    """
    points, observations, channels = amplitude.shape
    padded = (observations + LANES - 1) // LANES * LANES  # with zero columns
    w = np.empty((_ROWS + channels, padded), amplitude.dtype)
    v = np.empty((2, channels), amplitude.dtype)
    for p in range(points):
        _solve_point(
            phi[p], amplitude[p], attenuation[p], diffuse[p], weights[p], log_min, log_max,
            w, v, strengths[p], reports[p],
        )  # fmt: skip
