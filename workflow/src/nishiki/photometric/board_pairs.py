"""Find which white boards belong to which photographs, by the strengths that the photographs show.

With lamp strength s_i(x), direction l_i and a board at angle theta_i (Lambert, 1760),

    photograph P_i = s_i (m . l_i)        board B_i = s_i cos(theta_i)

so that P_i cos(theta_i) / B_i follows Lambert's law with gains of 1, whatever the strengths. Divided by the board of
another lamp it has the gain B_i / B_j and its course over the picture. Of each photograph the logarithm of its gain and
the slope of what remains across and down the picture are measured; the same three numbers of every board say what
another board would make of them. The linear assignment problem (Kuhn, 1955) over the squared differences, in units of
the standard error and at most those at which a difference counts, gives the boards; a photograph leaves its own board
only where that gains half as much, so that an exchange of two must be sure as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.photometric import consistency, lambert_fit

FIRST, HOLD = 1.0, 0.001  # of the information on a gain, that it is 1: first firmly, for the normals that most lamps
# agree on, then hardly: those of a flat object would drift to any tilt of it
FREE, FITS, TURNS = 2, 5, 4  # fits after which any order is taken, most fits, and assignments after each
TWICE = 2.0  # times the usual error of the law: strengths and slopes of single measured sets exceed five of these
COMMON = 100.0  # variance of the factor that all log gains share, which says nothing
ALONE = np.log(1.6)  # log gain of one photograph from which it is named
GRAZED, FACING = 0.3, 0.9  # cosines of the lamp beyond which shadows make a photograph darker, or gloss brighter


@dataclass(frozen=True)
class BoardPairs:
    """The boards that belong to the photographs."""

    board: np.ndarray  # (lights,) int64: the lamp whose board each photograph shows; its own where nothing is gained
    # before, after: (lights,) float64: logarithms of the photographs' gains with their own boards, and with these
    before: np.ndarray
    after: np.ndarray
    alone: np.ndarray  # (lights,) bool: photographs that no board explains


@lambert_fit.return_none_if_undetermined
def pair_boards(values: np.ndarray, boards: np.ndarray, lamps: np.ndarray) -> BoardPairs | None:
    """Find the boards that belong to the photographs.

    Parameters
    ----------
    values : (lights, rows, columns)
        Linear values of the reduced photographs divided by their boards, NaN where unusable.
    boards : (lights, rows, columns)
        Linear values of the boards at equal exposure.
    lamps : (lights, 3) or (lights, rows, columns, 3)
        Vectors to the lamps as stated, see `nishiki.photometric.consistency.examine_photographs`.

    Returns
    -------
    BoardPairs or None
        None where nothing can be told: too few lamps or pixels, or an object that does not follow Lambert's law.
    """
    from scipy.optimize import linear_sum_assignment

    count, rows, columns = values.shape
    places, patches = lambert_fit.spread_pixels(values)
    whites, divided = (stack.reshape(count, -1)[:, places].astype(np.float64) for stack in (boards, values))
    if count < lambert_fit.FEWEST_LAMPS or np.isfinite(np.log(whites)).sum(axis=1).min() < consistency.FEWEST_PIXELS:
        return None
    photographs = divided * whites
    vectors = lamps if lamps.ndim == 2 else lamps.reshape(count, -1, 3)[:, places]
    lamps = vectors.reshape(count, -1, 3)
    directions = lamps.mean(axis=1)
    down, across = np.divmod(places, columns)
    terms = np.stack([np.ones(len(places)), across - across.mean(), down - down.mean()], axis=1) / (1, columns, rows)
    of_boards = lambert_fit.regress(terms[None], np.log(whites), np.isfinite(np.log(whites)), patches)[0].T
    photographs = _without_gloss(photographs, whites, lamps, patches, terms)
    listed = order = np.arange(count)
    stay = consistency.SURE**2 / 2 * (1 - np.eye(count))
    for fits in range(FITS):
        fit = lambert_fit.fit_lambert(photographs / whites[order], lamps, patches, hold=HOLD if fits else FIRST)
        misfit, of_photographs = _measure(photographs / whites[order], fit, terms, patches)
        shown, last = of_photographs + of_boards[:, order], order
        course, variance = consistency.law_errors(TWICE * misfit, directions)
        covariances = np.stack([course + COMMON] * len(shown))
        covariances[0] += fit.covariance / np.outer(fit.gains, fit.gains)
        for turn in range(TURNS):
            gains = shown - of_boards[:, order]
            rest, least = gains - gains.mean(axis=1, keepdims=True), variance + consistency.LEAST_GAIN**2
            if fits + turn:  # at first the mean is right in any order of the boards
                # less the best linear prediction of the part that the law correlates; the rest is more of outliers
                rest = gains - np.median(gains, axis=1, keepdims=True)
                for _ in range(lambert_fit.ROUNDS):
                    own = (least + np.square(rest / lambert_fit.KINK))[:, :, None] * np.eye(count)
                    rest = (own @ np.linalg.solve(covariances + own, gains[:, :, None]))[:, :, 0]
            spread = np.maximum(least, (1.4826 * np.median(np.abs(rest), axis=1)) ** 2)
            levels = rest + of_boards[:, order]
            squares = np.square(levels[:, :, None] - of_boards[:, None, :]) / spread[:, None, None]
            cost = np.minimum(squares.sum(axis=0), consistency.SURE**2)
            if not np.isfinite(cost).all():
                return None
            order = linear_sum_assignment(cost if fits < FREE else cost + stay)[1]
        if fits >= FREE and (order == last).all():
            break
    if not (misfit < consistency.LARGEST_MISFIT and consistency.is_even(fit.gains, directions, but_one=True)):
        return None
    before, after = (levels[0] - of_boards[0, some] for some in (listed, order))
    facing = directions[:, 2]
    alone = (order == listed) & (np.abs(before) > np.maximum(ALONE, consistency.SURE * np.sqrt(spread[0])))
    alone &= np.where(before < 0, facing > GRAZED, facing < FACING)
    return BoardPairs(order, before, after, alone)


def _without_gloss(
    photographs: np.ndarray, whites: np.ndarray, lamps: np.ndarray, patches: np.ndarray, terms: np.ndarray
) -> np.ndarray:
    """Leave out values near the mirror direction where that leaves some of every lamp, and less misfit.

    photographs, whites (lights, pixels); lamps (lights, pixels or 1, 3); patches, terms: see `_measure`.
    """
    fit = lambert_fit.fit_lambert(photographs / whites, lamps, patches, hold=FIRST)
    matt = np.where(consistency.may_shine(lamps, fit.normals), np.nan, photographs)
    few = np.isfinite(matt).sum(axis=0) < lambert_fit.FEWEST_LAMPS
    matt[:, few] = photographs[:, few]
    left, known = (np.isfinite(each).sum(axis=1) for each in (matt, photographs))
    if (left < np.maximum(consistency.LEAST_MATT * known, 2 * consistency.FEWEST_PIXELS)).any():
        return photographs
    fits = [(photographs, fit), (matt, lambert_fit.fit_lambert(matt / whites, lamps, patches, hold=FIRST))]
    return min(fits, key=lambda each: _measure(each[0] / whites, each[1], terms, patches)[0])[0]


def _measure(
    values: np.ndarray, fit: lambert_fit.Fit, terms: np.ndarray, patches: np.ndarray
) -> tuple[float, np.ndarray]:
    """Measure the usual misfit of photographs (lights, pixels), their log gains and slopes (3, lights).

    Of photographs that show too little, which keep their boards, these are 0.
    """
    predictions = values - fit.alone
    shown, used = np.zeros((3, len(values))), fit.weights > 0
    judged = used.sum(axis=1) >= consistency.FEWEST_PIXELS
    predictions, used = predictions[judged], used[judged]
    sizes, levels = (
        lambert_fit.median_of_lights(np.where(used, v, np.nan).T) for v in (np.abs(fit.alone[judged]), predictions)
    )
    factors, _ = lambert_fit.regress(predictions[:, :, None] * terms, values[judged], used, patches)
    first = np.maximum(factors[:, 0], lambert_fit.GRAZING**2)
    shown[:, judged] = np.log(fit.gains[judged] * first), *(factors[:, 1:].T / first)
    return float(np.nanmedian(sizes / levels)), shown
