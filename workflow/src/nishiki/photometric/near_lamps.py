"""Tell lamps at a finite distance from far ones by the fall-off of their light across the photographs.

A pixel at x, whose albedo times normal is m, shows m . (p_j - x) / |p_j - x|^3 under a lamp at p_j, and m . l_j under a
far one. With directions alone, p_j is l_j at a common distance, and the width of the picture in distances of the lamps
is fitted together with the gains (`nishiki.photometric.lambert_fit.fit_lambert`). Far lamps assumed in place of near
ones bend the relief: light that falls off towards one side looks like a surface that turns away.

Gloss under a camera that stands near wanders with the lamp as well. The width is therefore fitted a second time without
the samples near the mirror direction, and both have to agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.photometric.consistency import FEWEST_PIXELS, LARGEST_MISFIT, SURE, is_even
from nishiki.photometric.lambert_fit import FEWEST_LAMPS, KINK, Fit, fit_lambert, none_where_undetermined, spread_pixels
from nishiki.photometric.order_trials import STEEPEST

HIGHLIGHT = np.cos(np.radians(20.0))  # between normal and half vector: broader gloss is as good as diffuse
LEAST_MATT = 0.25  # of a lamp's samples that hold no gloss: of fewer, its strength is not determined
AGREEING = 1.4  # factor between the widths with and without the samples that may hold gloss
EXPLAINED = 0.9  # of the robust misfit that near lamps leave: a wrong law of reflection reached .96
LEAST_TURN_DEG = 2.5  # by which far lamps turn the normals in the median: gloss on a flat object reached 2.1
LAW_ERROR = 0.1  # of the width, by which rough and glossy matter shift it: 0 to 0.2 under a ring of lamps


@dataclass(frozen=True)
class NearLamps:
    """What photographs show of the distance of their lamps."""

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
    def shown(self) -> bool:
        """Whether the lamps are near beyond doubt."""
        sure = self.width > SURE * self.sigma and self.left < EXPLAINED
        return sure and self.agrees and self.even and self.misfit < LARGEST_MISFIT

    @property
    def matters(self) -> bool:
        """Whether the lamps are near, and far lamps in their place would turn the normals."""
        return self.shown and self.turn_deg > LEAST_TURN_DEG


@none_where_undetermined
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
    directions = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    rows, columns = values.shape[1:]
    row, column = np.divmod(places, columns)
    x = np.column_stack([(column + 0.5) / columns - 0.5, (rows / 2 - row - 0.5) / columns, np.zeros(len(row))])
    chosen = values.reshape(len(vectors), -1)[:, places].astype(np.float64)
    near = fit_lambert(chosen, vectors, patches, places=x)
    if not np.isfinite(near.width):
        return None
    far, first = fit_lambert(chosen, directions, patches), near.width
    if near.width > SURE * near.width_sigma:
        halves = np.add(directions, (0.0, 0.0, 1.0))
        halves /= np.linalg.norm(halves, axis=1, keepdims=True)
        matt = np.where(halves @ _unit(near).T > HIGHLIGHT, np.nan, chosen)
        matt[np.isfinite(matt).mean(axis=1) < LEAST_MATT] = np.nan
        usable = np.isfinite(matt).sum(axis=0) > FEWEST_LAMPS
        if usable.sum() < FEWEST_PIXELS:
            usable[:], matt = True, chosen
        chosen, patches, x = matt[:, usable], patches[usable], x[usable]
        near, far = fit_lambert(chosen, vectors, patches, places=x), fit_lambert(chosen, directions, patches)
    scale = np.minimum(near.scale, far.scale)
    cost = [np.nanmean(np.log1p((_residuals(fit) / (KINK * scale)) ** 2)) for fit in (far, near)]
    before, after = _unit(far), _unit(near)
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


def _unit(fit: Fit) -> np.ndarray:
    return fit.normals / np.linalg.norm(fit.normals, axis=1, keepdims=True)


def _residuals(fit: Fit) -> np.ndarray:
    """Residuals (lights, pixels) of lit values, NaN elsewhere."""
    return np.where(fit.weights > 0, fit.residuals, np.nan)
