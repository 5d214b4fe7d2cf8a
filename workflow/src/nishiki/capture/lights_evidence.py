"""What photographs say about the numbers of a lights file: far directions, near positions, angles, strengths.

A pixel whose albedo times normal is b shows b . l_j under the far lamp j, and b . (p_j - x) / |p_j - x|^3 under a lamp
at p_j (x: the pixel's place in the picture's plane). b has three unknowns; with more lamps than that, the residual of
least squares tells which reading of the numbers is right, and how wide the picture is in their unit (Woodham, 1980).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nishiki.formats.coarse_pictures import read_coarse
from nishiki.formats.exif import Exif
from nishiki.formats.image_headers import read_header

SIDE = 40  # samples along the longer side of the picture
MOST_PHOTOGRAPHS = 32  # read, spread over the lamps
FEWEST_PHOTOGRAPHS = 5
DARK, BRIGHT = 0.05, 0.97  # of a sample's brightest value: shadow; of the largest value: saturation
TRIMMED = 0.8  # share of the samples whose fit counts: the others hold cast shadows and gloss
WIDTHS = np.geomspace(0.05, 4.0, 30)  # of the picture, in median distances of the lamps
CLEARLY = 0.85  # ratio of residuals below which one reading is better, beyond noise and gloss
AS_WELL = 0.97  # ratio of residuals above which one reading is no better
TRIED_WIDTH = 0.5  # of the lamps' distance: near lamps that would show if there were any
DOUBT = 1.5  # factor by which a width must be wrong to fit clearly worse, for the photographs to show it
MILLIMETRES = (40.0, 5000.0)  # distance of lamps whose unit is taken to be the millimetre
UNITS = {"millimetres": 1.0, "centimetres": 10.0, "inches": 25.4, "metres": 1000.0}


@dataclass(frozen=True)
class Samples:
    """Samples of photographs.

    Attributes
    ----------
    values : (photographs, samples) float64
        Linear mean of the channels, NaN where shadow or saturated.
    places : (samples, 3) float64
        From the centre of the picture, x right, y up, z 0; the picture is 1 wide.
    chosen : (photographs,) int
        Number of each photograph among those given.
    """

    values: np.ndarray
    places: np.ndarray
    chosen: np.ndarray


def sample_photographs(photographs: Sequence[Path], encoding: str | None) -> Samples | None:
    """Read samples on a grid; None where the photographs are too few or of several sizes.

    CaptureError where one cannot be decoded.
    """
    if len(photographs) < FEWEST_PHOTOGRAPHS:
        return None
    chosen = np.unique(np.linspace(0, len(photographs) - 1, MOST_PHOTOGRAPHS).round().astype(int))
    pictures = [read_coarse(photographs[i], SIDE, encoding) for i in chosen]
    if len({picture.shape for picture in pictures}) > 1:
        return None
    rows, columns = pictures[0].shape
    stored = np.array(pictures).reshape(len(chosen), -1)
    lit = (stored > DARK * stored.max(axis=0)) & (stored < BRIGHT * max(float(stored.max()), 1e-9))
    row, column = np.divmod(np.arange(stored.shape[1]), columns)
    places = np.column_stack([(column + 0.5) / columns - 0.5, (rows / 2 - row - 0.5) / columns, np.zeros(len(row))])
    exposures = [_exposure(read_header(photographs[i]).exif) for i in chosen]
    if all(exposures):
        stored = stored / np.array(exposures)[:, None] * np.median(exposures)
    return Samples(np.where(lit, stored, np.nan), places, chosen)


def _exposure(exif: Exif) -> float:
    """Exposure by the camera's own record, in seconds at ISO 1 and f/1; 0 where it has none."""
    return (exif.exposure_s or 0.0) * (exif.iso or 1.0) / (exif.f_number or 1.0) ** 2


def residual_of(samples: Samples, lights: np.ndarray) -> float:
    """Relative residual of least squares under lights (photographs, 3), or (photographs, samples, 3) where they are
    near; infinite where too few samples are lit."""
    lights = lights[samples.chosen]
    field = np.broadcast_to(lights[:, None] if lights.ndim == 2 else lights, (*samples.values.shape, 3))
    lit = np.isfinite(samples.values)
    usable = lit.sum(axis=0) >= FEWEST_PHOTOGRAPHS - 1
    if usable.sum() < FEWEST_PHOTOGRAPHS:
        return np.inf
    weights, values = lit[:, usable].astype(float), np.nan_to_num(samples.values[:, usable])
    field = field[:, usable]
    normal = np.einsum("js,jsa,jsb->sab", weights, field, field)
    normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    body = np.linalg.solve(normal, np.einsum("js,js,jsa->sa", weights, values, field)[..., None])[..., 0]
    left = ((weights * (values - np.einsum("jsa,sa->js", field, body))) ** 2).sum(axis=0)
    relative = np.sort(left / np.maximum((weights * values**2).sum(axis=0), 1e-12))
    return float(np.sqrt(relative[: max(int(TRIMMED * len(relative)), 1)].mean()))


def near_field(vectors: np.ndarray, places: np.ndarray, width: float) -> np.ndarray:
    """Irradiance vectors (lights, samples, 3) of lamps at positions (lights, 3), in their unit like the width; 1 where
    a lamp at the median distance shines on the middle."""
    to_lamp = vectors[:, None] - width * places
    distance = np.linalg.norm(to_lamp, axis=2)[..., None]
    return to_lamp * (np.median(np.linalg.norm(vectors, axis=1)) ** 2 / distance**3)


@dataclass(frozen=True)
class Verdict:
    """Whether photographs show near lamps at some positions, or far ones in those directions; both may stay open.

    Attributes
    ----------
    near, far : bool
        One explains the photographs clearly better, and the other would have shown.
    width_mm : float
        Of the photographs on the object, where lamps are near; 0 where they do not show it.
    factor : float
        Millimetres a unit of the positions; 0 where it is not known.
    unit : str
        Name of that unit.
    """

    near: bool
    far: bool
    width_mm: float = 0.0
    factor: float = 0.0
    unit: str = ""


def judge(
    samples: Samples, vectors: np.ndarray, strengths: np.ndarray | None, columns: int, width_mm: float | None
) -> Verdict:
    """Compare vectors (lights, 3) as directions and as positions, also where the lamps have strengths or factors.

    columns : of the photographs; width_mm : on the object, where the user states it.
    """
    from scipy.optimize import minimize_scalar

    powers = (0,) if strengths is None or not (strengths > 0).all() else (0, 1, -1)
    mean = np.ones(len(vectors)) if strengths is None else strengths.mean(axis=1)
    trials = [samples.values * mean[samples.chosen, None] ** power for power in powers]
    lengths = np.linalg.norm(vectors, axis=1)
    distance = float(np.median(lengths))

    def misfit(width: float) -> float:
        field = near_field(vectors, samples.places, width) if width else vectors / lengths[:, None]
        return min(residual_of(replace(samples, values=values), field) for values in trials)

    far_fit = misfit(0.0)
    if width_mm:
        units = {**UNITS, "pixels": width_mm / columns}
        fits = {name: misfit(width_mm / factor) for name, factor in units.items()}
        unit = min(fits, key=lambda name: fits[name])
        unit = "millimetres" if fits["millimetres"] * AS_WELL <= fits[unit] else unit
        near_fit, width, factor = fits[unit], width_mm, units[unit]
    else:
        best = int(np.argmin([misfit(distance * each) for each in WIDTHS]))
        around = np.log(WIDTHS[[max(best - 1, 0), min(best + 1, len(WIDTHS) - 1)]])
        found = minimize_scalar(
            lambda log: misfit(distance * float(np.exp(log))), bounds=around, method="bounded", options={"xatol": 1e-3}
        )
        near_fit, width = float(found.fun), distance * float(np.exp(found.x))
        shown = min(misfit(width / DOUBT), misfit(width * DOUBT)) * AS_WELL > near_fit
        known = MILLIMETRES[0] <= distance <= MILLIMETRES[1] and abs(width / columns - 1) > 0.15
        unit, factor = ("millimetres", 1.0) if known and shown else ("", 0.0)
    far = near_fit > AS_WELL * far_fit and misfit(TRIED_WIDTH * distance) * CLEARLY > far_fit
    return Verdict(near_fit < CLEARLY * far_fit, far, width if factor else 0.0, factor, unit)
