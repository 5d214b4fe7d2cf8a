"""Errors of the normals against true ones."""

import itertools
from dataclasses import dataclass

import numpy as np

from nishiki.errors import UserError
from nishiki.evaluate.summary import Summary, summarise
from nishiki.photometric.flags import NO_ESTIMATE

SLOPE_EDGES_DEG = (0.0, 10.0, 20.0, 30.0, 50.0, 90.0)
_BAND_ROWS = 256


@dataclass(frozen=True)
class NormalErrors:
    """Angles between estimated and true normals, degrees.

    map_deg: (rows, columns) float32, NaN where there is no truth; inside: all pixels with a truth, those without an
    estimate included; estimated: those with one; unflagged, flagged: the estimated ones without and with a flag;
    by_slope: (from, to) in degrees of the true slope -> estimated pixels; no_estimate: pixels inside without one.
    """

    map_deg: np.ndarray
    inside: Summary
    estimated: Summary
    unflagged: Summary
    flagged: Summary
    by_slope: dict[tuple[float, float], Summary]
    no_estimate: int

    def as_dict(self) -> dict:
        """Plain values, for JSON."""
        sets = ("inside", "estimated", "unflagged", "flagged")
        return {
            **{name: getattr(self, name).as_dict() for name in sets},
            "by_slope": [{"from_deg": a, "to_deg": b, **s.as_dict()} for (a, b), s in self.by_slope.items()],
            "no_estimate": self.no_estimate,
        }


def angular_error_deg(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Angle between directions (..., 3), degrees, float32; NaN where either is zero or not finite.

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
    estimate: np.ndarray,
    truth: np.ndarray,
    *,
    flags: np.ndarray,
    mask: np.ndarray | None = None,
    slope_edges_deg: tuple[float, ...] = SLOPE_EDGES_DEG,
) -> NormalErrors:
    """Errors of a field of normals.

    estimate, truth : (rows, columns, 3), right-handed, y up, z to the camera; a truth of zero or NaN means: not known.
    flags : (rows, columns) uint8 of the normals stage. mask : (rows, columns) bool, pixels of the object.
    slope_edges_deg : rising; classes of the angle between true normal and z. Raises UserError where shapes differ.
    """
    if estimate.shape != truth.shape or flags.shape != truth.shape[:2]:
        raise UserError(
            f"truth: expected normals of shape {estimate.shape}, as the capture, found {truth.shape}; "
            "give the truth of this very capture, cropped alike"
        )
    angles = np.empty(truth.shape[:2], np.float32)
    slopes = np.empty(truth.shape[:2], np.float32)
    for start in range(0, len(truth), _BAND_ROWS):
        band = slice(start, start + _BAND_ROWS)
        angles[band] = angular_error_deg(estimate[band], truth[band])
        slopes[band] = angular_error_deg(truth[band], np.broadcast_to([0.0, 0.0, 1.0], truth[band].shape))
    inside = np.isfinite(slopes) if mask is None else np.isfinite(slopes) & mask
    angles[~inside] = np.nan
    has = inside & ((flags & NO_ESTIMATE) == 0)
    clean = has & (flags == 0)
    edges = itertools.pairwise(slope_edges_deg)
    return NormalErrors(
        map_deg=angles,
        inside=summarise(angles, where=inside),
        estimated=summarise(angles, where=has),
        unflagged=summarise(angles, where=clean),
        flagged=summarise(angles, where=has & ~clean),
        by_slope={(a, b): summarise(angles, where=has & (slopes >= a) & (slopes < b)) for a, b in edges},
        no_estimate=int(np.count_nonzero(inside & ~has)),
    )
