"""Decompositions, inverses and solutions of small symmetric matrices, for compiled loops.

A symmetric 3 x 3 matrix is given by its six different elements: [[a, b, c], [b, d, e], [c, e, f]]; numbers, or lanes
(`nishiki.lanes`) where there are no branches.
"""

from collections import namedtuple

from numba import njit

from nishiki.lanes import choose, root

Factors = namedtuple("Factors", "l10 l20 l30 l40 l21 l31 l41 l32 l42 l43 i0 i1 i2 i3 i4 positive")
"""Lower triangle L (unit diagonal) and 1 / D of the L D L^T of a 5 x 5 matrix; positive: whether all D > 0."""


@njit(cache=True, error_model="numpy")
def eigenvalues(a, b, c, d, e, f):
    """Compute the smallest and largest eigenvalue of [[a, b, c], [b, d, e], [c, e, f]]; numbers or lanes.

    Of the matrix less its mean, over its spread, and turned over where the two large ones lie closer together, the
    largest is the root of x^3 - 3 x = 2 h in [sqrt 3, 2], h in [0, 1] (O. K. Smith, Eigenvalues of a symmetric 3 x 3
    matrix, CACM 1961): by Newton's steps from a cubic in h. Where two lie close together (lights in a narrow cone) the
    roots of the cubic keep half of the digits: the smallest is taken from the matrix across the eigenvector of the
    largest, to a rounding of the largest.
    """
    mean = (a + d + f) / 3.0
    a, d, f = a - mean, d - mean, f - mean
    spread = root((a * a + d * d + f * f + (b * b + c * c + e * e) * 2.0) / 6.0)
    one_value = spread <= 0.0
    scale = 1.0 / choose(one_value, 1.0, spread)
    a, b, c, d, e, f = a * scale, b * scale, c * scale, d * scale, e * scale, f * scale
    half = (a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)) * 0.5
    sign = choose(half > 0.0, 1.0, -1.0)
    a, b, c, d, e, f, half = a * sign, b * sign, c * sign, d * sign, e * sign, f * sign, half * sign
    half = choose(half < 1.0, half, 1.0)
    x = ((half * 0.01966 - 0.08504) * half + 1.0 / 3.0) * half + 1.7320508
    for _ in range(3):
        square = x * x
        x = x - (x * (square - 3.0) - half * 2.0) / (square * 3.0 - 3.0)
    first = mean + spread * sign * x
    second = mean + spread * sign * _smaller_root(a, b, c, d, e, f, x)
    upright = sign > 0.0
    least, largest = choose(upright, second, first), choose(upright, first, second)
    return choose(one_value, mean, least), choose(one_value, mean, largest)


@njit(cache=True, error_model="numpy")
def _smaller_root(a, b, c, d, e, f, largest):
    """Compute the smallest eigenvalue of a symmetric matrix of trace 0 from its largest, far from the others."""
    # the eigenvector is across the rows of the matrix less the largest: the longest of their three products
    p, q, r = a - largest, d - largest, f - largest
    x, y, z = b * e - c * q, b * c - p * e, p * q - b * b
    square = x * x + y * y + z * z
    for u, v, w in ((q * r - e * e, c * e - b * r, b * e - c * q), (c * e - b * r, p * r - c * c, b * c - p * e)):
        size = u * u + v * v + w * w
        longer = size > square
        square = choose(longer, size, square)
        x, y, z = choose(longer, u, x), choose(longer, v, y), choose(longer, w, z)
    per_length = 1.0 / root(square)
    x, y, z = x * per_length, y * per_length, z * per_length
    sign = choose(z >= 0.0, 1.0, -1.0)
    k = -1.0 / (sign + z)
    s0, s1, s2 = 1.0 + sign * x * x * k, sign * x * y * k, 0.0 - sign * x
    t0, t1, t2 = x * y * k, sign + y * y * k, 0.0 - y
    h0, h1, h2 = a * s0 + b * s1 + c * s2, b * s0 + d * s1 + e * s2, c * s0 + e * s1 + f * s2
    g0, g1, g2 = a * t0 + b * t1 + c * t2, b * t0 + d * t1 + e * t2, c * t0 + e * t1 + f * t2
    ss, tt, st = s0 * h0 + s1 * h1 + s2 * h2, t0 * g0 + t1 * g1 + t2 * g2, t0 * h0 + t1 * h1 + t2 * h2
    apart = ss - tt
    return (ss + tt) * 0.5 - root(apart * apart * 0.25 + st * st)


@njit(cache=True, error_model="numpy")
def inverse(a, b, c, d, e, f):
    """Compute the six elements of the inverse of a symmetric positive 3 x 3 matrix, by L D L^T.

    Sums of squares over the pivots: its error grows with the condition, that of cofactors with the condition squared.
    """
    l10, l20 = b / a, c / a
    second = d - l10 * b
    l21 = (e - l20 * b) / second
    third = f - l20 * c - l21 * (e - l20 * b)
    k = l10 * l21 - l20
    return (
        1.0 / a + l10 * l10 / second + k * k / third,
        0.0 - l10 / second - k * l21 / third,
        k / third,
        1.0 / second + l21 * l21 / third,
        0.0 - l21 / third,
        1.0 / third,
    )


@njit(cache=True, error_model="numpy", forceinline=True)
def solve_by_cofactors(matrix, x, y, z):
    """Solve a symmetric 3 x 3 system by Cramer's rule: return the solution times the determinant, and that."""
    a, b, c, d, e, f = matrix
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    c11, c12, c22 = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * c00 + b * c01 + c * c02
    return (c00 * x + c01 * y + c02 * z, c01 * x + c11 * y + c12 * z, c02 * x + c12 * y + c22 * z, determinant)


@njit(cache=True, error_model="numpy", forceinline=True)
def factorise(diagonal, m10, m20, m30, m40, below):
    """Factorise a symmetric 5 x 5 matrix into L D L^T.

    diagonal: the five elements on it; m10 .. m40 the first column below it; below: (m21, m31, m41, m32, m42, m43).
    """
    m00, m11, m22, m33, m44 = diagonal
    m21, m31, m41, m32, m42, m43 = below
    i0 = 1.0 / m00
    l10, l20, l30, l40 = m10 * i0, m20 * i0, m30 * i0, m40 * i0
    d1 = m11 - l10 * m10
    m21, m31, m41 = m21 - l20 * m10, m31 - l30 * m10, m41 - l40 * m10
    i1 = 1.0 / d1
    l21, l31, l41 = m21 * i1, m31 * i1, m41 * i1
    d2 = m22 - l20 * m20 - l21 * m21
    m32, m42 = m32 - l30 * m20 - l31 * m21, m42 - l40 * m20 - l41 * m21
    i2 = 1.0 / d2
    l32, l42 = m32 * i2, m42 * i2
    d3 = m33 - l30 * m30 - l31 * m31 - l32 * m32
    m43 = m43 - l40 * m30 - l41 * m31 - l42 * m32
    i3 = 1.0 / d3
    l43 = m43 * i3
    d4 = m44 - l40 * m40 - l41 * m41 - l42 * m42 - l43 * m43
    positive = (m00 > 0.0) & (d1 > 0.0) & (d2 > 0.0) & (d3 > 0.0) & (d4 > 0.0)  # false for NaN
    return Factors(l10, l20, l30, l40, l21, l31, l41, l32, l42, l43, i0, i1, i2, i3, 1.0 / d4, positive)


@njit(cache=True, error_model="numpy", forceinline=True)
def substitute(m, r0, r1, r2, r3, r4):
    """Solve the equations that `factorise` has factorised for one right-hand side."""
    r1 = r1 - m.l10 * r0
    r2 = r2 - m.l20 * r0 - m.l21 * r1
    r3 = r3 - m.l30 * r0 - m.l31 * r1 - m.l32 * r2
    r4 = r4 - m.l40 * r0 - m.l41 * r1 - m.l42 * r2 - m.l43 * r3
    r4 = r4 * m.i4
    r3 = r3 * m.i3 - m.l43 * r4
    r2 = r2 * m.i2 - m.l32 * r3 - m.l42 * r4
    r1 = r1 * m.i1 - m.l21 * r2 - m.l31 * r3 - m.l41 * r4
    r0 = r0 * m.i0 - m.l10 * r1 - m.l20 * r2 - m.l30 * r3 - m.l40 * r4
    return r0, r1, r2, r3, r4
