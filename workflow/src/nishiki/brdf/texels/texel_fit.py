"""Fit the reflection model at each texel of a tile from its stack of observations.

A texel is seen in a third of the views of a turn, or fewer: only these observations are kept, side by side, and a
count for each texel.

A turn shows a texel near the mirror direction in one view or two, which determine no lobe: `LobeProfile` holds the
sums by which texels that share a lobe determine it together (`nishiki.brdf.texels.neighbours`), and `lambert` then
solves for the K_d of each texel.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from nishiki.brdf.slopes import GRAZING
from nishiki.brdf.texels.model import ViewLamp, facet_lobe, factors, predict, weigh_lender
from nishiki.brdf.texels.parameters import Parameters
from nishiki.colour.colour import encode, encoding_slope
from nishiki.formats.stored import channel_bits

MULTIPLE = 8  # observations a texel are padded to a multiple, with weight 0


@dataclass(frozen=True)
class TileSamples:
    """The visible and saturated observations of a tile's observed texels; every array float32 unless noted.

    texel (points,) int32: row * T + column.  values (points, slots, channels).  diffuse (points, slots): what
    multiplies K_d.  attenuation: what multiplies K_s and the lobe, 0 where the lamp is behind.  alpha (points, slots):
    radians.  weights: cos(theta_r), times the squared slope of the encoding where asked; 0 in unused slots.
    view (points, slots) int32: which observation a slot holds, -1 none.  saturated (points, slots, channels) bool:
    whose value is a lower bound.
    """

    texel: np.ndarray
    values: np.ndarray
    diffuse: np.ndarray
    attenuation: np.ndarray
    alpha: np.ndarray
    weights: np.ndarray
    view: np.ndarray
    saturated: np.ndarray | None = None

    @property
    def certain(self) -> np.ndarray:
        """Weights (points, slots, channels), 0 of saturated values; (points, slots, 1) without bounds."""
        weights = self.weights[..., None]
        return weights if self.saturated is None else np.where(self.saturated, np.float32(0), weights)

    @property
    def seen(self) -> np.ndarray:
        """(points,) int32: observations of each texel that are certain, in the channel that has the fewest."""
        return (self.certain > 0).sum(axis=1, dtype=np.int32).min(axis=-1)


def gather(
    values: np.ndarray,
    visible: np.ndarray,
    positions: np.ndarray,
    normals: np.ndarray,
    centres: np.ndarray,
    lamps: list[ViewLamp],
    *,
    encoding: str = "linear",
    bright: np.ndarray | None = None,
) -> TileSamples:
    """Gather a tile: values (M, T, T, channels) linear, visible (M, T, T), positions and normals (T, T, 3).

    centres (M, 3): of the cameras; lamps: one an observation.  encoding: in which errors count; "srgb" weighs each
    observation by the squared slope of the curve.  bright: (M, T, T, channels) values that this slope is taken at, the
    values themselves if None.  Observations that are not finite are left out.  Weighted by cos(theta_r) (Miyazaki et
    al. 2007, section 3.1).
    """
    texel, view = _slots(visible)
    places = np.ascontiguousarray(positions, np.float32).reshape(-1, 3)
    facing = np.ascontiguousarray(normals, np.float32).reshape(-1, 3)
    picked = _pick(values, texel, view)
    diffuse, attenuation, alpha, weights = (np.zeros(view.size, np.float32) for _ in range(4))
    number = (view + 1).astype(np.min_scalar_type(len(lamps))).ravel()  # few bytes are sorted in linear time
    order = np.argsort(number, kind="stable")
    ends = np.searchsorted(number[order], np.arange(1, len(lamps) + 2))
    for o, lamp in enumerate(lamps):
        slots = order[ends[o] : ends[o + 1]]
        seen = texel[slots // view.shape[1]]
        irradiance, angles = factors(places[seen], facing[seen], centres[o], lamp, 1)
        strength, cos_r, alpha2 = angles.T
        diffuse[slots], alpha[slots], weights[slots] = irradiance[:, 0], np.sqrt(alpha2), np.fmax(cos_r, 0)
        attenuation[slots] = strength / np.fmax(cos_r, GRAZING)
    diffuse, attenuation, alpha, weights = (a.reshape(view.shape) for a in (diffuse, attenuation, alpha, weights))
    mean = np.full(values.shape[-1], 1 / values.shape[-1], np.float32)
    if encoding == "srgb":
        level = picked if bright is None else _pick(bright, texel, view)
        weights *= encoding_slope(level @ mean, "srgb") ** 2
    unknown = ~np.isfinite(picked @ mean)
    weights[unknown] = picked[unknown] = 0
    return TileSamples(texel, picked, diffuse, attenuation, alpha, weights, view)


def _slots(visible: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List the observed texels (points,), and their observations (points, slots), -1 where a slot is empty."""
    flat = visible.reshape(visible.shape[0], -1)
    count = flat.sum(axis=0)
    texel = np.flatnonzero(count).astype(np.int32)
    slots = -(-max(int(count.max(initial=0)), 1) // MULTIPLE) * MULTIPLE
    view = np.full((texel.size, slots), -1, np.int32)
    point, observation = np.nonzero(flat[:, texel].T)
    first = np.cumsum(count[texel]) - count[texel]
    view[point, np.arange(len(point)) - first[point]] = observation
    return texel, view


def _pick(stack: np.ndarray, texel: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Pick values (points, slots, channels) float32 from a stack (M, T, T, channels), 0 in empty slots."""
    flat = np.asarray(stack, np.float32).reshape(len(stack), -1, stack.shape[-1])
    return np.where((view >= 0)[..., None], flat[view, texel[:, None]], np.float32(0))


@dataclass(frozen=True)
class Tile:
    """A tile's texels."""

    # (M, T, T, channels) linear of the total radiance or, with `specular` given, of the diffuse component
    values: np.ndarray
    visible: np.ndarray  # (M, T, T)
    positions: np.ndarray  # positions, normals (T, T, 3)
    normals: np.ndarray
    inside: np.ndarray  # (T, T)
    specular: np.ndarray | None = None
    # (M, T, T) uint8: bits of the saturated channels (`channel_bits`), whose values are lower bounds; None: no bounds
    saturated: np.ndarray | None = None

    @property
    def usable(self) -> np.ndarray:
        """Texels that are visible or saturated, (M, T, T) bool."""
        return self.visible if self.saturated is None else self.visible | (self.saturated > 0)

    def hide(self, observations: list[int]) -> "Tile":
        """Return the tile without some observations."""
        visible, bounds = self.visible.copy(), None if self.saturated is None else self.saturated.copy()
        visible[observations] = False
        if bounds is not None:
            bounds[observations] = 0
        return replace(self, visible=visible, saturated=bounds)

    @property
    def joined(self) -> "Tile":
        """The tile with the total radiance instead of its components."""
        return self if self.specular is None else replace(self, values=self.values + self.specular, specular=None)

    @property
    def spacing(self) -> float:
        """Median distance of texels side by side, in the object's unit; NaN where there are none."""
        both = self.inside[:, 1:] & self.inside[:, :-1]
        steps = np.linalg.norm(np.diff(self.positions, axis=1)[both], axis=-1)
        return float(np.median(steps)) if steps.size else float("nan")


@dataclass(frozen=True)
class Sample:
    """Texels picked evenly: positions, normals (n, 3); values (n, M, channels) total radiance; visible (n, M).

    Where a texel is saturated in some view, all channels hold the one that is so in the fewest.
    """

    positions: np.ndarray
    normals: np.ndarray
    values: np.ndarray
    visible: np.ndarray
    texels: np.ndarray  # (n,) numbers of the texels, tile by tile

    def thin(self, count: int) -> "Sample":
        """Return about `count` of the texels, evenly picked."""
        step = max(len(self.positions) // count, 1)
        return Sample(*(values[::step] for values in vars(self).values()))


def sample_texels(read: Callable[[int], Tile], tiles: list[int], count: int) -> Sample:
    """Pick every k-th texel of every tile, about `count` in all; of tiles in even steps where these are many."""
    chosen = tiles[:: max(len(tiles) // 200, 1)]
    parts = [[], [], [], [], []]
    for number in chosen:
        tile = read(number)
        seen = np.flatnonzero(tile.inside.ravel() & (tile.visible.reshape(len(tile.visible), -1).sum(axis=0) >= 3))
        picked = seen[:: max(len(seen) * len(chosen) // count, 1)]
        values = [tile.positions.reshape(-1, 3)[picked], tile.normals.reshape(-1, 3)[picked]]
        values += [*_pick_channels(tile.joined, picked), number * tile.inside.size + picked]
        for part, value in zip(parts, values, strict=True):
            part.append(value)
    return Sample(*(np.concatenate(part) for part in parts))


def _pick_channels(tile: Tile, picked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values (n, M, channels) of texels and where they are known (n, M).

    Where a texel is saturated in some view, the channel that is so in the fewest views is used for all channels.
    """

    def of_picked(part: np.ndarray) -> np.ndarray:
        return np.moveaxis(part.reshape(len(part), tile.inside.size, -1)[:, picked], 1, 0)

    values, visible = of_picked(tile.values), of_picked(tile.visible)[..., 0]
    if tile.saturated is None or not tile.saturated.any():
        return values, visible
    bounds = (of_picked(tile.saturated) & channel_bits(values.shape[-1])) > 0
    best = bounds.sum(axis=1).argmin(axis=-1)[:, None, None]
    several = bounds.any(axis=(1, 2))[:, None, None]
    values = np.where(several, np.take_along_axis(values, best, axis=-1), values)
    usable = bounds.any(axis=-1) & ~np.take_along_axis(bounds, best, axis=-1)[..., 0]
    return values, visible | usable


@dataclass(frozen=True)
class CaptureViews:
    """The camera's centre (M, 3) and the lamp of every observation; `encoding` in which errors count."""

    centres: np.ndarray
    lamps: list[ViewLamp]
    encoding: str = "linear"

    def observe(self, tile: Tile) -> tuple[TileSamples, TileSamples | None]:
        """Gather the tile's observations, and those of its specular component where it has one."""
        area = tile.usable & tile.inside[None]
        arguments = (area, tile.positions, tile.normals, self.centres, self.lamps)
        if tile.specular is None:
            found = gather(tile.values, *arguments, encoding=self.encoding)
            if tile.saturated is None:
                return found, None
            bits = tile.saturated.reshape(len(tile.saturated), -1)[found.view, found.texel[:, None]]
            flags = (bits[..., None] & channel_bits(tile.values.shape[-1])) * (found.view >= 0)[..., None] > 0
            return replace(found, saturated=flags), None
        bright = tile.values + tile.specular
        first, second = (
            gather(part, *arguments, encoding=self.encoding, bright=bright) for part in (tile.values, tile.specular)
        )
        return first, second

    def squares(self, parameters: Parameters, tile: Tile) -> tuple[float, int]:
        """Sum the squared errors of the model alone, in the capture's encoding, and count the finite samples."""
        total, count = 0.0, 0
        tile = tile.joined
        for o in np.flatnonzero(tile.visible.reshape(len(tile.visible), -1).any(axis=1)):
            seen = tile.visible[o] & tile.inside
            error, _ = self.subtract_prediction(parameters, tile, int(o), seen)
            error = error[np.isfinite(error)]
            total += float(np.sum(error.astype(np.float64) ** 2))
            count += error.size
        return total, count

    def subtract_prediction(self, parameters: Parameters, tile: Tile, observation: int, texels=...) -> tuple:
        """Subtract the encoded total radiance of a joined tile from the predicted one, as `predict`.

        A prediction above a saturated value has no error. Return the weight of `weigh_lender` too.
        """
        parts = self.predict(parameters, tile, observation, texels)
        error = encode(sum(parts), self.encoding) - encode(tile.values[observation][texels], self.encoding)
        if tile.saturated is None:
            return error, weigh_lender(*parts)
        flags = (tile.saturated[observation][texels][..., None] & channel_bits(error.shape[-1])) > 0
        return np.where(flags, np.minimum(error, 0), error), weigh_lender(*parts)

    def predict(self, parameters: Parameters, tile: Tile, observation: int, texels=...) -> tuple:
        """Predict diffuse and specular radiance (..., channels) of one observation of a tile, or of some texels.

        texels: an index into (T, T).
        """
        of_texels = (parameters.kd, parameters.ks, parameters.sigma, tile.positions, tile.normals)
        kd, ks, sigma, places, facing = (array[texels] for array in of_texels)
        return predict(kd, ks, sigma, places, facing, self.centres[observation], self.lamps[observation])


WIDTHS = np.geomspace(0.02, 0.35, 24)
"""Radians: sigma of the lobes that are tried. Under wrong normals broader ones would stand for the body."""
TAIL = 3e-4  # of an observation at the peak: a lobe of which less is seen is not extrapolated from its tail


@dataclass(frozen=True)
class LobeProfile:
    """Sums over observations from which the gain of a lobe of each of WIDTHS follows, K_d being eliminated.

    With s the part of a lobe that K_d cannot explain and y the values: power (points, widths, channels or 1) sum w s^2,
    match (points, widths, channels) sum w s y. Profiles of several texels add up to that of a lobe that they share,
    whatever their K_d (G. Golub, V. Pereyra, Separable nonlinear least squares, Inverse Problems 19, 2003).
    """

    power: np.ndarray
    match: np.ndarray

    @classmethod
    def of(
        cls, total: TileSamples, specular: TileSamples | None = None, weights: np.ndarray | None = None
    ) -> "LobeProfile":
        """Sum the observations of each texel: of its specular component, where there is one, without K_d.

        weights (points, slots, channels or 1): of the values, `certain` if None.
        """
        data = total if specular is None else specular
        weights, values = (data.certain if weights is None else weights).astype(np.float64), data.values
        diffuse = data.diffuse[..., None].astype(np.float64)
        below = (weights * diffuse**2).sum(axis=1)
        seen = (below > 0) & (specular is None)
        share = np.where(seen, 1 / np.where(seen, below, 1), 0)
        body = (weights * diffuse * values).sum(axis=1)
        least = TAIL * weights.sum(axis=1) / np.maximum((weights > 0).sum(axis=1), 1)
        # at once for all widths: sums over observations of each texel
        lobes = np.stack([lobes_of(data, np.full(len(values), sigma)) for sigma in WIDTHS], axis=1)
        mixed = lobes @ (weights * diffuse)
        power = np.maximum(lobes**2 @ weights - mixed**2 * share[:, None], 0) + least[:, None]
        return cls(power, lobes @ (weights * values) - mixed * (share * body)[:, None])

    @property
    def columns(self) -> np.ndarray:
        """The profile as (points, numbers)."""
        parts = (self.power, self.match)
        return np.column_stack([part.reshape(len(part), part.shape[1] * part.shape[2]) for part in parts])

    @classmethod
    def from_columns(cls, columns: np.ndarray, channels: int) -> "LobeProfile":
        """Make a profile from `columns`; channels: of the capture."""
        parts = np.split(columns, [columns.shape[1] - channels * len(WIDTHS)], axis=1)
        return cls(*(part.reshape(len(part), len(WIDTHS), part.shape[1] // len(WIDTHS)) for part in parts))

    def solve(self) -> tuple[np.ndarray, np.ndarray]:
        """Find sigma (points,) radians and K_s >= 0 (points, channels) of the lobe that explains most, float32.

        A parabola through the best of the widths and its neighbours is used. Both are 0 where no lobe gains.
        """
        strength = np.maximum(self.match, 0) / np.maximum(self.power, 1e-300)
        gain = (strength * np.maximum(self.match, 0)).sum(axis=2)
        best = np.clip(gain.argmax(axis=1), 1, len(WIDTHS) - 2)
        rows, around = np.arange(len(gain)), best[:, None] + np.array([-1, 0, 1])
        left, middle, right = gain[rows[:, None], around].T
        bend = left - 2 * middle + right
        step = np.where(bend < 0, (left - right) / np.where(bend < 0, 2 * bend, -1), np.where(right > left, 1, -1))
        step = np.clip(step, -1, 1)
        ratio = np.log(WIDTHS[1] / WIDTHS[0])
        sigma = np.where(gain.max(axis=1) > 0, WIDTHS[best] * np.exp(step * ratio), 0)
        weights = np.stack([step * (step - 1) / 2, 1 - step**2, step * (step + 1) / 2], axis=1)
        ks = np.einsum("pk,pkc->pc", weights, strength[rows[:, None], around])
        return sigma.astype(np.float32), np.maximum(ks, 0).astype(np.float32)


def lobes_of(data: TileSamples, sigma: np.ndarray) -> np.ndarray:
    """Evaluate what multiplies K_s (points, slots) at sigma (points,)."""
    return data.attenuation * facet_lobe(data.alpha.astype(np.float64) ** 2, sigma[:, None].astype(np.float64))


def lambert(data: TileSamples, gloss: np.ndarray | float = 0.0) -> np.ndarray:
    """Fit K_d (points, channels) float32 to what gloss (points, slots, channels) leaves of the values.

    Least squares with the samples' weights, Miyazaki et al. (2007), section 3.1.
    """
    weighted = data.certain * data.diffuse[..., None]
    top = (weighted * (data.values - gloss)).sum(axis=1)
    below = (weighted * data.diffuse[..., None]).sum(axis=1)
    return np.maximum(np.where(below > 0, top / np.where(below > 0, below, 1), 0), 0).astype(np.float32)
