"""Find photographs of a plane scene that were saved with another tone curve than the rest.

Lambert's law explains the photographs together where all are linear. Half of them coded for a screen leave no single
photograph that contradicts the others, but their misfit falls once these are decoded. Parts in which people export
photographs are tried, and the best one is refined photograph by photograph.
"""

import numpy as np

from nishiki.photometric.arrangement import measure_in_errors
from nishiki.photometric.consistency import FEWEST_JUDGED, FEWEST_PIXELS, SURE, WORST_LAW
from nishiki.photometric.lambert_fit import fit_lambert, median_of_lights, return_none_if_undetermined, spread_pixels

GAMMA = 2.2  # exponent that decodes a curve for screens: sRGB, Adobe RGB and most developed pictures are near it
CLEARLY = 0.3  # mean log of the misfit before over that after decoding: -.3 and less on sound sets


@return_none_if_undetermined
def find_coded(values: np.ndarray, lamps: np.ndarray) -> np.ndarray | None:
    """Find the photographs that have another tone curve than the others.

    Parameters
    ----------
    values : (lights, rows, columns)
        Linear values of the reduced photographs, NaN where unusable.
    lamps : (lights, 3) or (lights, rows, columns, 3)
        Vectors to the lamps as stated, see `nishiki.photometric.consistency.examine_photographs`.

    Returns
    -------
    (lights,) bool or None
        Photographs that are coded; none where nothing is found; None where nothing can be told.
    """
    places, patches = spread_pixels(values)
    if len(values) < FEWEST_JUDGED or len(places) < FEWEST_PIXELS:
        return None
    count, chosen = len(values), values.reshape(len(values), -1)[:, places].astype(np.float64)
    vectors = lamps if lamps.ndim == 2 else lamps.reshape(count, -1, 3)[:, places]
    none, decoded_all = np.zeros(count, bool), np.maximum(chosen / np.nanmax(chosen), 0) ** GAMMA
    # as bright as before, so that misfits keep their size
    decoded_all *= (np.nanmedian(chosen, axis=1) / np.maximum(np.nanmedian(decoded_all, axis=1), 1e-300))[:, None]

    def fit(coded: np.ndarray) -> np.ndarray:
        """Fit the photographs after decoding some, and return the misfit (patches,) relative to the brightness."""
        decoded = np.where(coded[:, None], decoded_all, chosen)
        alone = np.where(np.isfinite(decoded), np.abs(fit_lambert(decoded, vectors, patches).alone), np.nan)
        misfit = median_of_lights(alone) / np.nanmean(decoded, axis=0)
        return np.array([np.nanmedian(misfit[patches == patch]) for patch in np.unique(patches)])

    number = np.arange(count)
    # cast shadows and gloss count for less where all are decoded: that is no evidence of another curve
    before = min((fit(none), fit(~none)), key=lambda each: float(np.nanmean(np.log(each))))
    parts = [number < count * share for share in (1 / 3, 1 / 2, 2 / 3)] + [number % 2 == 0]
    trials = [(fit(part), part) for each in parts for part in (each, ~each)]
    after, best = min(trials, key=lambda trial: float(np.nanmean(np.log(trial[0]))))
    if np.nanmean(np.log(before / after)) < CLEARLY / 2:
        return none
    for j in number:
        other = best ^ (number == j)
        left = fit(other)
        if np.nanmean(np.log(after / left)) > 0:
            after, best = left, other
    gain = np.log(before / after)
    sure = measure_in_errors(gain) > SURE and np.nanmean(gain) > CLEARLY and np.nanmedian(after) < WORST_LAW
    return best if sure else none
