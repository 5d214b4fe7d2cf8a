"""Photometric stereo: normals, albedo and their uncertainty from observations under known lights.

Some selections of samples are not followed. Half of the samples can agree with a Lambertian surface by accident where
few lamps light a pixel: above all samples of lamps that lie in one plane, which fit any normal along a line of
directions, and neighbouring lamps of a narrow cone. Two signs tell, and both need a selection that determines the
normal badly (condition of its normal matrix above SUSPECT):

* It determines the normal far worse than all valid samples would: condition more than WORSE times theirs.
* It is worse than theirs at all (SOMEWHAT), and what it leaves out as too bright is not nearer to the mirror direction
  than what it keeps (mean n . h): gloss only adds light there.
"""

from collections import namedtuple
from dataclasses import dataclass, replace

import numpy as np

from nishiki.errors import UserError
from nishiki.photometric import light_selection
from nishiki.photometric.flags import COPLANAR, NO_ESTIMATE, NormalFlag
from nishiki.progress import Summarised
from nishiki.threads import over_rows, strips

SOLVERS = ("lobe", "least_squares")
NEAR_DEG = 0.2  # largest difference between a pixel's direction to a near light and that of its block
SUSPECT = 40.0  # condition of the light matrix
WORSE, SOMEWHAT = 16.0, 1.3


Estimates = namedtuple("Estimates", "normals scalars lights_used flags")
"""Outputs of the kernels: normals (pixels, 3), scalars (4, pixels) float32: albedo, sigma, condition, residual.

lights_used (pixels,) uint16 and flags (pixels,) uint8, the bits of `nishiki.photometric.flags`.
"""


Samples = namedtuple("Samples", "observations usable known")
"""Samples: observations (lights, pixels) float32; usable, known (lights, pixels) uint8, or (lights, 1) for all."""


@dataclass(frozen=True, repr=False)
class NormalField(Summarised):
    """Normals, their uncertainty and flags; every array (rows, columns).

    normals (rows, columns, 3) float32, unit vectors, x right, y up, z to the camera; albedo float32, relative to the
    white reference; sigma float32, root mean square angle of the error in radians, first order, from the residual;
    lights_used uint16; condition float32 of the weighted 3 x 3 normal matrix; residual float32, root mean square, in
    units of the observations; flags uint8, the bits of `nishiki.photometric.flags`. Where a flag of NO_ESTIMATE is set
    the normal is (0, 0, 1), albedo and residual are 0 and sigma is pi / 2: finite, and marked as unknown. shading
    (rows, columns, 3) float32: (a, b, d) of `nishiki.brdf.torrance_sparrow`, None of a solver that knows Lambert's law
    only.
    """

    normals: np.ndarray
    albedo: np.ndarray
    sigma: np.ndarray
    lights_used: np.ndarray
    condition: np.ndarray
    residual: np.ndarray
    flags: np.ndarray
    solver: str
    shading: np.ndarray | None = None

    @property
    def valid(self):
        """(rows, columns) bool: where there is an estimate of the pixel's own."""
        return (self.flags & NO_ESTIMATE) == 0

    @property
    def diagnostics(self):
        """Counts of flagged pixels and medians over the valid ones, as plain numbers."""
        valid = self.valid
        middle = {
            name: float(np.median(getattr(self, name)[valid])) if valid.any() else 0.0
            for name in ("sigma", "condition", "residual", "lights_used")
        }
        counted = {flag.name.lower(): int(((self.flags & flag) != 0).sum()) for flag in NormalFlag}
        return {
            "solver": self.solver,
            "pixels": int(self.flags.size),
            "valid_pixels": int(valid.sum()),
            **{f"median_{name}": value for name, value in middle.items()},
            **{f"flagged_{name}": count for name, count in counted.items()},
        }


def estimate_normals(
    observations, directions, *, usable=None, weights=None, valid=None, solver="lobe", max_condition=1e4, noise=0.003
):
    """Estimate normals and albedo of every pixel from its observations under known lights.

    Without gloss the observations are albedo * max(n . l, 0), with the normal n and the direction l to the light.

    Parameters
    ----------
    observations : (lights, rows, columns) array_like of float
        Relative to the white reference: 1 is a perfect white diffuser that faces the lamp.
    directions : (lights, 3) or (lights, rows, columns, 3) array_like of float
        Unit vectors to the lights; x right, y up, z towards the camera. Of near lights those of each pixel; they are
        taken as constant over blocks in which they change by less than 0.2 degrees.
    usable : (lights, rows, columns) array_like of bool, optional
        Samples that the fit starts from, as `nishiki.photometric.light_selection.select_diffuse` chooses them.
        Default: all.
    weights : (lights,) or (lights, rows, columns) array_like of float, optional
        Weights of the samples, zero or more; only for the solver `least_squares`.
    valid : (lights, rows, columns) array_like of bool, optional
        Observations that enter fits, where they are also chosen. Default: all.
    solver : {'lobe', 'least_squares'}, optional
        `least_squares`: ordinary (weighted) least squares on the usable samples. `lobe`, the default: from there, a
        reflectance with a diffuse fall-off and a gloss lobe (`nishiki.photometric.lobe`), which chooses the samples
        again among the valid ones; it starts from all valid ones where the selection is not to be followed
        (`find_distrusted`).
    max_condition : float, optional
        Condition number of the weighted 3 x 3 normal matrix above which a pixel is flagged.
    noise : float, optional
        Standard deviation of the observations relative to the albedo; for `lobe`.

    Returns
    -------
    NormalField
        `normals` (rows, columns, 3) float32, unit vectors; `albedo` (rows, columns) float32, relative to the white
        reference; `sigma` float32, error of the direction in radians as the residuals imply it, without what all lamps
        share (interreflection, wrong directions); `flags` uint8, the bits of `nishiki.photometric.flags`; `valid`
        bool: where there is an estimate.

    Raises
    ------
    nishiki.errors.UserError
        For shapes that do not fit, negative weights, unknown solvers, and codes of a file in place of light.

    References
    ----------
    R. J. Woodham (1980), Photometric method for determining surface orientation from multiple images.
    S. Tominaga and N. Tanaka (2004), Measuring and rendering art paintings using a color camera, section 3.
    B. Shi, P. Tan, Y. Matsushita and K. Ikeuchi (2014), Bi-polynomial modeling of low-frequency reflectances (the
    model that the solver `lobe` follows, with other terms).

    Examples
    --------
    A matt plane that is tilted by 10 degrees, under four lamps:

    >>> import numpy as np
    >>> import nishiki
    >>> normal = np.array([np.sin(np.radians(10)), 0, np.cos(np.radians(10))])
    >>> lights = np.array([[0.6, 0, 0.8], [-0.6, 0, 0.8], [0, 0.6, 0.8], [0, -0.6, 0.8]])
    >>> observations = np.broadcast_to(0.5 * (lights @ normal)[:, None, None], (4, 2, 3))
    >>> field = nishiki.estimate_normals(observations, lights, solver="least_squares")
    >>> field.normals.shape
    (2, 3, 3)
    >>> bool(np.allclose(field.normals, normal, atol=1e-6)), bool(np.allclose(field.albedo, 0.5))
    (True, True)
    """
    if solver not in SOLVERS:
        raise UserError(f"normals: expected a solver of {', '.join(SOLVERS)}, found {solver!r}")
    some = np.ravel(observations)[:: np.size(observations) // 1000 + 1]
    if (some == np.rint(some)).all() and 1 < some.max(initial=0) <= np.iinfo(np.uint16).max:
        found = f"whole numbers up to {some.max():g}, as codes of a file are"
        remedy = "Remedy: decode them (nishiki.read_photographs), or divide linear codes by the largest one"
        raise UserError(
            f"observations: expected linear light, 1 for a white that faces the lamp, found {found}. {remedy}"
        )
    if np.ndim(directions) == 4:
        options = {"solver": solver, "max_condition": max_condition, "noise": noise}
        samples = {"usable": usable, "weights": weights, "valid": valid}
        return _near_field(np.asarray(observations), np.asarray(directions), samples, options)
    stack, directions = light_selection.checked_stack(observations, directions)
    shape = np.shape(observations)
    factors = sample_weights(stack, both(usable, valid), weights, shape)
    outputs = lambertian(stack, directions, factors, max_condition)
    shading = None
    if solver == "lobe":
        if weights is not None:
            raise UserError("normals: the solver 'lobe' takes no weights; use 'least_squares', or leave samples out")
        known = factors if valid is None else light_selection.checked_valid(stack, valid, shape).view(np.uint8)
        if valid is not None and factors.shape == stack.shape:
            factors = replace_distrusted(stack, directions, factors, known, outputs, max_condition)
        shading = refine_lobe(stack, directions, factors, known, outputs, noise, max_condition)
        shading = shading.reshape(*shape[1:], 3)
    return replace(as_field(*outputs, shape[1:], solver), shading=shading)


def _near_field(observations, directions, samples, options):
    """Estimate under directions (lights, rows, columns, 3), block by block.

    samples: arguments with an axis each for lights, rows and columns, or for lights only, or None.
    """
    if directions.shape != (*observations.shape, 3):
        expected = f"({', '.join(map(str, observations.shape))}, 3)"
        raise UserError(f"light directions: expected shape {expected}, found {directions.shape}")
    steps = [np.abs(np.diff(directions, axis=axis)).max(initial=0.0) for axis in (1, 2)]
    side = max(int(np.sqrt(2) * np.radians(NEAR_DEG) / max(*steps, 1e-9)), 1)
    whole: dict[str, np.ndarray] = {}
    for top in range(0, observations.shape[1], side):
        for left in range(0, observations.shape[2], side):
            area = np.s_[:, top : top + side, left : left + side]
            middle = directions[area].mean(axis=(1, 2), dtype=np.float64)
            middle /= np.linalg.norm(middle, axis=1, keepdims=True)
            parts = {name: each[area] if np.ndim(each) == 3 else each for name, each in samples.items()}
            field = estimate_normals(observations[area], middle, **parts, **options)
            for name, values in vars(field).items():
                if isinstance(values, np.ndarray):
                    shape = (*observations.shape[1:], *values.shape[2:])
                    whole.setdefault(name, np.empty(shape, values.dtype))[area[1:]] = values
    return replace(field, **whole)


def replace_distrusted(stack, directions, usable, known, outputs, max_condition):
    """Choose samples to start from: all valid ones where `find_distrusted` rejects the selected ones.

    The Lambertian estimates of those pixels in the outputs are made anew, in place.
    """
    if not (outputs.scalars[2] > SUSPECT).any():
        return usable
    known = np.broadcast_to(known, usable.shape)
    again = find_distrusted(stack, directions, usable, known, outputs)
    if not again.size:
        return usable
    usable = usable.copy()
    usable[:, again] = known[:, again]
    anew = lambertian(
        np.ascontiguousarray(stack[:, again]), directions, np.ascontiguousarray(usable[:, again]), max_condition
    )
    outputs.normals[again], outputs.scalars[:, again] = anew.normals, anew.scalars
    outputs.lights_used[again], outputs.flags[again] = anew.lights_used, anew.flags
    return usable


def refine_lobe(stack, directions, usable, known, outputs, noise, max_condition):
    """Replace the Lambertian estimates in the outputs, in place, by those of the model with a gloss lobe.

    Returns the body shading (pixels, 3) float32 of `nishiki.brdf.torrance_sparrow`.
    """
    from nishiki.brdf.torrance_sparrow import LAMBERT
    from nishiki.photometric.normal_kernels import refine

    # (6, lights): directions to the lights, and half vectors of light and view
    vectors = np.ascontiguousarray(
        np.hstack([directions, light_selection.half_vectors(directions)]).T, dtype=np.float32
    )
    shading = np.tile(np.array(LAMBERT, np.float32), (stack.shape[1], 1))
    samples = Samples(stack, usable, known)
    over_rows(refine, stack.shape[1], samples, vectors, float(noise), float(max_condition), outputs, shading)
    return shading


def lambertian(stack, directions, factors, max_condition) -> Estimates:
    """Solve Lambertian least squares into new outputs; factors (lights, pixels or 1) uint8 or float32."""
    from nishiki.lanes import BLOCK
    from nishiki.photometric.normal_kernels import solve_weighted

    pixels = stack.shape[1]
    outputs = Estimates(
        np.empty((pixels, 3), dtype=np.float32),
        np.empty((4, pixels), dtype=np.float32),
        np.empty(pixels, dtype=np.uint16),
        np.empty(pixels, dtype=np.uint8),
    )
    factors = np.ascontiguousarray(np.broadcast_to(factors, stack.shape))
    blocks, products = -(-pixels // BLOCK), light_selection.direction_products(directions)
    over_rows(solve_weighted, blocks, stack, factors, products, float(max_condition), outputs)
    return outputs


def as_field(normals, scalars, used, flags, shape, solver):
    """Shape the kernels' flat outputs as a NormalField of the image."""
    albedo, sigma, condition, residual = scalars.reshape(4, *shape)
    return NormalField(
        normals=normals.reshape(*shape, 3),
        albedo=albedo,
        sigma=sigma,
        lights_used=used.reshape(shape),
        condition=condition,
        residual=residual,
        flags=flags.reshape(shape),
        solver=solver,
    )


def both(usable, valid):
    """Combine samples that are chosen and valid; None stands for all."""
    if usable is None or valid is None or usable is valid or np.shape(usable) != np.shape(valid):
        return valid if usable is None else usable  # shapes that differ are an error found later
    return np.asarray(usable, dtype=np.bool_) & np.asarray(valid, dtype=np.bool_)


def sample_weights(stack, usable, weights, shape):
    """Mask and weights combined: uint8 0 or 1 (lights, pixels), or (lights, 1) for all alike, or float32."""
    usable = light_selection.checked_valid(stack, usable, shape)
    if weights is None:
        return usable.view(np.uint8)
    weights = np.asarray(weights, dtype=np.float32)
    if weights.shape not in (shape, shape[:1]):
        raise UserError(f"weights: expected shape {shape} or {shape[:1]}, found {weights.shape}")
    if not (np.isfinite(weights).all() and (weights >= 0).all()):
        raise UserError("weights: expected finite values, zero or above, found others; zero leaves a sample out")
    weights = np.broadcast_to(weights.reshape(shape[0], -1), stack.shape)
    return np.where(usable, weights, np.float32(0))


def find_distrusted(stack, directions, usable, known, outputs):
    """Find the pixels whose selected samples are not to be followed.

    Parameters
    ----------
    stack : (lights, pixels) float32 observations.
    directions : (lights, 3) float64, unit vectors to the lights.
    usable, known : (lights, pixels) uint8, 1 for the selected and for the valid samples.
    outputs : normals, scalars, lights used and flags of Lambert's law on the selected samples
        (`nishiki.photometric.solve.lambertian`).

    Returns
    -------
    (n,) int64, numbers of the pixels.
    """
    normals, scalars, _, flags = outputs
    fitted = (flags & (NormalFlag.TOO_FEW_LIGHTS | NormalFlag.NO_SIGNAL)) == 0
    suspects = np.flatnonzero((scalars[2] > SUSPECT) & fitted)
    halves, found = light_selection.half_vectors(directions), []
    for part in strips(len(suspects), light_selection.VALUES // len(stack)):
        here = suspects[part]
        valid, condition = known[:, here] > 0, scalars[2, here].astype(np.float64)
        first, member = light_selection.distinct_sets(valid)
        least = condition_of(valid[:, first], directions)[member]
        distrust = condition > WORSE * least
        between = np.flatnonzero((condition > SOMEWHAT * least) & ~distrust)
        p = here[between]
        distrust[between] = ~gloss_explains(
            stack[:, p], directions, halves, usable[:, p] > 0, valid[:, between], normals[p], scalars[0, p]
        )
        found.append(here[distrust])
    return np.concatenate(found) if found else suspects


def condition_of(chosen, directions):
    """Compute the condition (n,) of the normal matrix of the chosen (lights, n) lights; infinite if it is singular."""
    outer = (directions[:, :, None] * directions[:, None, :]).reshape(len(directions), -1)
    values = np.linalg.eigvalsh((chosen.T.astype(np.float64) @ outer).reshape(-1, 3, 3))
    least, largest = values[:, 0], values[:, 2]
    sound = (chosen.sum(axis=0) >= 3) & (least > largest / COPLANAR)
    return np.where(sound, largest / np.where(sound, least, 1.0), np.inf)


def gloss_explains(samples, directions, halves, usable, known, normals, albedo):
    """Check whether samples left out as too bright are nearer the mirror direction on average than those kept; (n,)."""
    mirror = np.maximum(halves @ normals.T, 0.0)
    bright = known & ~usable & (samples > albedo * np.maximum(directions @ normals.T, 0.0))
    kept = known & usable
    brights, keeps = bright.sum(axis=0), kept.sum(axis=0)
    nearer = (mirror * bright).sum(axis=0) * keeps >= (mirror * kept).sum(axis=0) * brights
    return (brights == 0) | (keeps == 0) | nearer
