"""Fit Lambert's law with the gains of the lamps to photographs of a plane scene.

A pixel s of albedo times normal m_s shows under a far lamp of direction l_j (Woodham, 1980)

    y_js = g_j max(m_s . l_j, 0) + a |m_s|

with a gain g_j (exposure, strength of the lamp) and ambient light a (an image like the albedo that no lamp changes).
All are fitted together by reweighted least squares. With c_js = m_s . l_j, weights w, M_s = sum_j w g^2 l l^T and the
derivatives of the residuals after the gains and the ambient light, J, the normal matrix of these is what remains once
m is eliminated,

    S = sum_s (J^T w J - B_s M_s^-1 B_s^T),    B_s = J^T w (g l)

It is nearly singular where the object is flat: a tilt of it is then the same as lamps that grow stronger to one side,
and the standard errors grow. They are sandwich errors over patches of the picture (Huber, 1967), so that a misfit of
the model (gloss, cast shadows, light from one part to another), which neighbours share, counts once a patch.
"""

import functools
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

import numpy as np

from nishiki.photometric.flags import NOISE

P = ParamSpec("P")
R = TypeVar("R")

ROUNDS = 15  # of reweighting; the gains change by less than their errors after ten
KINK = 2.0  # robust standard deviations of a pixel's residuals at which the weight of a value is a half (Cauchy)
GRAZING = 0.1  # cosine below which a lamp's direct light cannot be predicted, and below whose negative there is none
PATCHES = 8  # a side, over the picture: groups of pixels that count as one observation each
FEWEST_LAMPS = 4  # one more than the unknowns of a pixel: fewer predict nothing
MOST_PIXELS, MOST_VALUES = 1500, 40_000  # fitted; the errors are those of 64 patches, which more do not lower
LARGEST_STEP, WIDEST, NEAREST = 0.3, 4.0, 0.05  # of the width in distances of the lamps: a round, fitted; of a lamp


@dataclass(frozen=True)
class Fit:
    """Lambert's law fitted to pixels under all lamps."""

    normals: np.ndarray  # (pixels, 3) float64: albedo times normal
    gains: np.ndarray  # (lights,) float64: strengths, of median 1
    covariance: np.ndarray  # (lights, lights) float64: of the strengths
    # ambient, ambient_sigma: ambient light relative to the albedo, and its standard error; 0 where it is not fitted
    ambient: float
    ambient_sigma: float
    # (lights, pixels) float64: weight of each value, 0 to 1; 0 where the lamp lights the pixel at a grazing angle or
    # not at all
    weights: np.ndarray
    # residuals, alone: (lights, pixels) float64: value less its fit, and less its prediction by a fit without this
    # value
    residuals: np.ndarray
    alone: np.ndarray
    inverses: np.ndarray  # (pixels, 3, 3) float64: inverse normal matrices M
    scale: np.ndarray  # (pixels,) float64: robust standard deviation of the residuals
    # width, width_sigma: of the picture, in the unit of the lamps' positions, and its standard error; 0 of lamps that
    # are far
    width: float
    width_sigma: float


@contextmanager
def quiet() -> Iterator[None]:
    """Silence NumPy's warnings of medians over nothing, which are NaN, and of numbers beyond float64."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)
        yield


def return_none_if_undetermined(compare: Callable[P, R]) -> Callable[P, R | None]:
    """Return None from a comparison of photographs that determine nothing: black, saturated or not finite."""

    @functools.wraps(compare)
    def compare_or_none(*args: P.args, **options: P.kwargs) -> R | None:
        with quiet():
            try:
                return compare(*args, **options)
            except np.linalg.LinAlgError:
                return None

    return compare_or_none


def spread_pixels(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choose pixels (pixels,) evenly over the object, as places in the flat picture, and the patch of each."""
    _, rows, columns = grey.shape
    known = np.isfinite(grey).sum(axis=0) > max(FEWEST_LAMPS - 1, len(grey) // 2)
    level = np.max(grey, axis=0, where=np.isfinite(grey), initial=0.0)
    if known.any():  # nothing is predicted of places that no lamp reaches
        known &= level > 0.05 * np.percentile(level[known], 90)
    places = np.flatnonzero(known)
    places = places[:: -(-len(places) // min(MOST_PIXELS, MOST_VALUES // len(grey))) or 1]
    row, column = np.divmod(places, columns)
    return places, row * PATCHES // rows * PATCHES + column * PATCHES // columns


def fit_lambert(
    values: np.ndarray,
    directions: np.ndarray,
    patches: np.ndarray,
    *,
    reference: np.ndarray | None = None,
    places: np.ndarray | None = None,
    width: float = 0.0,
    hold: float = 0.0,
) -> Fit:
    """Fit Lambert's law and the gains to values (lights, pixels), NaN where unusable.

    reference (pixels,): image of the ambient light, which is fitted too where it is given; places (pixels, 3): of the
    pixels, with which the width of the picture is fitted too, from a first value on; hold: part of the information on
    each gain that says that it is 1.
    """
    known = np.isfinite(values)
    filled, lights = np.where(known, values, 0.0), len(values)
    ambience = np.zeros(values.shape[1]) if reference is None else reference
    of_ambient = slice(lights, lights if reference is None else lights + 1)  # among the unknowns, gains first
    gains, ambient = np.ones(lights), 0.0
    weights = known / np.maximum(median_of_lights(values), 1e-12) ** 2
    shade = np.zeros(values.shape)
    vectors = directions.reshape(lights, -1, 3)
    for turn in range(ROUNDS):
        if places is not None:
            # irradiance vectors (lights, pixels, 3), 1 at distance 1, and their slope by the width of the picture
            to_lamp = directions[:, None] - width * places
            distance = np.maximum(np.linalg.norm(to_lamp, axis=2)[..., None], NEAREST)
            approach = np.einsum("jsa,sa->js", to_lamp, places)[..., None]
            vectors = to_lamp / distance**3
            slope = (3 * approach * to_lamp / distance**2 - places) / distance**3
        lamps = gains[:, None, None] * vectors
        direct = filled - ambient * ambience
        normals, inverse = solve_normals(weights, direct, lamps)
        albedo = np.linalg.norm(normals, axis=1) + 1e-300
        cosine = dot_lamps(vectors, normals)
        lit, dark = lit_and_dark(known, filled, cosine, albedo)
        residual = direct - np.where(dark, 0.0, gains[:, None] * cosine)
        if turn:
            # derivatives after the ambient light and the width, then, with those after the gains, by the normal
            further = np.broadcast_to(ambience, (0 if reference is None else 1, *values.shape))
            if places is not None:
                further = np.concatenate([further, [gains[:, None] * dot_lamps(slope, normals)]])
            across = lamps.transpose(0, 2, 1)
            of_further = [((weights * each)[:, None] * across).sum(axis=0, keepdims=True) for each in further]
            mixed = np.concatenate([(weights * cosine)[:, None] * across, *of_further])
            solved = np.einsum("jas,abs->jbs", mixed, inverse.transpose(1, 2, 0)).reshape(len(mixed), -1)
            mixed = mixed.reshape(len(mixed), -1)
            # a prior of 1 for all of them keeps what is not determined at 1 and 0
            system = np.eye(len(mixed)) - multiply(solved, mixed)
            own = (weights * cosine**2).sum(axis=1)
            held = hold ** (turn / (ROUNDS - 1))  # firmly at first: the normals of the majority come before its gains
            system[:lights, :lights] += (1 + held) * np.diag(own)
            coupled = np.einsum("js,kjs->jk", weights * cosine, further)
            system[:lights, lights:] += coupled
            system[lights:, :lights] += coupled.T
            system[lights:, lights:] += np.einsum("js,kjs,ljs->kl", weights, further, further)
            system[of_ambient, of_ambient] += (shade * ambience**2).sum()
            # a common factor is no gain: the normals take it
            system[:lights, :lights] += np.outer(gains, gains) * np.trace(system) / (gains @ gains)
            scores = np.concatenate([weights * cosine * residual, np.einsum("js,kjs->ks", weights * residual, further)])
            scores[of_ambient] += (shade * residual).sum(axis=0) * ambience
            inverse_system = np.linalg.inv(system)
            pull = scores.sum(axis=1)
            pull[:lights] += held * own * (1 - gains)
            step = inverse_system @ pull
            gains = np.clip(gains + step[:lights], 1e-4, 1e4)
            ambient += float(step[of_ambient].sum())
            if places is not None:
                width = float(np.clip(width + np.clip(step[-1], -LARGEST_STEP, LARGEST_STEP), -1, WIDEST))
            norm = np.median(gains)
            gains, normals, albedo, cosine = gains / norm, normals * norm, albedo * norm, cosine * norm
            residual = filled - ambient * ambience - np.where(dark, 0.0, gains[:, None] * cosine)
        scale = scale_of(residual, lit, albedo)
        if turn < ROUNDS - 1:
            last = scale
            trust = 1 / ((1 + (residual / (KINK * scale)) ** 2) * scale**2)
            weights, shade = lit * trust, dark * trust
    groups = np.zeros((patches.max() + 1, len(scores)))
    np.add.at(groups, patches, scores.T)
    covariance = inverse_system @ (groups.T @ groups) @ inverse_system
    variance = np.maximum(np.diag(covariance), np.diag(inverse_system))
    covariance *= np.sqrt(np.outer(variance, variance) / np.outer(np.diag(covariance), np.diag(covariance)))
    # ambient light and width are those of all lamps: what single photographs say of them varies more than by patches
    at, pull = inverse_system[lights:], weights * residual
    own = at[:, :lights] * (pull * cosine).sum(axis=1) + at[:, lights:] @ np.einsum("js,kjs->kj", pull, further)
    own += np.outer(at[:, of_ambient].sum(axis=1), (shade * residual) @ ambience)
    through = np.tensordot(at, solved.reshape(len(solved), 3, -1), 1)
    for score, each in zip(own, through, strict=True):
        score -= (pull * (each * across).sum(axis=1)).sum(axis=1)
    variance[lights:] += (own**2).sum(axis=1)
    leverage = weights * np.einsum("jsa,sab,jsb->js", lamps, inverse, lamps)
    alone = residual / np.maximum(1 - leverage, 1e-2)
    of_lamps = gains, covariance[:lights, :lights], ambient, float(np.sqrt(variance[of_ambient].sum()))
    deviation = float(np.sqrt(variance[-1])) if places is not None else 0.0
    return Fit(normals, *of_lamps, weights * last**2, residual, alone, inverse, last, width, deviation)


def multiply(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Multiply first (n, k) by the transpose of second (n, k) in parts too small for the library to start threads.

    Its threads wait for each other: on a machine with other work that took ten times as long as the product.
    """
    width = max(8, 200_000 // len(first) ** 2)
    parts = (slice(start, start + width) for start in range(0, first.shape[1], width))
    return sum(first[:, part] @ second[:, part].T for part in parts)


def solve_normals(weights: np.ndarray, values: np.ndarray, lamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve for albedo times normal (pixels, 3) by weighted least squares; also the inverse matrices (pixels, 3, 3).

    weights, values (lights, pixels); lamps (lights, 1 or pixels, 3).
    """
    across = lamps.transpose(0, 2, 1)
    if lamps.shape[1] == 1:
        matrix = ((across * lamps).reshape(-1, 9).T @ weights).reshape(3, 3, -1)
        moments = lamps[:, 0].T @ (weights * values)
    else:
        matrix = np.einsum("jas,jbs->abs", weights[:, None] * across, across)
        moments = np.einsum("js,jas->as", weights * values, across)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = matrix
    trace = xx + yy + zz
    least = 1e-9 * trace
    xx, yy, zz = xx + least, yy + least, zz + least
    a, b, c, d, e = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy, xx * zz - xz * xz, xy * xz - xx * yz
    cofactors = np.array([[a, b, c], [b, d, e], [c, e, xx * yy - xy * xy]])
    determinant = np.maximum(xx * a + xy * b + xz * c, trace * least**2 / 3 + 1e-300)  # no less, but for rounding
    inverse = (cofactors / determinant).transpose(2, 0, 1)
    return np.einsum("sab,bs->sa", inverse, moments), inverse


def dot_lamps(lamps: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Multiply lamps (lights, 1 or pixels, 3) by normals (pixels, 3), giving (lights, pixels)."""
    return lamps[:, 0] @ normals.T if lamps.shape[1] == 1 else np.einsum("jsa,sa->js", lamps, normals)


def lit_and_dark(
    known: np.ndarray, filled: np.ndarray, cosine: np.ndarray, albedo: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Find which values (lights, pixels) the lamp lights, and which lie in attached shadow.

    In shadow by the model and in the photograph: a bright value stays, else a wrong fit would drop what it misses.
    """
    faint = known & (filled < GRAZING * albedo)
    lit = known & ~(faint & (cosine < GRAZING * albedo))
    lit = np.where(lit.sum(axis=0) > 3, lit, known)
    return lit, faint & (cosine < -GRAZING * albedo) & ~lit


def scale_of(residual: np.ndarray, lit: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Estimate the robust standard deviation (pixels,) of the residuals (lights, pixels) of lit values.

    At least that of all pixels: a pixel whose weights are gone to all but three values fits these exactly.
    """
    spread = median_of_lights(np.where(lit, np.abs(residual), np.nan))
    usual = np.nanmedian(spread / albedo)
    return np.maximum(1.4826 * np.fmax(spread, usual * albedo), NOISE * albedo)


def median_of_lights(values: np.ndarray) -> np.ndarray:
    """Compute the median (pixels,) of values (lights, pixels) that are not NaN, faster than NumPy over few lights."""
    ordered, count = np.sort(values, axis=0), (~np.isnan(values)).sum(axis=0)
    pixel, last = np.arange(values.shape[1]), len(values) - 1
    return 0.5 * (ordered[np.maximum(count - 1, 0) // 2, pixel] + ordered[np.minimum(count // 2, last), pixel])


def regress(
    terms: np.ndarray, targets: np.ndarray, used: np.ndarray, patches: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Solve terms (sets, n, k) @ x = targets (sets, n) by reweighted least squares over those that are used (sets, n).

    Some of each set are used. Returns x (sets, k) and its covariance (sets, k, k) over patches (n,).
    """
    terms, targets = np.where(used[:, :, None], terms, 0.0), np.where(used, targets, 0.0)
    weights, least = used.astype(np.float64), 1e-12 + 1e-6 * np.abs(targets).max(axis=1)
    for _ in range(ROUNDS):
        weighted = (terms * weights[:, :, None]).transpose(0, 2, 1)
        inverse = np.linalg.pinv(weighted @ terms)
        solution = inverse @ (weighted @ targets[:, :, None])
        residual = targets - (terms @ solution)[:, :, 0]
        spread = median_of_lights(np.where(used, np.abs(residual), np.nan).T)
        weights = used / (1 + (residual / (KINK * np.maximum(1.4826 * spread, least)[:, None])) ** 2)
    groups = np.equal.outer(np.arange(patches.max() + 1), patches) @ (terms * (weights * residual)[:, :, None])
    return solution[:, :, 0], inverse @ (groups.transpose(0, 2, 1) @ groups) @ inverse
