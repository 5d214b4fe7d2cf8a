"""Compute errors of maps against truth: normals, height and reflectance, and summaries of sets of errors."""

import itertools
from dataclasses import asdict, dataclass

import numpy as np

from nishiki.colour.colour import delta_e_2000, illuminant, white_xyz, xyz_matrix, xyz_to_lab
from nishiki.colour.sampling import SPECTRAL_ROWS
from nishiki.errors import UserError
from nishiki.photometric.flags import NO_ESTIMATE
from nishiki.threads import strips


@dataclass(frozen=True)
class Summary:
    """Errors of a set of pixels; the figures are None where the set is empty."""

    count: int  # pixels in the set
    mean: float | None
    median: float | None
    p90: float | None
    worst: float | None
    dropped: int = 0  # values that were not finite and are in no figure


def summarise(values: np.ndarray, *, where: np.ndarray | None = None) -> Summary:
    """Summarise an array of errors, any shape; `where` (same shape, bool) selects the pixels that count.

    Percentiles interpolate linearly between ranks. The sum is taken in float64.
    """
    chosen = np.asarray(values).ravel() if where is None else np.asarray(values)[np.asarray(where)]
    finite = np.isfinite(chosen)
    dropped = int(chosen.size - np.count_nonzero(finite))
    if dropped:
        chosen = chosen[finite]
    if chosen.size == 0:
        return Summary(0, None, None, None, None, dropped)
    median, p90 = np.percentile(chosen, (50, 90))
    mean = np.mean(chosen, dtype=np.float64)
    return Summary(chosen.size, float(mean), float(median), float(p90), float(chosen.max()), dropped)


class Pool:
    """Summary of many maps of errors, without storing them: memory does not grow with their number.

    Median and percentile come from bins of 0.01 (errors above 200 count as 200 there) and are exact to half a bin;
    mean, count and largest value are exact.
    """

    BIN, END = 0.01, 200.0

    def __init__(self):
        self.bins = np.zeros(round(self.END / self.BIN), np.int64)
        self.count, self.total, self.worst = 0, 0.0, None

    def add(self, values: np.ndarray) -> None:
        """Add errors of any shape, >= 0; infinite and NaN ones are omitted."""
        for part in np.array_split(np.asarray(values).ravel(), max(1, np.size(values) >> 20)):
            part = part[np.isfinite(part)]
            if part.size:
                places = np.minimum((part / self.BIN).astype(np.int64), self.bins.size - 1)
                self.bins += np.bincount(places, minlength=self.bins.size)
                self.count += part.size
                self.total += float(part.sum(dtype=np.float64))
                self.worst = max(float(part.max()), self.worst or 0.0)

    def summary(self) -> Summary:
        """Return figures of everything added so far."""
        if not self.count:
            return Summary(0, None, None, None, None)
        return Summary(self.count, self.total / self.count, self._percentile(50), self._percentile(90), self.worst)

    def _percentile(self, percent: float) -> float:
        below = np.searchsorted(np.cumsum(self.bins), percent / 100 * self.count, side="left")
        return min(round((float(below) + 0.5) * self.BIN, 6), self.worst or 0.0)


SLOPE_EDGES_DEG = (0.0, 10.0, 20.0, 30.0, 50.0, 90.0)
"""Edges of the classes of the angle between true normal and z."""


@dataclass(frozen=True)
class NormalErrors:
    """Angles between estimated and true normals, degrees."""

    map_deg: np.ndarray  # (rows, columns) float32, NaN where there is no truth
    inside: Summary  # all pixels with a truth, those without an estimate included
    estimated: Summary  # those with one
    unflagged: Summary  # unflagged, flagged: the estimated ones without and with a flag
    flagged: Summary
    by_slope: dict[tuple[float, float], Summary]  # (from, to) in degrees of the true slope -> estimated pixels
    no_estimate: int  # pixels inside without one

    def as_dict(self) -> dict:
        """Return plain values, for JSON."""
        sets = ("inside", "estimated", "unflagged", "flagged")
        return {
            **{name: asdict(getattr(self, name)) for name in sets},
            "by_slope": [{"from_deg": a, "to_deg": b, **asdict(s)} for (a, b), s in self.by_slope.items()],
            "no_estimate": self.no_estimate,
        }


def angular_error_deg(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Compute the angle between directions (..., 3), degrees, float32; NaN where either is zero or not finite.

    2 atan2(|a - b|, |a + b|) of the unit vectors (Kahan, "How futile are mindless assessments of roundoff", 2006):
    exact to rounding for every angle, where acos(a . b) loses half of the digits below 1e-4 rad.
    """
    a, b = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        a = a / np.sqrt(np.sum(a * a, axis=-1, keepdims=True))
        b = b / np.sqrt(np.sum(b * b, axis=-1, keepdims=True))
        apart = np.sqrt(np.sum((a - b) ** 2, axis=-1))
        along = np.sqrt(np.sum((a + b) ** 2, axis=-1))
        return np.degrees(2.0 * np.arctan2(apart, along)).astype(np.float32)


def normal_errors(
    estimate: np.ndarray, truth: np.ndarray, *, flags: np.ndarray, mask: np.ndarray | None = None
) -> NormalErrors:
    """Compute errors of a field of normals.

    estimate, truth : (rows, columns, 3), right-handed, y up, z to the camera; a truth of zero or NaN means: not known.
    flags : (rows, columns) uint8 of the normals stage. mask : (rows, columns) bool, pixels of the object. Raises
    UserError where shapes differ.
    """
    if estimate.shape != truth.shape or flags.shape != truth.shape[:2]:
        raise UserError(
            f"truth: expected normals of shape {estimate.shape}, as the capture, found {truth.shape}; "
            "give the truth of this very capture, cropped alike"
        )
    angles = np.empty(truth.shape[:2], np.float32)
    slopes = np.empty(truth.shape[:2], np.float32)
    for band in strips(len(truth)):
        angles[band] = angular_error_deg(estimate[band], truth[band])
        slopes[band] = angular_error_deg(truth[band], np.broadcast_to([0.0, 0.0, 1.0], truth[band].shape))
    inside = np.isfinite(slopes) if mask is None else np.isfinite(slopes) & mask
    angles[~inside] = np.nan
    has = inside & ((flags & NO_ESTIMATE) == 0)
    clean = has & (flags == 0)
    edges = itertools.pairwise(SLOPE_EDGES_DEG)
    return NormalErrors(
        map_deg=angles,
        inside=summarise(angles, where=inside),
        estimated=summarise(angles, where=has),
        unflagged=summarise(angles, where=clean),
        flagged=summarise(angles, where=has & ~clean),
        by_slope={(a, b): summarise(angles, where=has & (slopes >= a) & (slopes < b)) for a, b in edges},
        no_estimate=int(np.count_nonzero(inside & ~has)),
    )


@dataclass(frozen=True)
class HeightError:
    """Height against truth after removal of the best plane from the difference; unit of the heights."""

    rms: float | None  # rms, p90, worst: of the remaining difference
    p90: float | None
    worst: float | None
    relief_rms: float | None  # of the truth about its own best plane, to compare with
    tilt_deg: float | None  # tilt of the removed plane where heights and pitch share a unit
    pixels: int  # number compared


def height_error(height: np.ndarray, truth: np.ndarray, *, pixels: np.ndarray, pitch: float = 1.0) -> HeightError:
    """Compare heights (rows, columns) where `pixels` (bool) is set and both are finite.

    pitch : distance of neighbouring pixels in the unit of the heights. Fewer than 3 pixels: all figures None.
    Raises UserError where shapes differ.
    """
    if height.shape != truth.shape:
        raise UserError(f"truth: expected heights of shape {height.shape}, found {truth.shape}; crop both alike")
    used = pixels & np.isfinite(height) & np.isfinite(truth)
    count = int(np.count_nonzero(used))
    if count < 3:
        return HeightError(None, None, None, None, None, count)
    rows, columns = np.nonzero(used)
    difference, _, slope = _without_plane(height[used].astype(np.float64) - truth[used], rows, columns)
    relief, _, _ = _without_plane(truth[used].astype(np.float64), rows, columns)
    return HeightError(
        rms=float(np.sqrt(np.mean(difference**2))),
        p90=float(np.percentile(np.abs(difference), 90)),
        worst=float(np.abs(difference).max()),
        relief_rms=float(np.sqrt(np.mean(relief**2))),
        tilt_deg=float(np.degrees(np.arctan(slope / pitch))),
        pixels=count,
    )


def _without_plane(values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Fit a plane by least squares; return the residual, its coefficients, and its slope per pixel."""
    x, y = columns - columns.mean(), rows - rows.mean()
    centred = values - values.mean()
    gram = np.array([[x @ x, x @ y], [x @ y, y @ y]])
    # lstsq: pixels of one line only leave the slope across it free; it takes the smallest
    slope = np.linalg.lstsq(gram, np.array([x @ centred, y @ centred]), rcond=1e-12)[0]
    return centred - slope[0] * x - slope[1] * y, slope, float(np.hypot(*slope))


@dataclass(frozen=True)
class ReflectanceErrors:
    """Reflectance against truth.

    rmse : over the 61 bands of each pixel; de00 : illuminant -> CIEDE2000; de00_map : (rows, columns) float32 under the
    first illuminant, NaN where not compared; regions : label, pixels, mean estimated and true spectrum of each, and the
    rmse between the two.
    """

    rmse: Summary
    de00: dict[str, Summary]
    de00_map: np.ndarray
    regions: list[dict]

    def as_dict(self) -> dict:
        """Return plain values, for JSON."""
        de00 = {name: asdict(summary) for name, summary in self.de00.items()}
        return {"rmse": asdict(self.rmse), "de00": de00, "regions": self.regions}


def reflectance_errors(
    coefficients: np.ndarray,
    basis: np.ndarray,
    paints: np.ndarray,
    spectra: np.ndarray,
    *,
    pixels: np.ndarray,
    regions: np.ndarray | None = None,
    illuminants: tuple[str, ...] = ("D65", "A", "FL11"),
) -> ReflectanceErrors:
    """Compare S = coefficients @ basis with the true spectrum of each pixel.

    coefficients : (rows, columns, K); basis : (K, 61); paints : (rows, columns, samples) or (rows, columns) integers
    into spectra (paints, 61), a pixel's spectrum is the mean over its samples; pixels : (rows, columns) bool, those to
    compare; regions : (rows, columns) integers that group pixels for mean spectra (default: the first sample's paint).
    Values are not clipped. Raises UserError where shapes differ.
    """
    from scipy.sparse import csr_array

    paints = paints[..., None] if paints.ndim == 2 else paints
    shape = coefficients.shape[:2]
    if paints.shape[:2] != shape or spectra.ndim != 2 or spectra.shape[1] != basis.shape[1]:
        raise UserError(
            f"truth: expected paints of {shape} pixels and spectra of {basis.shape[1]} bands, found "
            f"{paints.shape} and {spectra.shape}; give the truth of this very capture"
        )
    if paints.size and int(paints.max()) >= len(spectra):
        raise UserError(f"truth: expected paints from 0 to {len(spectra) - 1}, found {paints.max()}")
    regions = paints[..., 0] if regions is None else regions
    count = int(regions.max()) + 1
    sizes, sums = np.zeros(count, np.int64), np.zeros((2, count, basis.shape[1]))
    rmse = np.full(shape, np.nan, np.float32)
    maps = {name: np.full(shape, np.nan, np.float32) for name in illuminants}
    eyes = {
        name: (xyz_matrix(illuminant(name), np.eye(basis.shape[1])).T, white_xyz(illuminant(name))) for name in maps
    }
    for band in strips(shape[0], SPECTRAL_ROWS):
        used = pixels[band]
        estimated = coefficients[band][used].astype(np.float64) @ basis
        true = spectra[paints[band][used]].mean(axis=1, dtype=np.float64)
        rmse[band][used] = np.sqrt(np.mean((estimated - true) ** 2, axis=1))
        for name, (matrix, white) in eyes.items():
            maps[name][band][used] = delta_e_2000(
                xyz_to_lab(estimated @ matrix, white), xyz_to_lab(true @ matrix, white)
            )
        labels = regions[band][used]
        members = csr_array((np.ones(len(labels)), labels, np.arange(len(labels) + 1)), (len(labels), count)).T
        sizes += np.bincount(labels, minlength=count)
        sums += members @ estimated, members @ true
    means = sums / np.maximum(sizes, 1)[:, None]
    rms = np.sqrt(np.mean((means[0] - means[1]) ** 2, axis=1))
    return ReflectanceErrors(
        rmse=summarise(rmse, where=pixels),
        de00={name: summarise(values, where=pixels) for name, values in maps.items()},
        de00_map=maps[illuminants[0]],
        regions=[
            {
                "label": int(k),
                "pixels": int(sizes[k]),
                "rmse": float(rms[k]),
                "estimate": np.round(means[0, k], 5).tolist(),
                "truth": np.round(means[1, k], 5).tolist(),
            }
            for k in np.flatnonzero(sizes)
        ],
    )
