"""Body shading for the prediction of lamps: normal, terms and reflectance fitted again to all samples of a pixel.

The normals of the stage are to be near the surface's. What predicts a photograph best also carries what lamps share:
errors of their directions and strengths, and light from neighbouring facets. With 96 lamps the two agree; with 12 in a
narrow cone a selection that leaves out a third of the samples costs more prediction than it gains. So, for relighting
alone, the samples j of a pixel are fitted again by one of two models:

    plain        I_j = g . l_j along g, the shading normal n; then I_j = c_j (a + b c_j + d x_j^8)
    directional  the same n, with many lamps that of the stage; then I_j = c_j (a + b c_j + d x_j^8 + e . l_j), e
                 across the view: the pixel darkens towards the side from which its surroundings shade it

with c = max(n . l, 0), x = max(n . h, 0). All are linear. In `plain` and for the normal of `directional` weights are
Cauchy's, 1 / (1 + (r / 2.4 s)^2) with s from the median of |r| (P. W. Holland and R. E. Welsch, Robust regression using
iteratively reweighted least-squares, Communications in Statistics A 6 (9), 1977), so that cast shadows and highlights
lose their say but not the samples next to them; priors hold g to the normal of the stage and b and d to 0, the weaker
the more the samples scatter about the stage's fit. The terms of `directional` are least squares with next to no prior:
there the shadows are to be predicted. `nishiki.model_selection.relighting` chooses.
"""

from typing import NamedTuple

import numba
import numpy as np

from nishiki.errors import UserError
from nishiki.photometric.flags import FEW_LIGHTS
from nishiki.photometric.light_selection import half_vectors
from nishiki.photometric.refine import LEAST_FACTOR
from nishiki.small_matrices import solve_positive
from nishiki.threads import over_rows

MODELS = ("plain", "directional")
ROUNDS_NORMAL, ROUNDS_TERMS = 6, 3
TUNING = 2.4  # of Cauchy's weight, in standard deviations: 95 % efficiency for normal errors
NOISE = 0.003  # least standard deviation of a sample, relative to the reflectance
WIDTH_NORMAL, WIDTH_TERMS = 0.3, 0.25  # standard deviations expected of g - n and of b and d where samples scatter much
LEAST_PRIOR = 1e-4  # times a third of the number of lamps, as in `nishiki.photometric.solve`
ALONG = 0.1  # of the prior on g along z, which is the level and not a tilt
TERMS = {"plain": 3, "directional": 5}  # of the map `shading`
LARGEST = 1e30  # reflectance


class Relit(NamedTuple):
    """Hold what is fitted of each pixel, float32: (pixels, 3), (pixels, terms), (pixels, channels)."""

    shading_normals: np.ndarray
    shading: np.ndarray
    reflectance: np.ndarray


class Work(NamedTuple):
    """Hold arrays that the fits of a strip's pixels share."""

    matrix: np.ndarray  # (terms, terms)
    residual: np.ndarray  # (lights,)
    scratch: np.ndarray  # (lights,)
    weight: np.ndarray  # (lights,) of the last fit


def fit_relighting(observations, directions, normals, *, valid, scatter, reflectance, shading, model="plain"):
    """Shading normals, body shading and reflectance that predict lamps.

    Parameters
    ----------
    observations : (lights, rows, columns, channels) float32, relative to white.
    directions : (lights, 3) float, unit vectors to the lamps.
    normals : (rows, columns, 3) float32, unit, to start from.
    valid : (lights, rows, columns) bool, samples that may be used; pixels without any keep what they came with.
    scatter : (rows, columns) float, rms of the residuals of the normals' fit relative to the albedo.
    reflectance, shading : (rows, columns, channels), (rows, columns, 3) float32, kept where nothing can be fitted.
    model : one of MODELS.

    Returns
    -------
    dict of float32 arrays: shading_normals (rows, columns, 3), shading (rows, columns, 3; 5 of the model directional),
    reflectance.

    Raises
    ------
    UserError where shapes do not fit.
    """
    lights, rows, columns, channels = observations.shape
    shape = (rows, columns)
    if valid.shape != (lights, *shape) or normals.shape != (*shape, 3) or len(directions) != lights:
        raise UserError(
            f"relighting: observations {observations.shape} do not fit valid {valid.shape}, normals {normals.shape} "
            f"and {len(directions)} directions"
        )
    pixels = rows * columns
    fitted = Relit(
        np.array(normals, np.float32, order="C").reshape(pixels, 3).copy(),
        np.zeros((pixels, TERMS[model]), np.float32),
        np.array(reflectance, np.float32, order="C").reshape(pixels, channels).copy(),
    )
    fitted.shading[:, :3] = np.reshape(shading, (pixels, 3))
    over_rows(
        _fit,
        pixels,
        np.ascontiguousarray(observations, np.float32).reshape(lights, pixels, channels),
        np.ascontiguousarray(valid).reshape(lights, pixels),
        np.ascontiguousarray(directions, np.float64),
        half_vectors(np.asarray(directions, np.float64)),
        np.ascontiguousarray(scatter, np.float64).reshape(pixels),
        fitted,
    )
    return {name: values.reshape(*shape, -1) for name, values in fitted._asdict().items()}


@numba.njit(cache=True, error_model="numpy")
def middle(values, count):
    """Median of the first `count` values, which are sorted in place (by insertion: they are few)."""
    for i in range(1, count):
        value, j = values[i], i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value
    return 0.5 * (values[(count - 1) // 2] + values[count // 2])


@numba.njit(cache=True, error_model="numpy")
def _shading_basis(g, directions, halves, basis):
    """Rows (c, c^2, c x^8) or (c, c^2, c x^8, c l_x, c l_y) of every lamp, for the normal along g."""
    length = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    for j in range(len(directions)):
        c = (g[0] * directions[j, 0] + g[1] * directions[j, 1] + g[2] * directions[j, 2]) / length
        x = (g[0] * halves[j, 0] + g[1] * halves[j, 1] + g[2] * halves[j, 2]) / length
        c, x = c if c > 0.0 else 0.0, x if x > 0.0 else 0.0
        basis[j, 0], basis[j, 1], basis[j, 2] = c, c * c, c * x**8
        for k in range(3, basis.shape[1]):
            basis[j, k] = c * directions[j, k - 3]


@numba.njit(cache=True, error_model="numpy", inline="always")
def _shade(basis, terms, j):
    total = 0.0
    for i in range(terms.size):
        total += basis[j, i] * terms[i]
    return total


@numba.njit(cache=True, error_model="numpy")
def _reweigh(level, allowed, basis, terms, work):
    """Cauchy's weights of the lit samples; lit means that the fit lights them."""
    residual, scratch, weight = work.residual, work.scratch, work.weight
    lit = 0
    for j in range(level.size):
        shade = _shade(basis, terms, j)
        weight[j] = 1.0 if allowed[j] and shade > 0.0 else 0.0
        residual[j] = abs(level[j] - (shade if shade > 0.0 else 0.0))
        if weight[j] > 0.0:
            scratch[lit] = residual[j]
            lit += 1
    if lit == 0:
        return
    rest = lit - terms.size + 1.0
    freedom = np.sqrt(lit / (rest if rest > 1.0 else 1.0))
    scale = TUNING * (1.4826 * middle(scratch, lit) * freedom + NOISE)
    for j in range(level.size):
        weight[j] /= 1.0 + (residual[j] / scale) ** 2


@numba.njit(cache=True, error_model="numpy")
def _least_squares(level, weight, basis, first, held, matrix, terms):
    """Terms of level = basis . terms by weighted least squares with the prior `held` about `first`; False: none."""
    for i in range(terms.size):
        total = held[i] * first[i]
        for j in range(level.size):
            total += weight[j] * basis[j, i] * level[j]
        terms[i] = total
        for k in range(i + 1):
            total = held[i] if i == k else 0.0
            for j in range(level.size):
                total += weight[j] * basis[j, i] * basis[j, k]
            matrix[i, k] = total
    return solve_positive(matrix, terms)


@numba.njit(cache=True, error_model="numpy")
def _robust_fit(level, allowed, basis, first, held, rounds, work, terms):
    """Fit again with robust weights."""
    for _ in range(rounds):
        if not _least_squares(level, work.weight, basis, first, held, work.matrix, terms):
            return False
        _reweigh(level, allowed, basis, terms, work)
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fit(begin, end, observations, valid, directions, halves, scatter, fitted):
    normals, shading, reflectance = fitted
    lights, _, channels = observations.shape
    size = shading.shape[1]
    plain = size == 3
    level, allowed = np.empty(lights), np.empty(lights, np.bool_)
    first, held, g = np.empty(3), np.empty(3), np.empty(3)
    basis, terms, before, prior = np.empty((lights, size)), np.empty(size), np.empty(size), np.empty(size)
    sums = np.empty(channels)
    work = Work(np.empty((size, size)), np.empty(lights), np.empty(lights), np.empty(lights))
    weight = work.weight
    for p in range(begin, end):
        for k in range(3):
            first[k] = normals[p, k]
        product, square = 0.0, 0.0
        for j in range(lights):
            allowed[j] = valid[j, p]
            level[j] = 0.0
            if allowed[j]:
                for k in range(channels):
                    level[j] += observations[j, p, k] / channels
            weight[j] = 1.0 if allowed[j] else 0.0
            c = first[0] * directions[j, 0] + first[1] * directions[j, 1] + first[2] * directions[j, 2]
            if allowed[j] and c > 0.0:
                product, square = product + c * level[j], square + c * c
        if not product > 1e-9 * square:
            continue
        for j in range(lights):
            level[j] *= square / product  # relative to Lambert's albedo
        least = LEAST_PRIOR * lights / 3.0
        for k in range(3):
            held[k] = (scatter[p] / WIDTH_NORMAL) ** 2 + least
        held[2] *= ALONG
        solved = True
        if plain or lights <= FEW_LIGHTS:
            solved = _robust_fit(level, allowed, directions, first, held, np.int64(ROUNDS_NORMAL), work, g)
        else:
            for k in range(3):
                g[k] = first[k]
        length = np.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        if not (solved and length > LEAST_FACTOR and g[2] > 0.0):
            continue
        _shading_basis(g, directions, halves, basis)
        for k in range(size):
            before[k], prior[k] = 0.0, least + (scatter[p] / WIDTH_TERMS) ** 2 if plain else least
        before[0], prior[0] = length, 0.0
        if plain:
            solved = _robust_fit(level, allowed, basis, before, prior, np.int64(ROUNDS_TERMS), work, terms)
        else:
            for j in range(lights):
                weight[j] = 1.0 if allowed[j] else 0.0
            solved = _least_squares(level, weight, basis, before, prior, work.matrix, terms)
        if not solved:
            continue
        # reflectance of each channel for this shading, whose mean factor is scaled to 1
        bodies, cosines, largest = 0.0, 0.0, 0.0
        for k in range(channels):
            sums[k] = 0.0
        for j in range(lights):
            shade = _shade(basis, terms, j)
            shade = shade if shade > 0.0 else 0.0
            if weight[j] > 0.0:
                bodies, cosines = bodies + weight[j] * shade * shade, cosines + weight[j] * basis[j, 0] * shade
                for k in range(channels):
                    sums[k] += weight[j] * shade * observations[j, p, k]
        scale = bodies / cosines
        for k in range(channels):
            largest = abs(sums[k]) if not abs(sums[k]) <= largest else largest  # also where it is no number
        if not (bodies > 0.0 and scale > LEAST_FACTOR and largest * scale < LARGEST * bodies):
            continue
        for k in range(channels):
            value = sums[k] / bodies * scale
            reflectance[p, k] = value if value > 0.0 else 0.0
        for i in range(3):
            normals[p, i] = g[i] / length
        for i in range(size):
            shading[p, i] = terms[i] / scale
