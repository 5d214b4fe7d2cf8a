"""Predict every photograph of a plane scene from the others, and find where one of them disagrees.

The others are predicted by Lambert's law (`nishiki.photometric.lambert_fit`); what a photograph then says about itself
is its strength, its ambient light, its direction, whether its lamp burned, and whether it repeats another one.

Lamps at a finite distance are told from far ones by the fall-off of their light across the photographs. A pixel at x,
whose albedo times normal is m, shows m . (p_j - x) / |p_j - x|^3 under a lamp at p_j, and m . l_j under a far one. With
directions alone, p_j is l_j at a common distance, and the width of the picture in distances of the lamps is fitted
together with the gains. Far lamps assumed in place of near ones bend the relief: light that falls off towards one side
looks like a surface that turns away. Gloss under a camera that stands near wanders with the lamp as well. The width is
therefore fitted a second time without the samples near the mirror direction, and both have to agree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nishiki.photometric.lambert_fit import (
    FEWEST_LAMPS,
    GRAZING,
    KINK,
    Fit,
    dot_lamps,
    fit_lambert,
    median_of_lights,
    regress,
    return_none_if_undetermined,
    spread_pixels,
)
from nishiki.photometric.order_trials import STEEPEST, loosen

TURNS = 4  # of measuring the ambient light and fitting what it leaves
FEWEST_PIXELS = 24  # lit by a lamp: eight for each of the three numbers of its direction
FAINT = 0.1  # gain below which a photograph shows the room and the noise, not its lamp
LEAST_AMBIENT = 0.02  # of the albedo: less turns normals by less than half a degree, and lenses and walls give as much
REPEATED = 0.25  # of the difference that two lamps should make: the same lamp twice leaves the noise of the camera
MOST_AMBIENT = 0.4  # of a lamp: more cannot be told from an even object, where .41 to 1.1 seemed to be
WORSE = 2.0  # times the misfit without ambient light: shadows prove some that misfits more, up to 1.5
LEAST_FLOOR, LEAST_BEHIND = 0.3, 0.75  # of the ambient light: the darkest shadows, and the usual ones behind the object
# of the ambient light from fit to fit: .02 to .11 on six measured sets, .36 and .8 on a glossy painting
MOST_DRIFT = 0.2
EVEN_FLOOR = 0.8  # the same of the darkest shadows where few values lie behind the object
LEAST_GAIN = 0.02  # of a lamp's strength that is put right: less turns normals by a tenth of a degree
LAW_COURSE, LAW_REST = 3.0, 1.5  # times the misfit of the law: deviation of log strengths that equal lamps seem to have
# (rms of six measured sets), of the part that is linear over the directions, and of the rest
MOST_UNEQUAL, STEPS = 10.0, 50  # variance of log strengths of which nothing is known; the estimate then stands still
MEDIAN_OF_SQUARES = 0.455  # of a normal variable of variance 1
MOST_COURSE = 0.5  # deviation of log strengths that are linear over the directions: 1.1 on metal, <= .12 elsewhere
LARGEST_MISFIT = 0.1  # of the brightness: where the photographs are predicted worse, nothing is concluded from them
HIGHLIGHT = np.cos(np.radians(20.0))  # between normal and half vector: broader gloss is as good as diffuse
LEAST_MATT = 0.25  # of a lamp's samples that hold no gloss: of fewer, its strength is not determined
AGREEING = 1.4  # factor between the widths with and without the samples that may hold gloss
EXPLAINED = 0.9  # of the robust misfit that near lamps leave: a wrong law of reflection reached .96
LEAST_TURN_DEG = 2.5  # by which far lamps turn the normals in the median: gloss on a flat object reached 2.1
FEWEST_JUDGED = 8  # photographs, among which one stands out: of 5 to 7, sound ones did
# angle between a photograph's lamp as listed and as it shows: sound ones reached 7.1 degrees in selections of 8 to 12
STRANGE_DEG, DOUBTED = 8.0, 3.0  # and its standard errors: it is compared with the usual angle, too
# times the usual angle and misfit: sound ones of these sets reached 4.6 and 4.3; and times this misfit, at any angle
STRANGE_TURN, MISFITTING, STRANGE_MISFIT = 4.5, 2.0, 10.0
MOST_STRANGE = 0.1  # of the photographs: of a part of the fossil, 8 of 41 sound ones showed lamps 20 degrees off
WORST_LAW = 0.05  # of the brightness, usual misfit from which none is judged: cast shadows under low lamps look strange
# light of the room in single photographs, relative to the albedo, least where lamps are many, see `loosen`: .05 on a
# sound grey sphere; and the misfit that it leaves: .86 and more on other sound sets
LEAST_OFFSET, MOST_OFFSET, LEFT_BY_ROOM = 0.06, 0.5, 0.85
LEAST_PLAIN = 0.78  # of such a photograph's samples that hold no gloss, which lifts a flat thing as a whole
MOST_LIT = 1 / 3  # of the photographs: the others are the measure
LAW_ERROR = 0.1  # of the width, by which rough and glossy matter shift it: 0 to 0.2 under a ring of lamps
SURE = 5.0  # standard errors at which a difference counts: once in two million by chance


@dataclass(frozen=True)
class Consistency:
    """Measures of each photograph (lights,) against its prediction from the others."""

    # (lights,) float64: median of |value - prediction| over the median prediction; NaN: not predicted
    residual: np.ndarray
    # gain, gain_sigma: (lights,) float64: strength relative to the median photograph, and its standard error
    gain: np.ndarray
    gain_sigma: np.ndarray
    # offset, offset_sigma: (lights,) float64: light that does not follow the lamp, relative to the albedo under a
    # frontal lamp, and its standard error; the ambient light that all photographs share is included
    offset: np.ndarray
    offset_sigma: np.ndarray
    left: np.ndarray  # (lights,) float64: share of the robust misfit that is left where such light explains it
    direction: np.ndarray  # (lights, 3) float64: unit vector to the lamp that explains the photograph
    direction_sigma_deg: np.ndarray  # (lights,) float64: standard error of that direction, degrees
    failed: tuple[int, ...]  # photographs in which the lamp did not burn
    # tuple of (int, int): photographs of one lamp though two are stated; the first one fits its stated lamp worse
    repeats: tuple[tuple[int, int], ...]
    ambient: float  # ambient, ambient_sigma: offset that all photographs share, and its standard error
    ambient_sigma: float
    gain_covariance: np.ndarray  # (lights, lights) float64: of the gains
    matt: np.ndarray  # (lights,) float64: share of the pixels that are further than HIGHLIGHT from the mirror direction

    def holds(self, directions: np.ndarray, *, but_one: bool = False) -> bool:
        """Check whether Lambert's law predicts the photographs well enough to conclude anything from its parameters.

        directions (lights, 3); but_one: see `is_even`.
        """
        return bool(np.nanmedian(self.residual) < LARGEST_MISFIT) and is_even(self.gain, directions, but_one=but_one)

    def find_strangers(self, directions: np.ndarray) -> dict[int, float]:
        """Find photographs that contradict the others, by number, with the angle (degrees) to the lamp that they show.

        directions (lights, 3). Gloss does the same near the mirror direction: what shows little else is not judged.
        Where more than two, and more than a tenth, are strange, the object or the list of lamps is at fault: none is
        accused.
        """
        usual = np.nanmedian(self.residual)
        if not self._tells_single_ones(directions):
            return {}
        angle = np.degrees(np.arccos(np.clip((self.direction * directions).sum(axis=1), -1, 1)))
        misfit = self.residual / usual
        turned = (angle > STRANGE_TURN * np.nanmedian(angle)) & (angle > DOUBTED * self.direction_sigma_deg)
        strange = (turned & (misfit > MISFITTING)) | (misfit > STRANGE_MISFIT)
        found = np.flatnonzero(strange & (angle > STRANGE_DEG) & (self.matt > LEAST_MATT))
        return {int(j): float(angle[j]) for j in found if len(found) <= max(2, MOST_STRANGE * len(directions))}

    def find_lit(self, directions: np.ndarray) -> dict[int, float]:
        """Find photographs with light of the room that most others lack, by number, with its level as `offset`.

        directions (lights, 3). A lamp of any strength and direction does not explain them, and such light does.
        """
        if not self._tells_single_ones(directions):
            return {}
        more = self.offset - np.nanmedian(self.offset)
        plain = (self.matt > LEAST_PLAIN) & (self.offset < MOST_OFFSET)
        sure = more > np.maximum(LEAST_OFFSET * loosen(len(directions)), SURE * self.offset_sigma)
        found = np.flatnonzero(plain & sure & (self.left < LEFT_BY_ROOM))
        return {int(j): float(more[j]) for j in found if len(found) <= MOST_LIT * len(directions)}

    def _tells_single_ones(self, directions: np.ndarray) -> bool:
        """Check whether the others predict a photograph so well that one of them stands out."""
        few = len(directions) < FEWEST_JUDGED
        return not few and bool(np.nanmedian(self.residual) < WORST_LAW) and self.holds(directions)


@return_none_if_undetermined
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


def split_course(strengths: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split log strengths (lights,) into a course that is linear over the directions (lights, 3), and the rest.

    Such a course is like a tilt of the object, and matter that does not follow Lambert's law imitates it.
    """
    terms = np.column_stack([np.ones(len(directions)), directions])
    course = terms @ np.linalg.lstsq(terms, np.log(strengths), rcond=None)[0]
    return course, np.log(strengths) - course


def law_errors(misfit: float, directions: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the errors of log strengths by deviations from the law: the course over the directions, and the rest.

    Covariance (lights, lights) of the part that is linear over directions (lights, 3), and variance of the rest.
    """
    linear = np.linalg.qr(directions - directions.mean(axis=0))[0]
    return (LAW_COURSE * misfit) ** 2 * len(directions) / 3 * linear @ linear.T, (LAW_REST * misfit) ** 2


def probable_strengths(found: Consistency, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Estimate log strengths (lights,) of median 0 and their covariance (lights, lights) from the measured gains.

    Gains err by their covariance and by deviations from the law; photographs that show little but gloss tell nothing.
    Most lamps are equal and some are not: log strengths follow Student's t with 2 degrees of freedom, whose scale is
    estimated too, by expectation and maximisation (Lange, Little and Taylor, 1989).
    """
    logs = np.log(found.gain)
    course, rest = law_errors(float(np.nanmedian(found.residual)), directions)
    unknown = np.where(found.matt < LEAST_MATT, MOST_UNEQUAL, rest)
    errors = found.gain_covariance / np.outer(found.gain, found.gain) + course + np.diag(unknown)
    variance = np.full(len(logs), MOST_UNEQUAL)
    for _ in range(STEPS):
        weights = np.linalg.inv(np.diag(variance) + errors)
        strengths = variance * (weights @ (logs - (weights @ logs).sum() / weights.sum()))
        covariance = np.diag(variance) - variance[:, None] * weights * variance
        moments = strengths**2 + np.diag(covariance)
        scale = max(float(np.median(moments)) / MEDIAN_OF_SQUARES, LEAST_GAIN**2)
        variance = (moments + 2 * scale) / 3
    return strengths - np.median(strengths), covariance


def is_even(gains: np.ndarray, directions: np.ndarray, *, but_one: bool = False) -> bool:
    """Check whether strengths differ no more than those of lamps: on metal some seem ten times as strong.

    gains (lights,), directions (lights, 3); but_one: whether one of eight or more may differ by any factor, as with a
    white board that is far off. Without boards a flat glossy painting would pass as lamps of unequal strength.
    """
    burning = np.flatnonzero(gains > FAINT)
    left_out = range(len(burning)) if but_one and len(burning) >= FEWEST_JUDGED else ()
    most = [burning, *(np.delete(burning, k) for k in left_out)]
    return any(split_course(gains[some], directions[some])[0].std() < MOST_COURSE for some in most)


def _compare(
    values: np.ndarray, directions: np.ndarray, patches: np.ndarray, fit: Fit, ambient: tuple[float, float]
) -> Consistency:
    """Solve for the unknowns of each photograph, given the fit to the others."""
    count = len(values)
    albedo = np.linalg.norm(fit.normals, axis=1)
    predictions = values - fit.alone - fit.ambient * albedo
    offset, offset_sigma, left, residual, sigma_deg = np.full((5, count), np.nan)
    found = np.full((count, 3), np.nan)
    used = fit.weights > 0
    judged = used.sum(axis=1) >= FEWEST_PIXELS
    used, own, predicted, alone = used[judged], values[judged], predictions[judged], fit.alone[judged]
    size, level = (median_of_lights(np.where(used, v, np.nan).T) for v in (np.abs(alone), predicted))
    residual[judged] = size / np.maximum(level, 1e-300)
    # the normals without this photograph, by the update of the inverse for one row less
    lamps = (fit.gains[:, None, None] * directions.reshape(count, -1, 3))[judged]
    step = (alone * fit.weights[judged] / fit.scale**2)[:, :, None] * np.einsum("sab,jsb->jsa", fit.inverses, lamps)
    others = fit.normals - np.where(np.isfinite(step), step, 0.0)
    # with a lamp of any strength and direction, for what rough matter shows of its own is no light of the room
    lit_too = np.concatenate([others, np.broadcast_to(albedo[:, None], (*predicted.shape, 1))], axis=2)
    (vectors, covariance, cost), (line, errors, cost_with_room) = (
        _explain(fit, terms, target, used, patches)
        for terms, target in ((others, own - fit.ambient * albedo), (lit_too, own))
    )
    length = np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)
    found[judged] = units = vectors / length[:, None]
    across = np.eye(3) - units[:, :, None] * units[:, None]
    variance = np.trace(across @ covariance @ across, axis1=1, axis2=2)
    sigma_deg[judged] = np.degrees(np.sqrt(np.maximum(variance, 0.0)) / length)
    offset[judged], offset_sigma[judged] = line[:, 3], np.sqrt(np.maximum(errors[:, 3, 3], 0.0))
    left[judged] = cost_with_room / cost
    # gains are hardly determined on a flat object, and metal is dark beside its highlights: the brightest parts decide
    level = np.nanpercentile(values - fit.ambient * albedo, 99, axis=1)
    sigma = np.sqrt(np.diag(fit.covariance))
    dark = (fit.gains + SURE * sigma < FAINT) & (level < FAINT * np.nanmedian(level))
    failed = tuple(np.flatnonzero(dark).tolist())
    repeats = _find_repeated(values, predictions, residual, failed)
    shown = residual, fit.gains, sigma, offset, offset_sigma, left, found, sigma_deg
    matt = 1 - may_shine(directions.reshape(count, -1, 3), fit.normals).mean(axis=1)
    return Consistency(*shown, failed, repeats, *ambient, fit.covariance, matt)


def _explain(
    fit: Fit, terms: np.ndarray, target: np.ndarray, used: np.ndarray, patches: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve for photographs as `regress` does, and return their robust misfit (lights,) too."""
    solution, covariance = regress(terms, target, used, patches)
    rest = np.where(used, (target - (terms @ solution[:, :, None])[..., 0]) / (KINK * fit.scale), np.nan)
    return solution, covariance, np.nanmean(np.log1p(rest**2), axis=1)


def _find_repeated(
    values: np.ndarray, predictions: np.ndarray, residual: np.ndarray, failed: tuple[int, ...]
) -> tuple[tuple[int, int], ...]:
    """Find pairs of photographs that differ far less than their lamps should make them, and than neighbours do."""
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
    """Compute the mean difference (lights, lights) of photographs of equal median, relative to it; diagonal: inf."""
    level = values / np.maximum(np.nanmedian(values, axis=1, keepdims=True), 1e-300)
    table = np.nanmean(np.abs(level[:, None] - level), axis=2)
    return np.where(np.isfinite(table) & ~np.eye(len(level), dtype=bool), table, np.inf)


@dataclass(frozen=True)
class NearLamps:
    """Estimate of the lamps' distance from photographs."""

    # width, sigma: width of the picture in the unit of the vectors to the lamps, and its standard error with that of
    # the law
    width: float
    sigma: float
    left: float  # share of the robust misfit under far lamps that is left under near ones
    misfit: float  # median misfit under near lamps, relative to the albedo
    agrees: bool  # whether samples without gloss give the same width
    turn_deg: float  # median angle by which far lamps in place of near ones turn the normals
    # height by which they lower the edge of a flat object below its middle, in widths of the picture; negative where
    # they raise it
    bow: float
    # (lights,) float64: strengths of the lamps where the distances are those of their vectors, of median 1
    gains: np.ndarray
    even: bool  # whether these strengths are those of lamps, see `nishiki.photometric.consistency.is_even`

    @property
    def is_certain(self) -> bool:
        """Return whether the lamps are near beyond doubt."""
        sure = self.width > SURE * self.sigma and self.left < EXPLAINED
        return sure and self.agrees and self.even and self.misfit < LARGEST_MISFIT

    @property
    def matters(self) -> bool:
        """Return whether the lamps are near, and far lamps in their place would turn the normals."""
        return self.is_certain and self.turn_deg > LEAST_TURN_DEG


@return_none_if_undetermined
def measure_width(values: np.ndarray, vectors: np.ndarray) -> NearLamps | None:
    """Fit the width of the picture in the unit of the lamps' vectors.

    Parameters
    ----------
    values : (lights, rows, columns)
        Linear values of reduced photographs, NaN where saturated or outside of the object.
    vectors : (lights, 3)
        Positions of the lamps from the middle of the picture, in any unit, or unit directions.

    Returns
    -------
    NearLamps or None
        None where nothing can be predicted.
    """
    places, patches = spread_pixels(values)
    if len(vectors) <= FEWEST_LAMPS or len(places) < FEWEST_PIXELS:
        return None
    unit = float(np.median(np.linalg.norm(vectors, axis=1)))
    vectors = vectors / unit
    directions = _unit(vectors)
    rows, columns = values.shape[1:]
    row, column = np.divmod(places, columns)
    x = np.column_stack([(column + 0.5) / columns - 0.5, (rows / 2 - row - 0.5) / columns, np.zeros(len(row))])
    chosen = values.reshape(len(vectors), -1)[:, places].astype(np.float64)
    near = fit_lambert(chosen, vectors, patches, places=x)
    if not np.isfinite(near.width):
        return None
    far, first = fit_lambert(chosen, directions, patches), near.width
    if near.width > SURE * near.width_sigma:
        matt = np.where(may_shine(directions[:, None], near.normals), np.nan, chosen)
        matt[np.isfinite(matt).mean(axis=1) < LEAST_MATT] = np.nan
        usable = np.isfinite(matt).sum(axis=0) > FEWEST_LAMPS
        if usable.sum() < FEWEST_PIXELS:
            usable[:], matt = True, chosen
        chosen, patches, x = matt[:, usable], patches[usable], x[usable]
        near, far = fit_lambert(chosen, vectors, patches, places=x), fit_lambert(chosen, directions, patches)
    scale = np.minimum(near.scale, far.scale)
    cost = [np.nanmean(np.log1p((_residuals(fit) / (KINK * scale)) ** 2)) for fit in (far, near)]
    before, after = _unit(far.normals), _unit(near.normals)
    turned = np.degrees(np.arccos(np.clip((before * after).sum(axis=1), -1, 1)))
    slopes = [-n[:, :2] / np.maximum(n[:, 2:], STEEPEST) for n in (before, after)]
    middle = x[:, :2] - x[:, :2].mean(axis=0)
    bend = ((slopes[0] - slopes[1]) * middle).sum() / (middle**2).sum()
    return NearLamps(
        unit * near.width,
        unit * float(np.hypot(near.width_sigma, LAW_ERROR * near.width)),
        float(cost[1] / max(cost[0], 1e-12)),
        float(np.nanmedian(np.abs(_residuals(near)) / np.linalg.norm(near.normals, axis=1))),
        bool(near.width > 0 and 1 / AGREEING < first / near.width < AGREEING),
        float(np.median(turned)),
        -float(bend) / 8,  # of a paraboloid over half the width
        near.gains,
        is_even(near.gains, directions),
    )


def may_shine(lamps: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Find the values (lights, pixels) near the mirror direction of lamps (lights, pixels or 1, 3)."""
    halves = _unit(np.add(_unit(lamps), (0.0, 0.0, 1.0)))
    return dot_lamps(halves, _unit(normals)) > HIGHLIGHT


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _residuals(fit: Fit) -> np.ndarray:
    """Return the residuals (lights, pixels) of lit values, NaN elsewhere."""
    return np.where(fit.weights > 0, fit.residuals, np.nan)
