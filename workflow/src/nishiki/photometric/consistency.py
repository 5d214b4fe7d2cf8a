"""Predict every photograph of a plane scene from the others, and say where one of them disagrees.

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

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")

ROUNDS = 15  # of reweighting; the gains change by less than their errors after ten
KINK = 2.0  # robust standard deviations of a pixel's residuals at which the weight of a value is a half (Cauchy)
LEAST_SCALE = 0.003  # of the albedo: least standard deviation of a pixel's residuals, that of eight bits
GRAZING = 0.1  # cosine below which a lamp's direct light cannot be predicted, and below whose negative there is none
TURNS = 4  # of measuring the ambient light and fitting what it leaves
PATCHES = 8  # a side, over the picture: groups of pixels that count as one observation each
FEWEST_LAMPS = 4  # one more than the unknowns of a pixel: fewer predict nothing
FEWEST_PIXELS = 24  # lit by a lamp: eight for each of the three numbers of its direction
MOST_PIXELS, MOST_VALUES = 1500, 40_000  # fitted; the errors are those of 64 patches, which more do not lower
FAINT = 0.1  # gain below which a photograph shows the room and the noise, not its lamp
LEAST_AMBIENT = 0.02  # of the albedo: less turns normals by less than half a degree, and lenses and walls give as much
REPEATED = 0.25  # of the difference that two lamps should make: the same lamp twice leaves the noise of the camera
MOST_AMBIENT = 0.4  # of a lamp: more cannot be told from an even object, where .41 to 1.1 seemed to be
WORSE = 2.0  # times the misfit without ambient light: shadows prove some that misfits more, up to 1.5
LEAST_FLOOR, LEAST_BEHIND = 0.3, 0.75  # of the ambient light: the darkest shadows, and the usual ones behind the object
MOST_DRIFT = (
    0.2  # of the ambient light from fit to fit: .02 to .11 on six measured sets, .36 and .8 on a glossy painting
)
EVEN_FLOOR = 0.8  # the same of the darkest shadows where few values lie behind the object
LARGEST_STEP, WIDEST, NEAREST = 0.3, 4.0, 0.05  # of the width in distances of the lamps: a round, fitted; of a lamp
LEAST_GAIN = 0.02  # of a lamp's strength that is put right: less turns normals by a tenth of a degree
LAW_COURSE, LAW_REST = 3.0, 1.5  # times the misfit of the law: deviation of log strengths that equal lamps seem to have
# (rms of six measured sets), of the part that is linear over the directions, and of the rest
MOST_COURSE = 0.5  # deviation of log strengths that are linear over the directions: 1.1 on metal, <= .12 elsewhere
LARGEST_MISFIT = 0.1  # of the brightness: where the photographs are predicted worse, nothing is concluded from them
SURE = 5.0  # standard errors at which a difference counts: once in two million by chance


@dataclass(frozen=True)
class Consistency:
    """What each photograph (lights,) shows about itself, against the prediction from the others.

    Attributes
    ----------
    residual : (lights,) float64
        Median of |value - prediction| over the median prediction; NaN: not predicted.
    gain, gain_sigma : (lights,) float64
        Strength relative to the median photograph, and its standard error.
    offset, offset_sigma : (lights,) float64
        Light that does not follow the lamp, relative to the albedo under a frontal lamp, and its standard error; the
        ambient light that all photographs share is included.
    direction : (lights, 3) float64
        Unit vector to the lamp that explains the photograph.
    direction_sigma_deg : (lights,) float64
        Standard error of that direction, degrees.
    failed : tuple of int
        Photographs in which the lamp did not burn.
    repeats : tuple of (int, int)
        Photographs of one lamp though two are stated; the first one fits its stated lamp worse.
    ambient, ambient_sigma : float
        Offset that all photographs share, and its standard error.
    gain_covariance : (lights, lights) float64
        Of the gains.
    """

    residual: np.ndarray
    gain: np.ndarray
    gain_sigma: np.ndarray
    offset: np.ndarray
    offset_sigma: np.ndarray
    direction: np.ndarray
    direction_sigma_deg: np.ndarray
    failed: tuple[int, ...]
    repeats: tuple[tuple[int, int], ...]
    ambient: float
    ambient_sigma: float
    gain_covariance: np.ndarray

    def holds(self, directions: np.ndarray) -> bool:
        """Whether Lambert's law predicts the photographs well enough to conclude anything from its parameters."""
        return bool(np.nanmedian(self.residual) < LARGEST_MISFIT) and is_even(self.gain, directions)


@dataclass(frozen=True)
class Fit:
    """Lambert's law fitted to pixels under all lamps.

    Attributes
    ----------
    normals : (pixels, 3) float64
        Albedo times normal.
    gains : (lights,) float64
        Strengths, of median 1.
    covariance : (lights, lights) float64
        Of the strengths.
    ambient, ambient_sigma : float
        Ambient light relative to the albedo, and its standard error.
    weights : (lights, pixels) float64
        Weight of each value, 0 to 1; 0 where the lamp lights the pixel at a grazing angle or not at all.
    residuals, alone : (lights, pixels) float64
        Value less its fit, and less its prediction by a fit without this value.
    inverses : (pixels, 3, 3) float64
        Inverse normal matrices M.
    scale : (pixels,) float64
        Robust standard deviation of the residuals.
    width, width_sigma : float
        Of the picture, in the unit of the lamps' positions, and its standard error; 0 of lamps that are far.
    """

    normals: np.ndarray
    gains: np.ndarray
    covariance: np.ndarray
    ambient: float
    ambient_sigma: float
    weights: np.ndarray
    residuals: np.ndarray
    alone: np.ndarray
    inverses: np.ndarray
    scale: np.ndarray
    width: float
    width_sigma: float


@contextmanager
def quiet() -> Iterator[None]:
    """Silence NumPy's warnings of medians over nothing, which are NaN, and of numbers beyond float64."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)
        yield


def none_where_undetermined(compare: Callable[P, R]) -> Callable[P, R | None]:
    """Return None from a comparison of photographs that determine nothing: black, saturated or not finite."""

    @functools.wraps(compare)
    def compared(*args: P.args, **options: P.kwargs) -> R | None:
        with quiet():
            try:
                return compare(*args, **options)
            except np.linalg.LinAlgError:
                return None

    return compared


@none_where_undetermined
def examine_photographs(values: np.ndarray, lamps: np.ndarray) -> Consistency | None:
    """Compare every photograph of a plane scene with its prediction from the others.

    Parameters
    ----------
    values : (lights, rows, columns) or (lights, rows, columns, channels)
        Linear values of the reduced photographs, NaN where saturated or outside of the object.
    lamps : (lights, 3) or (lights, rows, columns, 3)
        Vectors to the lamps as stated, x right, y up, z to the camera; of lamps that stand near, at each pixel, as long
        as their light is strong.

    Returns
    -------
    Consistency or None
        None where nothing can be predicted: fewer than 4 lamps, hardly a pixel, or a mirror.
    """
    grey = values.mean(axis=3) if values.ndim == 4 else values
    places, patches = spread_pixels(grey)
    if len(lamps) < FEWEST_LAMPS or len(places) < FEWEST_PIXELS:
        return None
    directions = lamps if lamps.ndim == 2 else lamps.reshape(len(lamps), -1, 3)[:, places]
    chosen = grey.reshape(len(grey), -1)[:, places].astype(np.float64)
    fit = fit_lambert(chosen, directions, patches)
    if not np.isfinite(fit.gains).all():
        return None
    fit, ambient, sigma = take_ambient(chosen, directions, patches, fit)
    return _compare(chosen, directions, patches, fit, (ambient, sigma))


def take_ambient(values: np.ndarray, directions: np.ndarray, patches: np.ndarray, fit: Fit) -> tuple[Fit, float, float]:
    """Measure the ambient light in deep shadows, else from a fit of which it must explain most of the residual.

    Shadows are sought under the light that the darkest values allow, so that much of it does not hide them. Light from
    one part of the object to another, and rough surfaces, are like ambient light where the lamps reach, but leave deep
    shadows dark. Where no shadow is seen at first, the estimate has to stay the same from fit to fit: else it makes the
    shadows that it is measured in. Returns the fit with ambient light where it counts, the ambient light and its error.
    """
    albedo = np.linalg.norm(fit.normals, axis=1)
    dark, sigma, _ = deepest_shadows(values, fit, albedo, patches)
    if dark <= max(LEAST_AMBIENT, SURE * sigma):
        return fit, max(dark, 0.0), sigma
    # the darkest values of all are the ambient light or more: without them, shadows are as dark as the model says
    ambient, rest, levels = lowest_levels(values / albedo, patches)[0], fit, []
    for _ in range(TURNS):  # the albedo, which is the image of the ambient light, is of the fit before
        if not ambient > LEAST_AMBIENT:
            break
        rest = fit_lambert(values - ambient * albedo, directions, patches)
        albedo = np.linalg.norm(rest.normals, axis=1)
        floor, sigma, ambient = deepest_shadows(values, replace(rest, ambient=ambient), albedo, patches)
        levels.append(ambient)
    else:
        misfit, before = (np.nanmedian(np.abs(one.alone)) / np.nanmedian(values) for one in (rest, fit))
        steady = np.ptp(levels[1:]) < MOST_DRIFT * ambient
        believed = np.isfinite(dark) or (steady and misfit < min(LARGEST_MISFIT / 2, WORSE * before))
        cosine = np.einsum("jsa,sa->js", directions.reshape(len(values), -1, 3), rest.normals)
        behind = (values / albedo)[cosine < -GRAZING * albedo]
        behind = behind[np.isfinite(behind)]
        proven = floor > EVEN_FLOOR * ambient  # with few shadows, all of them must show it
        if len(behind) > FEWEST_PIXELS:
            proven = floor > LEAST_FLOOR * ambient and np.median(behind) > LEAST_BEHIND * ambient
        if believed and proven and LEAST_AMBIENT < floor and ambient < MOST_AMBIENT:
            return replace(rest, ambient=ambient), ambient, sigma
    lit = fit
    for _ in range(3):
        reference = np.linalg.norm(lit.normals, axis=1)
        lit = fit_lambert(values, directions, patches, reference=reference)
        albedo = np.linalg.norm(lit.normals, axis=1)
    ratio = float(np.median(reference / albedo))
    ambient, sigma = lit.ambient * ratio, lit.ambient_sigma * ratio
    misfits = [float(np.median(np.abs(f.residuals) / np.linalg.norm(f.normals, axis=1))) for f in (fit, lit)]
    explained = max(LEAST_AMBIENT, SURE * sigma) < ambient < MOST_AMBIENT and misfits[1] < 0.5 * misfits[0]
    return (replace(lit, ambient=ambient), ambient, sigma) if explained else (fit, 0.0, max(sigma, abs(ambient)))


def deepest_shadows(
    values: np.ndarray, fit: Fit, albedo: np.ndarray, patches: np.ndarray
) -> tuple[float, float, float]:
    """Measure shadows relative to the albedo, see `lowest_levels`; NaN where the lamps cast none.

    In shadow is a value of less than half its prediction, or of which the model says that the lamp does not reach it.
    """
    predictions = values - fit.residuals
    shade = np.isfinite(values) & ((values < 0.5 * (predictions + fit.ambient * albedo)) | (fit.weights == 0))
    return lowest_levels(np.where(shade, values / albedo, np.nan), patches)


def lowest_levels(levels: np.ndarray, patches: np.ndarray) -> tuple[float, float, float]:
    """Measure the dark end of levels (lights, pixels), NaN where there is none: floor, its spread, usual level.

    Of each patch the darkest twentieth counts, and of these the lowest fifth is the floor: only light of the room
    raises it. It reaches hollows and rims less than the rest, so that the floor is less than its share of the albedo:
    the usual level is the median over the patches of their lower quartiles.
    """
    quantiles = [
        np.nanquantile(group, (0.05, 0.25))
        for group in (levels[:, patches == patch] for patch in np.unique(patches))
        if np.isfinite(group).sum() > 3
    ]
    if len(quantiles) < 11:  # a fifth of which is three
        return np.nan, np.nan, np.nan
    floors, quartiles = np.array(quantiles).T
    lowest = np.sort(floors)[: -(-len(floors) // 5)]
    return float(np.median(lowest)), float(np.std(lowest)), float(np.median(quartiles))


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
    gains, ambient = np.ones(lights), 0.0
    weights = known / np.maximum(median_of_lights(values), 1e-12) ** 2
    shade = np.zeros(values.shape)
    vectors = directions.reshape(lights, -1, 3)
    for turn in range(ROUNDS):
        if places is not None:
            vectors, slope = near_field(directions, places, width)
        lamps = gains[:, None, None] * vectors
        direct = filled - ambient * ambience
        normals, inverse = solve_normals(weights, direct, lamps)
        albedo = np.linalg.norm(normals, axis=1) + 1e-300
        cosine = np.einsum("jsa,sa->js", vectors, normals)
        lit, dark = lit_and_dark(known, filled, cosine, albedo)
        residual = direct - np.where(dark, 0.0, gains[:, None] * cosine)
        if turn:
            # derivatives after the ambient light and the width, then, with those after the gains, by the normal
            further = np.broadcast_to(ambience, (1, *values.shape))
            if places is not None:
                further = np.stack([further[0], gains[:, None] * np.einsum("jsa,sa->js", slope, normals)])
            of_further = np.einsum("js,kjs,jsa->ksa", weights, further, np.broadcast_to(lamps, (*values.shape, 3)))
            mixed = np.concatenate([(weights * cosine)[:, :, None] * lamps, of_further])
            solved = np.einsum("jsa,sab->jsb", mixed, inverse).reshape(len(mixed), -1)
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
            system[lights, lights] += (shade * ambience**2).sum()
            # a common factor is no gain: the normals take it
            system[:lights, :lights] += np.outer(gains, gains) * np.trace(system) / (gains @ gains)
            scores = np.concatenate([weights * cosine * residual, np.einsum("js,kjs->ks", weights * residual, further)])
            scores[lights] += (shade * residual).sum(axis=0) * ambience
            inverse_system = np.linalg.inv(system)
            pull = scores.sum(axis=1)
            pull[:lights] += held * own * (1 - gains)
            step = inverse_system @ pull
            gains, ambient = np.clip(gains + step[:lights], 1e-4, 1e4), float(ambient + step[lights])
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
    own += np.outer(at[:, lights], (shade * residual) @ ambience)
    through = np.tensordot(at, solved.reshape(len(at.T), -1, 3), 1)
    own -= np.einsum("js,ksa,jsa->kj", pull, through, np.broadcast_to(lamps, (*values.shape, 3)))
    variance[lights:] += (own**2).sum(axis=1)
    leverage = weights * np.einsum("jsa,sab,jsb->js", lamps, inverse, lamps)
    alone = residual / np.maximum(1 - leverage, 1e-2)
    return Fit(
        normals,
        gains,
        covariance[:lights, :lights],
        ambient,
        float(np.sqrt(variance[lights])),
        weights * last**2,
        residual,
        alone,
        inverse,
        last,
        width,
        float(np.sqrt(variance[-1])) if places is not None else 0.0,
    )


def near_field(vectors: np.ndarray, places: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute irradiance vectors (lights, pixels, 3) of lamps at positions (lights, 3), and their slope by the width.

    places (pixels, 3): in a picture that is 1 wide; width: of the picture, in the unit of the positions. A lamp at
    distance 1 lights the middle by 1.
    """
    to_lamp = vectors[:, None] - width * places
    distance = np.maximum(np.linalg.norm(to_lamp, axis=2)[..., None], NEAREST)
    approach = np.einsum("jsa,sa->js", to_lamp, places)[..., None]
    return to_lamp / distance**3, (3 * approach * to_lamp / distance**2 - places) / distance**3


def multiply(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Multiply first (n, k) by the transpose of second (n, k) in parts too small for the library to start threads.

    Its threads wait for each other: on a machine with other work that took ten times as long as the product.
    """
    width = max(8, 200_000 // len(first) ** 2)
    parts = []
    for matrix in (first, second):
        padded = np.pad(matrix, ((0, 0), (0, -matrix.shape[1] % width)))
        parts.append(np.ascontiguousarray(padded.reshape(len(matrix), -1, width).transpose(1, 0, 2)))
    return (parts[0] @ parts[1].transpose(0, 2, 1)).sum(axis=0)


def solve_normals(weights: np.ndarray, values: np.ndarray, lamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve for albedo times normal (pixels, 3) by weighted least squares; also the inverse matrices (pixels, 3, 3).

    weights, values (lights, pixels); lamps (lights, 1 or pixels, 3).
    """
    outer = lamps[..., :, None] * lamps[..., None, :]
    if lamps.shape[1] == 1:
        matrix = (weights.T @ outer.reshape(-1, 9)).reshape(-1, 3, 3)
        moments = (weights * values).T @ lamps[:, 0]
    else:
        matrix = np.einsum("js,jsab->sab", weights, outer)
        moments = np.einsum("js,jsa->sa", weights * values, lamps)
    matrix += (1e-9 * np.trace(matrix, axis1=1, axis2=2) + 1e-300)[:, None, None] * np.eye(3)
    inverse = np.linalg.inv(matrix)
    return np.einsum("sab,sb->sa", inverse, moments), inverse


def lit_and_dark(
    known: np.ndarray, filled: np.ndarray, cosine: np.ndarray, albedo: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Say which values (lights, pixels) the lamp lights, and which lie in attached shadow.

    In shadow by the model and in the photograph: a bright value stays, else a wrong fit would drop what it misses.
    """
    faint = known & (filled < GRAZING * albedo)
    lit = known & ~(faint & (cosine < GRAZING * albedo))
    lit = np.where(lit.sum(axis=0) > 3, lit, known)
    return lit, faint & (cosine < -GRAZING * albedo) & ~lit


def scale_of(residual: np.ndarray, lit: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Robust standard deviation (pixels,) of the residuals (lights, pixels) of lit values.

    At least that of all pixels: a pixel whose weights are gone to all but three values fits these exactly.
    """
    spread = median_of_lights(np.where(lit, np.abs(residual), np.nan))
    usual = np.nanmedian(spread / albedo)
    return np.maximum(1.4826 * np.fmax(spread, usual * albedo), LEAST_SCALE * albedo)


def median_of_lights(values: np.ndarray) -> np.ndarray:
    """Compute the median (pixels,) of values (lights, pixels) that are not NaN, faster than NumPy over few lights."""
    ordered, count = np.sort(values, axis=0), (~np.isnan(values)).sum(axis=0)
    middle = np.stack([np.maximum(count - 1, 0) // 2, count // 2])
    return np.take_along_axis(ordered, np.minimum(middle, len(values) - 1), axis=0).mean(axis=0)


def split_course(strengths: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split log strengths (lights,) into a course that is linear over the directions (lights, 3), and the rest.

    Such a course is like a tilt of the object, and matter that does not follow Lambert's law imitates it.
    """
    terms = np.column_stack([np.ones(len(directions)), directions])
    course = terms @ np.linalg.lstsq(terms, np.log(strengths), rcond=None)[0]
    return course, np.log(strengths) - course


def law_errors(misfit: float, directions: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the errors of log strengths by what the law misses, the course over the directions, and the rest.

    Covariance (lights, lights) of the part that is linear over directions (lights, 3), and variance of the rest.
    """
    linear = np.linalg.qr(directions - directions.mean(axis=0))[0]
    return (LAW_COURSE * misfit) ** 2 * len(directions) / 3 * linear @ linear.T, (LAW_REST * misfit) ** 2


def is_even(gains: np.ndarray, directions: np.ndarray) -> bool:
    """Whether the lamps that burn are as equal as lamps are: metal under equal lamps shows some ten times as strong."""
    burning = gains > FAINT
    return bool(split_course(gains[burning], directions[burning])[0].std() < MOST_COURSE)


def _compare(
    values: np.ndarray, directions: np.ndarray, patches: np.ndarray, fit: Fit, ambient: tuple[float, float]
) -> Consistency:
    """Solve for what each photograph says, given the fit to the others."""
    count = len(values)
    albedo = np.linalg.norm(fit.normals, axis=1)
    predictions = values - fit.alone - fit.ambient * albedo
    offset, offset_sigma = np.full((2, count), np.nan)
    residual, sigma_deg = np.full((2, count), np.nan)
    found = np.full((count, 3), np.nan)
    for j in range(count):
        used = np.flatnonzero(fit.weights[j] > 0)
        if len(used) < FEWEST_PIXELS:
            continue
        level = np.median(predictions[j, used])
        residual[j] = np.median(np.abs(fit.alone[j, used])) / max(level, 1e-300)
        # the normals without this photograph, by the update of the inverse for one row less
        lamp = fit.gains[j] * directions.reshape(count, -1, 3)[j]
        step = (fit.alone[j] * fit.weights[j] / fit.scale**2)[:, None] * np.einsum("sab,sb->sa", fit.inverses, lamp)
        others = fit.normals - np.where(np.isfinite(step), step, 0.0)
        target = values[j] - fit.ambient * albedo
        vector, covariance = regress(others[used], target[used], patches[used])
        length = max(float(np.linalg.norm(vector)), 1e-300)
        found[j] = vector / length
        across = np.eye(3) - np.outer(found[j], found[j])
        sigma_deg[j] = np.degrees(np.sqrt(max(np.trace(across @ covariance @ across), 0.0)) / length)
        terms = np.column_stack([predictions[j, used], albedo[used]])
        line, covariance = regress(terms, values[j, used], patches[used])
        offset[j], offset_sigma[j] = line[1], np.sqrt(max(covariance[1, 1], 0.0))
    # gains are hardly determined on a flat object, and metal is dark beside its highlights: the brightest parts decide
    level = np.nanpercentile(values - fit.ambient * albedo, 99, axis=1)
    sigma = np.sqrt(np.diag(fit.covariance))
    dark = (fit.gains + SURE * sigma < FAINT) & (level < FAINT * np.nanmedian(level))
    failed = tuple(np.flatnonzero(dark).tolist())
    repeats = _repeated(values, predictions, residual, failed)
    shown = (residual, fit.gains, sigma, offset, offset_sigma, found, sigma_deg)
    return Consistency(*shown, failed, repeats, *ambient, fit.covariance)


def regress(terms: np.ndarray, target: np.ndarray, patches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve terms (n, k) @ x = target (n,) by reweighted least squares; x (k,) and its covariance over patches."""
    weights = np.ones(len(target))
    for _ in range(ROUNDS):
        inverse = np.linalg.pinv((terms * weights[:, None]).T @ terms)
        solution = inverse @ (terms.T @ (weights * target))
        residual = target - terms @ solution
        scale = KINK * max(1.4826 * np.median(np.abs(residual)), 1e-12 + 1e-6 * np.abs(target).max())
        weights = 1 / (1 + (residual / scale) ** 2)
    groups = np.zeros((patches.max() + 1, terms.shape[1]))
    np.add.at(groups, patches, terms * (weights * residual)[:, None])
    return solution, inverse @ (groups.T @ groups) @ inverse


def _repeated(
    values: np.ndarray, predictions: np.ndarray, residual: np.ndarray, failed: tuple[int, ...]
) -> tuple[tuple[int, int], ...]:
    """Pairs of photographs that differ far less than their lamps should make them, and than neighbours do."""
    judged = [j for j in range(len(values)) if j not in failed and np.isfinite(residual[j])]
    measured, expected = (_differences(v[judged]) for v in (values, predictions))
    if not np.isfinite(measured).any():
        return ()
    # the usual distance to the nearest photograph: that of a lamp's neighbours
    usual = np.median(measured.min(axis=1))
    first, second = np.nonzero(np.triu(measured < REPEATED * np.minimum(expected, usual)))
    pairs = [(judged[i], judged[j]) for i, j in zip(first, second, strict=True)]
    return tuple(pair if residual[pair[0]] > residual[pair[1]] else pair[::-1] for pair in pairs)


def _differences(values: np.ndarray) -> np.ndarray:
    """Mean difference (lights, lights) of photographs of equal median, relative to it; inf on the diagonal."""
    level = values / np.maximum(np.nanmedian(values, axis=1, keepdims=True), 1e-300)
    table = np.full((len(values), len(values)), np.inf)
    for i, row in enumerate(level):
        table[i] = np.nanmean(np.abs(level - row), axis=1)
        table[i, i] = np.inf
    return np.where(np.isfinite(table), table, np.inf)
