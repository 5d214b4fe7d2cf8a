"""Body shading for the prediction of lamps: normal, terms and reflectance fitted again to all samples of a pixel.

The normals of the stage are to be near the surface's. What predicts a photograph best also carries what lamps share:
errors of their directions and strengths, and light from neighbouring facets. With 96 lamps the two agree; with 12 in a
narrow cone a selection that leaves out a third of the samples costs more prediction than it gains. So, for relighting
alone, the samples j of a pixel are fitted again by one of two models:

    plain        I_j = g . l_j along g, the shading normal n; then I_j = c_j (a + b c_j + d x_j^8)
    directional  the same n, with many lamps that of the stage; then I_j = c_j (a + b c_j + d x_j^8 + e . l_j), e
                 across the view: the pixel darkens towards the side from which its surroundings shade it

with c = max(n . l, 0), x = max(n . h, 0). All are linear. In `plain` and for the normal of `directional` weights are
Cauchy's, 1 / (1 + (r / 2 s)^2) with s from the median of |r| (P. W. Holland and R. E. Welsch, Robust regression using
iteratively reweighted least-squares, Communications in Statistics A 6 (9), 1977), so that cast shadows and highlights
lose their say but not the samples next to them; priors hold g to the normal of the stage and b and d to 0, the weaker
the more the samples scatter about the stage's fit. The terms of `directional` are least squares with next to no prior:
there the shadows are to be predicted. `nishiki.model_selection.relighting` chooses.
"""

import numpy as np

from nishiki.errors import UserError
from nishiki.photometric.flags import FEW_LIGHTS, NOISE
from nishiki.photometric.lambert_fit import KINK, median_of_lights
from nishiki.photometric.light_selection import VALUES, half_vectors, sum_lights
from nishiki.photometric.normal_kernels import LEAST_FACTOR, PRIOR, WIDTH
from nishiki.threads import over_rows

MODELS = ("plain", "directional")
ROUNDS_NORMAL, ROUNDS_TERMS = 6, 3
TERMS = {"plain": 3, "directional": 5}  # of the map `shading`


def fit_relighting(observations, directions, normals, *, valid, scatter, reflectance, shading, model="plain"):
    """Fit shading normals, body shading and reflectance that predict lamps.

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
    maps = {
        "shading_normals": np.array(normals, np.float32).reshape(pixels, 3),
        "shading": np.zeros((pixels, TERMS[model]), np.float32),
        "reflectance": np.array(reflectance, np.float32).reshape(pixels, channels),
    }
    maps["shading"][:, :3] = np.reshape(shading, (pixels, 3))
    directions = np.asarray(directions, np.float64)
    vectors, valid = (directions, half_vectors(directions)), valid.reshape(lights, pixels)
    scatter = np.asarray(scatter, np.float64).reshape(pixels)
    step = max(1, VALUES // lights)

    def fit(begin: int, end: int, observations: np.ndarray) -> None:
        for first in range(begin, end, step):
            here = slice(first, min(first + step, end))
            samples = np.moveaxis(observations[:, here], -1, 0).astype(np.float64)
            start = maps["shading_normals"][here].T.astype(np.float64)
            with np.errstate(all="ignore"):  # here, as each thread has its own state
                found, fitted = _fit(samples, valid[:, here], vectors, start, scatter[here], model == "plain")
            for name, values in fitted.items():
                maps[name][here][found] = values.T[found]

    over_rows(fit, pixels, np.asarray(observations, np.float32).reshape(lights, pixels, channels))
    return {name: values.reshape(*shape, -1) for name, values in maps.items()}


def _least_squares(level, weight, basis, first, held) -> tuple[np.ndarray, np.ndarray]:
    """Solve level = basis . terms: terms (terms, pixels) with prior `held` about `first`, and where there are some."""
    size = len(basis)
    matrix, right = np.zeros((level.shape[1], size, size)), np.empty((level.shape[1], size))
    for i in range(size):
        weighted = weight * basis[i]
        right[:, i] = sum_lights(weighted, level) + held[i] * first[i]
        for k in range(i + 1):
            matrix[:, i, k] = matrix[:, k, i] = sum_lights(weighted, basis[k]) + (held[i] if i == k else 0)
    positive = (np.diagonal(matrix, axis1=1, axis2=2) > 0).all(axis=1)
    sound = np.logical_and(positive, np.isfinite(matrix).all(axis=(1, 2)))
    matrix[~sound] = np.eye(size)
    return np.linalg.solve(matrix, right[:, :, None])[:, :, 0].T, sound


def _robust_fit(level, weight, allowed, basis, first, held, rounds: int):
    """Fit like `_least_squares`, repeatedly, with Cauchy's weights of the samples that the fit lights."""
    found = True
    for _ in range(rounds):
        terms, sound = _least_squares(level, weight, basis, first, held)
        shade, found = _shade(basis, terms), found & sound
        lit, residual = allowed & (shade > 0), np.abs(level - np.maximum(shade, 0))
        count = lit.sum(axis=0)
        freedom = np.sqrt(count / np.maximum(count - len(basis) + 1, 1))
        scale = KINK * (1.4826 * median_of_lights(np.where(lit, residual, np.nan)) * freedom + NOISE)
        weight = np.where(lit, 1 / (1 + (residual / scale) ** 2), 0)
    return terms, weight, found


def _shade(basis, terms) -> np.ndarray:
    return sum(each * term for each, term in zip(basis, terms, strict=True))


def _fit(samples, allowed, vectors, start, scatter, plain: bool) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Fit pixels: samples (channels, lights, pixels), start (3, pixels); return where it holds, and the maps."""
    directions, halves = (np.broadcast_to(v.T[:, :, None], (3, *allowed.shape)) for v in vectors)
    lights, level = len(allowed), np.where(allowed, samples.mean(axis=0), 0)
    cosine = np.maximum(_shade(directions, start), 0) * allowed
    product, square = sum_lights(cosine, level), sum_lights(cosine, cosine)
    found = product > 1e-9 * square
    level = level * (square / np.where(found, product, 1))  # relative to Lambert's albedo
    least, weight, g = PRIOR * lights / 3, allowed.astype(np.float64), start
    if plain or lights <= FEW_LIGHTS:
        held = np.tile((scatter / WIDTH) ** 2 + least, (3, 1))
        g, weight, sound = _robust_fit(level, weight, allowed, directions, start, held, ROUNDS_NORMAL)
        found = found & sound
    length = np.sqrt(sum_lights(g, g))
    found = found & (length > LEAST_FACTOR) & (g[2] > 0)
    normal = g / length
    c, x = (np.maximum(_shade(each, normal), 0) for each in (directions, halves))
    basis = [c, c * c, c * x**8, *(() if plain else (c * directions[0], c * directions[1]))]
    before, prior = np.zeros((2, len(basis), len(length)))
    before[0], prior[1:] = length, least + ((scatter / WIDTH) ** 2 if plain else 0)
    if plain:
        terms, weight, sound = _robust_fit(level, weight, allowed, basis, before, prior, ROUNDS_TERMS)
    else:
        weight = allowed.astype(np.float64)
        terms, sound = _least_squares(level, weight, basis, before, prior)
    # reflectance of each channel for this shading, whose mean factor is scaled to 1
    shade = np.maximum(_shade(basis, terms), 0)
    weighted = weight * shade
    bodies = sum_lights(weighted, shade)
    scale = bodies / sum_lights(weighted, c)
    sums = np.stack([sum_lights(weighted, np.where(weight > 0, channel, 0)) for channel in samples])
    found = found & sound & (bodies > 0) & (scale > LEAST_FACTOR)
    found &= np.abs(sums).max(axis=0) * scale < np.finfo(np.float32).max * bodies  # false where it is no number
    fitted = {"shading_normals": normal, "shading": terms / scale}
    return found, fitted | {"reflectance": np.maximum(sums / bodies * scale, 0)}
