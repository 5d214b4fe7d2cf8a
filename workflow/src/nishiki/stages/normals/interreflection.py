"""Decide whether the light that an object throws on itself counts, and take it off the observations of a band."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from nishiki.model_selection.decision import Decision
from nishiki.observations.blocks import Edges, field_rows
from nishiki.observations.parcels import Parcel
from nishiki.observations.plane import Observations
from nishiki.photometric.flags import NO_ESTIMATE
from nishiki.photometric.light_selection import select_diffuse
from nishiki.photometric.reflectance import mean_of_channels
from nishiki.stages.normals import NormalsSettings
from nishiki.stages.normals.parcel import solve

if TYPE_CHECKING:
    from nishiki.photometric.interreflection import Facets

SIDE = 64  # facets along the longer side of the picture; the decision is made on half as many
COUNTS = 0.01  # share of the light, exceeded on a tenth of the object, from which it is looked at
BRIGHT = 0.99  # share of the facets that reflect no more than all light
SCALES = 2.0 ** np.arange(-2, 0.1, 0.5)  # of the level at which they do: without a white board it is not known


@dataclass(frozen=True)
class Thrown:
    """Hold the shares (r, c, lights * channels) of a grid of facets, whose edges are these in pixels."""

    shares: np.ndarray
    edges: Edges

    def taken_off(self, observations: np.ndarray, rows: slice) -> np.ndarray:
        """Return observations (lights, rows, columns, channels) of some rows without the light of other places."""
        from nishiki.photometric.interreflection import taken_off

        lights, *picture, channels = observations.shape
        shares = field_rows(self.shares, self.edges, rows.start, rows.stop).reshape(*picture, lights, channels)
        return taken_off(observations, np.maximum(shares.transpose(2, 0, 1, 3), 0, order="C"))


def find_thrown_light(
    frames: Observations, lights: np.ndarray, settings: NormalsSettings
) -> tuple[Thrown | None, Decision | None]:
    """Return the light that the object throws on itself where it counts, and the decision.

    It counts where a tenth of the object receives COUNTS of its light or more from other places, and captured lamps
    that are left out in turn are predicted better with it. Under near lamps nothing is looked for.
    """
    if settings.interreflection == "none" or settings.solver == "least_squares" or frames.positions_mm is not None:
        return None, None
    from nishiki.model_selection.relighting import ERRORS, FEWEST, FOLDS
    from nishiki.photometric.interreflection import find_interreflection, left_out_errors

    step = max(1, -(-max(frames.shape) // SIDE))
    facets = read_facets(frames, lights, step, settings)
    few = facets.every(2)
    found = find_interreflection(few)
    brightest = np.quantile(found.reflectance[found.known], BRIGHT) if found.known.any() else 1.0
    scales = np.ones(1) if frames.white_board else SCALES / max(brightest, np.finfo(float).tiny)
    found = find_interreflection(few.scaled(scales[-1]))
    received = found.shares.sum(axis=0).mean(axis=-1)[found.known]
    share = float(np.quantile(received, 0.9)) if received.size else 0.0
    words = "share of the light, exceeded on a tenth of the object, that other places of it throw"
    loss = f"normals of concave places too flat, {share:.2g} of the light" if share >= COUNTS else "nothing"
    kept = Decision("interreflection", "none", words, share, COUNTS, loss, "no setting forces it")
    if share < COUNTS or len(lights) < FEWEST:
        return None, kept
    without, best, most = left_out_errors(few, None, FOLDS), 0.0, 0.0
    for scale in scales:
        brighter = few.scaled(scale)
        gains = without - left_out_errors(brighter, find_interreflection(brighter), FOLDS) / scale
        if not gains.mean() > most:
            break
        most = gains.mean()
        best = scale if most > ERRORS * gains.std(ddof=1) / np.sqrt(gains.size) else 0.0
    if not best:
        return None, kept
    shares = find_interreflection(facets.scaled(best)).shares.astype(np.float32).transpose(1, 2, 0, 3)
    rows, columns = (np.append(np.arange(0, size, step), size) for size in frames.shape)
    override = "normals.interreflection: none"
    made = Decision("interreflection", "taken off", words, share, COUNTS, "nothing", override)
    return Thrown(shares.reshape(*shares.shape[:2], -1), (rows, columns)), made


def read_facets(frames: Observations, lights: np.ndarray, step: int, settings: NormalsSettings) -> Facets:
    """Read the middle row of squares of `step` pixels; a facet is valid where half of these pixels are."""
    from nishiki.photometric.interreflection import Facets

    rows, columns = (-(-size // step) for size in frames.shape)
    sums = np.zeros((len(lights), rows, columns, len(frames.channels)))
    counts, starts = np.zeros((len(lights), rows, columns)), np.arange(0, frames.shape[1], step)
    for number, row in enumerate(np.minimum(np.arange(rows) * step + step // 2, frames.shape[0] - 1)):
        values, known = frames.read(slice(int(row), int(row) + 1), lights=lights)
        sums[:, number] = np.add.reduceat(np.where(known[..., None], values, 0)[:, 0], starts, axis=1)
        counts[:, number] = np.add.reduceat(known[:, 0].astype(int), starts, axis=1)

    def fit(values: np.ndarray, valid: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        values = values.astype(np.float32)
        usable = select_diffuse(mean_of_channels(values), directions, valid=valid).usable
        place = slice(0, valid.shape[1]), slice(0, valid.shape[2])
        parcel = Parcel(*place, directions, np.ones(len(values), np.float32))
        maps = solve(values, usable, valid, parcel, settings)
        return maps["normals"], ((maps["flags"] & NO_ESTIMATE) == 0) & valid.any(axis=0), usable

    return Facets(sums / np.maximum(counts, 1)[..., None], counts > step / 2, frames.directions[lights], fit)
