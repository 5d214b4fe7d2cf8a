"""Settle the lighting before the texels are fitted: what a capture does not state is fitted on a sample of texels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from nishiki.brdf.texels.environment import fit_environment, fit_highlight, residuals
from nishiki.brdf.texels.lighting import TO_LAMP_FRAME, Lighting
from nishiki.brdf.texels.model import factors
from nishiki.brdf.texels.tile import Tile
from nishiki.colour.encoding import encoding_slope
from nishiki.geometry.camera import Camera

SAMPLE = 4000  # texels
LEAST_GAIN = 0.01  # of the residual that the inverse square of a near lamp has to take off


@dataclass(frozen=True)
class Sample:
    """Texels picked evenly: positions, normals (n, 3); values (n, M, channels) total radiance; visible (n, M)."""

    positions: np.ndarray
    normals: np.ndarray
    values: np.ndarray
    visible: np.ndarray


def sample_texels(read: Callable[[int], Tile], tiles: list[int], count: int = SAMPLE) -> Sample:
    """Every k-th texel of every tile, about `count` in all; of tiles in even steps where these are many."""
    chosen = tiles[:: max(len(tiles) // 200, 1)]
    parts = [[], [], [], []]
    for number in chosen:
        tile = read(number)
        seen = np.flatnonzero(tile.inside.ravel() & (tile.visible.reshape(len(tile.visible), -1).sum(axis=0) >= 3))
        picked = seen[:: max(len(seen) * len(chosen) // count, 1)]
        total = tile.values if tile.specular is None else tile.values + tile.specular
        flat = total.reshape(total.shape[0], -1, total.shape[-1])
        values = [tile.positions.reshape(-1, 3)[picked], tile.normals.reshape(-1, 3)[picked]]
        values += [np.moveaxis(flat[:, picked], 1, 0), tile.visible.reshape(len(flat), -1)[:, picked].T]
        for part, value in zip(parts, values, strict=True):
            part.append(value)
    return Sample(*(np.concatenate(part) for part in parts))


def settle(
    stated: Lighting,
    sample: Sample,
    cameras: list[Camera],
    light_of: np.ndarray,
    *,
    falloff: str,
    encoding: str = "linear",
) -> tuple[Lighting, dict]:
    """The lighting to fit with, and a report of how it was found.

    cameras: one an observation; light_of (M,): index of its light.  falloff: "auto", "none" or "inverse_square".
    encoding: in which errors count.
    """
    if stated.kind == "unknown":
        return _fitted(sample, cameras, light_of, len(stated.vectors), encoding)
    if stated.kind == "direction" or falloff == "none":
        return stated, {"falloff": "none"}
    near = replace(stated, reference=_distance(stated, sample, cameras, light_of))
    if falloff == "inverse_square":
        return near, {"falloff": falloff}
    left = [_lambert_residual(lighting, sample, cameras, light_of) for lighting in (stated, near)]
    chosen = near if left[1] < (1 - LEAST_GAIN) * left[0] else stated
    name = "none" if chosen is stated else "inverse_square"
    return chosen, {"falloff": name, "residual_without_falloff": left[0], "residual_with_falloff": left[1]}


def _fitted(
    sample: Sample, cameras: list[Camera], light_of: np.ndarray, lights: int, encoding: str
) -> tuple[Lighting, dict]:
    """An irradiance and, if the views confirm it, a direction of highlights for each light."""
    harmonics, vectors, reports = [], [], []
    turned = [TO_LAMP_FRAME @ camera.rotation for camera in cameras]
    for light in range(lights):
        of = np.flatnonzero(light_of == light)
        normals = np.stack([sample.normals @ turned[o].T for o in of], axis=1).astype(np.float32)
        towards = np.stack([(cameras[o].centre - sample.positions) @ turned[o].T for o in of], axis=1)
        towards = (towards / np.linalg.norm(towards, axis=-1, keepdims=True)).astype(np.float32)
        weights = sample.visible[:, of] * np.maximum(np.sum(normals * towards, axis=-1), 0)
        values = sample.values[:, of]
        if encoding == "srgb":
            weights = weights * encoding_slope(values.mean(axis=-1), "srgb") ** 2
        fit = fit_environment(values, normals, weights)
        left = residuals(values, normals, weights, fit.coefficients).mean(axis=-1)
        lobe = fit_highlight(left, normals, towards, weights)
        harmonics.append(tuple((value,) for value in fit.coefficients))
        vectors.append(lobe.direction)
        reports.append(
            {"explained": fit.explained, "rounds": fit.rounds, "texels": fit.texels, "highlight_gain": lobe.gain}
        )
    return Lighting("environment", tuple(vectors), tuple(harmonics)), {"environment": reports}


def _distance(lighting: Lighting, sample: Sample, cameras: list[Camera], light_of: np.ndarray) -> float:
    centre = sample.positions.mean(axis=0) if len(sample.positions) else np.zeros(3)
    places = [lighting.lamp(camera, int(light)).vector for camera, light in zip(cameras, light_of, strict=True)]
    return float(np.mean(np.linalg.norm(np.array(places) - centre, axis=1)))


def _lambert_residual(lighting: Lighting, sample: Sample, cameras: list[Camera], light_of: np.ndarray) -> float:
    """Median deviation of the sample from the Lambert term alone, relative to the texels' level."""
    lit, weights = (np.zeros(sample.visible.shape) for _ in range(2))
    for o, camera in enumerate(cameras):
        lamp = lighting.lamp(camera, int(light_of[o]))
        q, angles = factors(sample.positions, sample.normals, camera.centre, lamp, 1)
        lit[:, o], weights[:, o] = q[:, 0], sample.visible[:, o] * np.maximum(angles[:, 1], 0)
    values = sample.values.mean(axis=-1)
    below = np.sum(weights * lit**2, axis=1)
    kd = np.sum(weights * lit * values, axis=1) / np.where(below > 0, below, 1)
    off = np.abs(values - kd[:, None] * lit) / np.maximum(kd, 1e-30)[:, None]
    return float(np.median(off[weights > 0])) if np.any(weights > 0) else 0.0
