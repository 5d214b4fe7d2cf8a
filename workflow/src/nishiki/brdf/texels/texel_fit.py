"""Fit the reflection model at each texel of a tile from its stack of observations.

A texel is seen in a third of the views of a turn, or fewer: only these observations are kept, side by side, and a
count for each texel.

`first_fit` finds what the observations of a texel say alone, with how well they say it; `strengths` then solves for K_d
and K_s at a given sigma with a prior for K_s from the neighbours (`nishiki.brdf.texels.neighbours`).  Uncertainties are
relative: how much information the texel has, in units of 1 / noise^2, noise being the scene's (see `noise_of`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from nishiki.brdf.fit import FitFlag, fit_torrance_sparrow
from nishiki.brdf.slopes import GRAZING
from nishiki.brdf.texels.model import ViewLamp, factors, predict
from nishiki.brdf.texels.parameters import Parameters
from nishiki.colour.colour import encode, encoding_slope

MULTIPLE = 8  # observations a texel are padded to a multiple, with weight 0


@dataclass(frozen=True)
class TileSamples:
    """The visible observations of a tile's observed texels; every array float32 unless noted.

    texel (points,) int32: row * T + column.  values (points, slots, channels).  diffuse (points, slots): what
    multiplies K_d.  attenuation: what multiplies K_s exp(..), 0 where the lamp is behind.  alpha (points, slots):
    radians.  weights: cos(theta_r), times the squared slope of the encoding where asked; 0 in unused slots.
    view (points, slots) int32: which observation a slot holds, -1 none.
    """

    texel: np.ndarray
    values: np.ndarray
    diffuse: np.ndarray
    attenuation: np.ndarray
    alpha: np.ndarray
    weights: np.ndarray
    view: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(points,) int32: usable observations of each texel, those with a weight."""
        return (self.weights > 0).sum(axis=1, dtype=np.int32)


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
    """Texels picked evenly: positions, normals (n, 3); values (n, M, channels) total radiance; visible (n, M)."""

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
        total = tile.values if tile.specular is None else tile.values + tile.specular
        flat = total.reshape(total.shape[0], -1, total.shape[-1])
        values = [tile.positions.reshape(-1, 3)[picked], tile.normals.reshape(-1, 3)[picked]]
        values += [np.moveaxis(flat[:, picked], 1, 0), tile.visible.reshape(len(flat), -1)[:, picked].T]
        values.append(number * tile.inside.size + picked)
        for part, value in zip(parts, values, strict=True):
            part.append(value)
    return Sample(*(np.concatenate(part) for part in parts))


@dataclass(frozen=True)
class CaptureViews:
    """The camera's centre (M, 3) and the lamp of every observation; `encoding` in which errors count."""

    centres: np.ndarray
    lamps: list[ViewLamp]
    encoding: str = "linear"

    def observe(self, tile: Tile) -> tuple[TileSamples, TileSamples | None]:
        """Gather the tile's observations, and those of its specular component where it has one."""
        area = tile.visible & tile.inside[None]
        arguments = (area, tile.positions, tile.normals, self.centres, self.lamps)
        if tile.specular is None:
            return gather(tile.values, *arguments, encoding=self.encoding), None
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
            error = self.subtract_prediction(parameters, tile, int(o), seen)
            error = error[np.isfinite(error)]
            total += float(np.sum(error.astype(np.float64) ** 2))
            count += error.size
        return total, count

    def subtract_prediction(self, parameters: Parameters, tile: Tile, observation: int, texels=...) -> np.ndarray:
        """Subtract the encoded total radiance of a joined tile from the predicted one, as `predict`."""
        found = encode(self.predict(parameters, tile, observation, texels), self.encoding)
        return found - encode(tile.values[observation][texels], self.encoding)

    def predict(self, parameters: Parameters, tile: Tile, observation: int, texels=...) -> np.ndarray:
        """Predict total radiance (..., channels) of one observation of a tile, or of texels (an index into (T, T))."""
        of_texels = (parameters.kd, parameters.ks, parameters.sigma, tile.positions, tile.normals)
        kd, ks, sigma, places, facing = (array[texels] for array in of_texels)
        diffuse, specular = predict(kd, ks, sigma, places, facing, self.centres[observation], self.lamps[observation])
        return diffuse + specular


WIDTH_OF_SIGMA = float(np.sqrt(2 * np.log(2)))  # half width at half maximum = WIDTH_OF_SIGMA sigma
SIGMA_BOUNDS = (0.02, 1.2)  # radians
LOST = FitFlag.NO_HIGHLIGHT | FitFlag.TOO_FEW | FitFlag.UNDETERMINED | FitFlag.AT_BOUND


@dataclass(frozen=True)
class FirstFit:
    """The fit to each point's own observations; arrays (points,) or (points, channels), float32.

    log_sigma is usable where information > 0 (a highlight was observed and its width is determined): the inverse
    variance of log_sigma.  residual: root mean square, weighted.  flags: bits of FitFlag.
    """

    kd: np.ndarray
    ks: np.ndarray
    log_sigma: np.ndarray
    information: np.ndarray
    residual: np.ndarray
    flags: np.ndarray


def first_fit(total: TileSamples, specular: TileSamples | None = None) -> FirstFit:
    """Fit each texel alone.

    total: observations of Lambert + lobe; where `specular` (the same slots) is given, `total` holds the diffuse
    component, and the two terms are fitted apart (Miyazaki et al. 2007, sections 3.1, 3.2).
    """
    data, basis = (total, total.diffuse) if specular is None else (specular, None)
    low, high = (bound * WIDTH_OF_SIGMA for bound in SIGMA_BOUNDS)
    fit = fit_torrance_sparrow(
        data.alpha,
        data.values,
        weights=data.weights,
        attenuation=data.attenuation,
        diffuse=basis,
        gamma_bounds=(low, high),
    )
    known = ((fit.flags & LOST) == 0) & np.isfinite(fit.gamma) & (fit.sigma_log_gamma > 0)
    log_sigma = np.log(np.where(known, fit.gamma / WIDTH_OF_SIGMA, 1)).astype(np.float32)
    information = np.where(known, 1 / np.where(known, fit.sigma_log_gamma, 1) ** 2, 0).astype(np.float32)
    kd = fit.diffuse if specular is None else lambert(total)
    return FirstFit(kd, fit.specular, log_sigma, information, fit.residual, fit.flags)


def lambert(data: TileSamples) -> np.ndarray:
    """Fit K_d (points, channels) float32 alone: least squares weighted by cos(theta_r), Miyazaki et al. (2007), 3.1."""
    weighted = data.weights * data.diffuse
    top = np.einsum("ps,psc->pc", weighted, data.values)
    below = np.einsum("ps,ps->p", weighted, data.diffuse)[:, None]
    return np.maximum(np.where(below > 0, top / np.where(below > 0, below, 1), 0), 0).astype(np.float32)


@dataclass(frozen=True)
class Strengths:
    """K_d and K_s (points, channels) at given sigma."""

    kd: np.ndarray
    ks: np.ndarray
    information: np.ndarray  # (points,): what the data alone say of K_s
    # (points,): root mean square of the weighted residuals of the observations that K_s follows from
    residual: np.ndarray


def strengths(total: TileSamples, sigma: np.ndarray, prior: np.ndarray, precision: float) -> Strengths:
    """Solve for K_d and K_s >= 0 of every texel at its sigma (points,), K_s drawn towards prior (points, channels).

    Minimises sum w (y - K_d q - K_s s)^2 + precision (K_s - prior)^2 for each channel, K_d >= 0 and K_s >= 0, s the
    lobe at sigma.  A texel whose observations are far from the mirror direction has no information on K_s and takes the
    prior; one that was seen there and shows nothing gets K_s near 0.
    """
    q = total.diffuse.astype(np.float64)
    s = total.attenuation * np.exp(-((total.alpha / (np.sqrt(2) * sigma[:, None].astype(np.float64))) ** 2))
    columns, weights = np.stack([s, q], axis=1), total.weights.astype(np.float64)[:, None]
    weighted, values = columns * weights, total.values.astype(np.float64)
    (a, b), (_, d) = np.moveaxis(weighted @ columns.swapaxes(1, 2), 0, -1)[..., None]
    u, v = np.moveaxis(weighted @ values, 1, 0)
    ks, kd = _pair(a + precision, b, d, u + precision * prior, v)
    information = np.where(d > 0, np.maximum(a - b * b / np.where(d > 0, d, 1), 0), a)[:, 0]
    explained = ks * (2 * u - a * ks - 2 * b * kd) + kd * (2 * v - d * kd)
    squares = np.sum((weights @ values**2)[:, 0] - explained, axis=1)
    residual = np.sqrt(np.maximum(squares, 0) / np.maximum(total.seen * values.shape[2], 1))
    return Strengths(*(values.astype(np.float32) for values in (kd, ks, information, residual)))


def _pair(a, b, d, u, v) -> tuple[np.ndarray, np.ndarray]:
    """Solve least squares in two non-negative unknowns: (of u, of v); 0 where a column is empty."""
    determinant = a * d - b * b
    regular = determinant > 1e-12 * a * d
    scale = 1 / np.where(regular, determinant, 1)
    k, m = (d * u - b * v) * scale, (a * v - b * u) * scale
    inside = regular & (k >= 0) & (m >= 0)
    k_alone, m_alone = (np.maximum(x, 0) / np.where(y > 0, y, np.inf) for x, y in ((u, a), (v, d)))
    first = k_alone * u > m_alone * v
    return np.where(inside, k, np.where(first, k_alone, 0)), np.where(inside, m, np.where(first, 0, m_alone))


def noise_of(residuals: np.ndarray) -> float:
    """Estimate the scene's noise (of weighted observations): median of the texels' root mean square residuals."""
    good = residuals[np.isfinite(residuals) & (residuals > 0)]
    return float(np.median(good)) if good.size else 1.0
