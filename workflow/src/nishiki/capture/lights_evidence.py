"""What photographs say about the numbers of a lights file: far directions, near positions, angles, strengths.

The photographs, reduced to a few hundred samples, are fitted by Lambert's law with a free strength of every lamp; what
is left, the width of the picture in the unit of the lamps, and the strengths tell which reading is right.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.formats.images import read_coarse, read_header
from nishiki.photometric.consistency import SURE, split_course
from nishiki.photometric.lambert_fit import fit_lambert, none_where_undetermined, spread_pixels
from nishiki.photometric.near_lamps import NearLamps, measure_width

SIDE = 40  # samples along the longer side of the picture
MOST_PHOTOGRAPHS = 32  # read, spread over the lamps
FEWEST_PHOTOGRAPHS = 5  # of a folder whose lamps are judged by them
BRIGHT = 0.97  # of the largest value: saturation
CLEARLY = 0.85  # ratio of misfits below which one reading is better, beyond noise and gloss
TRIED_WIDTH = 0.5  # of the lamps' distance: near lamps that would show if there were any
MILLIMETRES = (40.0, 5000.0)  # distance of lamps whose unit is taken to be the millimetre
UNITS = {"millimetres": 1.0, "centimetres": 10.0, "inches": 25.4, "metres": 1000.0}
SAME_UNIT = 0.2  # by which a width may be off for its unit to be known
OFF_UNIT = 0.1  # of lengths from 1: nearer, vectors state directions alone, and their unit is the lamps' distance
LEAST_STRENGTH = 0.01  # by which strengths differ that can be told from noise


@dataclass(frozen=True)
class PhotoSamples:
    """Samples of photographs."""

    values: np.ndarray  # (photographs, rows, columns) float64: linear mean of the channels, NaN where saturated
    chosen: np.ndarray  # (photographs,) int: number of each photograph among those given


def sample_photographs(photographs: Sequence[Path], encoding: str | None) -> PhotoSamples | None:
    """Read samples on a grid; None where the photographs are too few or of several sizes.

    CaptureError where one cannot be decoded.
    """
    if len(photographs) < FEWEST_PHOTOGRAPHS:
        return None
    chosen = np.unique(np.linspace(0, len(photographs) - 1, MOST_PHOTOGRAPHS).round().astype(int))
    pictures = [read_coarse(photographs[i], SIDE, encoding) for i in chosen]
    if len({picture.shape for picture in pictures}) > 1:
        return None
    stored = np.array(pictures, np.float64)
    values = np.where(stored < BRIGHT * max(float(stored.max()), 1e-9), stored, np.nan)
    records = [read_header(photographs[i]).exif for i in chosen]
    exposures = [(e.exposure_s or 0.0) * (e.iso or 1.0) / (e.f_number or 1.0) ** 2 for e in records]
    if all(exposures):
        values = values / np.array(exposures)[:, None, None] * np.median(exposures)
    return PhotoSamples(values, chosen)


@none_where_undetermined
def misfit_of(samples: PhotoSamples, directions: np.ndarray) -> float | None:
    """Median misfit relative to the albedo under lamps in these directions (lights, 3)."""
    places, patches = spread_pixels(samples.values)
    values = samples.values.reshape(len(samples.values), -1)[:, places]
    fit = fit_lambert(values, directions[samples.chosen], patches)
    return float(np.nanmedian(np.abs(fit.residuals) / np.linalg.norm(fit.normals, axis=1)))


@dataclass(frozen=True)
class Verdict:
    """Whether photographs show near lamps at some positions, or far ones in those directions; both may stay open."""

    near: bool  # near, far: one explains the photographs clearly better, and the other would have shown
    far: bool
    width_mm: float = 0.0  # of the photographs on the object, where lamps are near; 0 where they do not show it
    factor: float = 0.0  # millimetres a unit of the positions; 0 where it is not known
    unit: str = ""  # name of that unit


def judge(samples: PhotoSamples, vectors: np.ndarray, columns: int, width_mm: float | None) -> Verdict:
    """Compare vectors (lights, 3) as directions and as positions, of lamps of any strength.

    columns : of the photographs; width_mm : on the object, where the user states it.
    """
    vectors = vectors[samples.chosen]
    lengths = np.linalg.norm(vectors, axis=1)
    found, distance = measure_width(samples.values, vectors), float(np.median(lengths))
    if found is None:
        return Verdict(False, False)
    if not found.shown:
        return Verdict(False, found.width + SURE * found.sigma < TRIED_WIDTH * distance)
    if width_mm:
        exact = width_mm / found.width
        units = {**UNITS, "pixels": width_mm / columns}
        unit = min(units, key=lambda name: (abs(np.log(exact / units[name])), name))
        if abs(np.log(exact / units[unit])) < SAME_UNIT and np.abs(lengths - 1).max() > OFF_UNIT:
            return Verdict(True, False, width_mm, units[unit], unit)
        return Verdict(True, False, width_mm, exact, f"units of {exact:.4g} mm")
    known = MILLIMETRES[0] <= distance <= MILLIMETRES[1] and abs(found.width / columns - 1) > SAME_UNIT
    return Verdict(True, False, found.width, 1.0, "millimetres") if known else Verdict(True, False)


def choose_strengths(
    samples: PhotoSamples, vectors: np.ndarray, candidates: dict[str, np.ndarray], *, near: bool
) -> tuple[str, dict[str, float]]:
    """Choose the strengths (lights,) of the lamps that the photographs show, by name, and tell what each leaves.

    near: vectors (lights, 3) are positions, at which a lamp of strength 1 lights the middle by the inverse square of
    its distance. A course of strengths that is linear over the directions is like a tilt of the object, and left out.
    """
    found = measure_gains(samples, vectors, near=near)
    if found is None:
        return "", {}
    directions = vectors[samples.chosen] / np.linalg.norm(vectors[samples.chosen], axis=1, keepdims=True)
    left = {}
    for name, strengths in candidates.items():
        _, rest = split_course(found / strengths[samples.chosen], directions)
        left[name] = float(np.hypot(LEAST_STRENGTH, np.sqrt(np.mean(rest**2))))
    return min(left, key=lambda name: left[name]), left


@none_where_undetermined
def measure_gains(samples: PhotoSamples, vectors: np.ndarray, *, near: bool) -> np.ndarray | None:
    """Strengths (photographs,) of the lamps, see `choose_strengths`."""
    lamps = vectors[samples.chosen]
    if near:
        found: NearLamps | None = measure_width(samples.values, lamps)
        return None if found is None else found.gains
    places, patches = spread_pixels(samples.values)
    directions = lamps / np.linalg.norm(lamps, axis=1, keepdims=True)
    return fit_lambert(samples.values.reshape(len(lamps), -1)[:, places], directions, patches).gains
