"""Estimate the lighting of a turntable capture before its texels are fitted.

    I = K_d,c E(n),    E(n) = max(0, quadratic form of the normal in the lamp frame)

Irradiance of distant lighting is a quadratic form of the normal within a few percent, whatever the lamps are
(R. Ramamoorthi and P. Hanrahan, On the relationship between radiance and irradiance, J. Opt. Soc. Am. A 18, 2001).  A
texel turns through the lighting with the object, which tells E apart from its K_d.  E is the same for all channels: the
lamps' colour is in K_d.  Each texel's K_d is eliminated (variable projection) and the nine coefficients found by
Gauss-Newton with weights that fall with the residual, for cast shadows, highlights and wrong normals.  Highlights come
from one direction in the lamp frame, if left-out views confirm it.
"""

from dataclasses import dataclass, replace

import numpy as np

from nishiki.brdf.slopes import GRAZING
from nishiki.brdf.texels.model import HARMONICS, TO_LAMP_FRAME, CaptureLamps, facet_lobe
from nishiki.brdf.texels.shading import find_lamp, measure_misfit
from nishiki.brdf.texels.texel_fit import Sample
from nishiki.colour.colour import encoding_slope
from nishiki.geometry.camera import Camera

ROUNDS = 12  # at most
SETTLED = 1e-4  # relative change of E
TUKEY = 4.685  # of the scaled residual at which an observation counts nothing
SMOOTHNESS = 1e-4  # damping of a step relative to the data: what no texel tells stays as it was
FEWEST = 20  # texels seen three times or more, below which nothing is fitted


@dataclass(frozen=True)
class EnvironmentFit:
    """A fitted irradiance E.

    coefficients of E; the share of the squared deviation from a constant colour that E explains (of what the robust
    weights leave); rounds and texels that it took.
    """

    coefficients: tuple[float, ...]
    explained: float
    rounds: int
    texels: int


def harmonics(normals: np.ndarray) -> np.ndarray:
    """Evaluate the basis functions (..., 9) of E at unit normals (..., 3) in the lamp frame."""
    x, y, z = np.moveaxis(np.asarray(normals), -1, 0)
    return np.stack([np.ones_like(x), x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], axis=-1)


def fit_environment(values: np.ndarray, normals: np.ndarray, weights: np.ndarray) -> EnvironmentFit:
    """Fit E to texels: values (n, M, channels), normals (n, M, 3) in the lamp frame of each view, weights (n, M) >= 0.

    Scaled so that E is 1 at most over the normals that were seen.  With fewer than FEWEST texels seen three times, or
    without light, E is max(0, z), a lamp at the camera.
    """
    usable = np.sum(weights > 0, axis=1) >= 3
    values, weights = values[usable].astype(np.float64), weights[usable].astype(np.float64)
    basis = harmonics(normals[usable].astype(np.float64))
    start = np.array([0.5, 0, 0, 0.5, 0, 0, 0, 0, 0])
    if len(values) < FEWEST or not values.any():
        return EnvironmentFit((0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0.0, 0, len(values))
    e, robust = start, weights
    done, moved = 0, 1.0
    while done < ROUNDS and moved >= SETTLED:
        done += 1
        new = _positive(_step(values, basis, robust, e), basis, robust)
        new /= max(float(np.quantile((basis @ new)[weights > 0], 0.999)), 1e-12)
        moved = np.linalg.norm(new - e) / np.linalg.norm(e)
        e = new
        robust = weights * _tukey(_residuals(values, basis, robust, e), weights)
    left = np.sum(robust[..., None] * _residuals(values, basis, robust, e) ** 2)
    flat = np.sum(robust[..., None] * _residuals(values, basis, robust, np.eye(HARMONICS)[0]) ** 2)
    explained = float(1 - left / flat) if flat > 0 else 0.0
    return EnvironmentFit(tuple(e.tolist()), explained, done, len(values))


def _colours(values: np.ndarray, weights: np.ndarray, lit: np.ndarray) -> np.ndarray:
    below = np.einsum("to,to,to->t", weights, lit, lit)[:, None]
    return np.einsum("to,to,toc->tc", weights, lit, values) / np.where(below > 0, below, 1)


def _residuals(values: np.ndarray, basis: np.ndarray, weights: np.ndarray, e: np.ndarray) -> np.ndarray:
    lit = np.maximum(basis @ e, 0)
    return values - _colours(values, weights, lit)[:, None] * lit[..., None]


def _step(values: np.ndarray, basis: np.ndarray, weights: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Take one Gauss-Newton step of the projected problem (Kaufman): the part of each texel's E across its own column.

    Every texel counts by its brightness no more than others do: K_d is divided out of its equations.
    """
    lit = np.maximum(basis @ e, 0)
    kd = _colours(values, weights, lit)
    level = np.sum(kd**2, axis=1)
    equal = weights / np.where(level > 0, level, np.inf)[:, None]
    along = np.einsum("to,to,tok->tk", equal, lit, basis)
    norm = np.einsum("to,to->t", equal, lit**2)
    across = basis - (along / np.where(norm > 0, norm, 1)[:, None])[:, None] * lit[..., None]
    # sum over channels of kd_c^2 is `level`; of kd_c r_c, one number an observation
    residual = np.einsum("toc,tc->to", values - kd[:, None] * lit[..., None], kd)
    normal = np.einsum("to,t,toj,tok->jk", equal, level, across, across)
    right = np.einsum("to,to,tok->k", equal, residual, across)
    damp = SMOOTHNESS * np.trace(normal) / HARMONICS * np.eye(HARMONICS)
    return e + np.linalg.solve(normal + damp, right)


def _tukey(residuals: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Compute Tukey's biweight of the length of each observation's residual, scaled by the median of all."""
    length = np.sqrt(np.sum(residuals**2, axis=-1))
    counted = length[weights > 0]
    scale = TUKEY * 1.4826 * float(np.median(counted)) if counted.size else 0.0
    if not scale > 0:  # the median observation fits exactly, at whatever brightness: nothing to scale by
        return np.ones_like(length)
    return np.maximum(1 - (length / scale) ** 2, 0) ** 2


def residuals(values: np.ndarray, normals: np.ndarray, weights: np.ndarray, coefficients) -> np.ndarray:
    """Compute the residuals (n, M, channels) of E and the best K_d of each texel; arguments as of `fit_environment`."""
    e = np.asarray(coefficients, float)
    basis, values = harmonics(normals.astype(np.float64)), values.astype(np.float64)
    robust = weights * _tukey(_residuals(values, basis, weights, e), weights)
    return _residuals(values, basis, robust, e)


def _positive(e: np.ndarray, basis: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Find the nearest E (in least squares over the normals seen) that is nowhere negative among a sample of them."""
    rows = basis[weights > 0]
    rows = rows[:: max(len(rows) // 2000, 1)]
    constraint = np.zeros(len(rows))
    for _ in range(8):
        low = rows @ e < -1e-6
        if not low.any():
            break
        constraint += low * 10.0
        normal = rows.T @ (rows * (1 + constraint)[:, None])
        e = np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(HARMONICS), rows.T @ (rows @ e))
    return e


SIGMAS = (0.1, 0.2, 0.4)  # radians, tried
DIRECTIONS = 120  # over the hemisphere around the camera
RIDGE = 0.1  # of the mean square of the lobe over texels
LEAST_GAIN = 0.05  # of the squared residual of the left-out observations
ELSEWHERE = 0.75  # quantile of the directions' gains that the best has to surpass by that much
NOWHERE = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Highlight:
    """A direction (3,), 0 0 0 if none is supported; gain: further share of the left-out squared residual explained."""

    direction: tuple[float, float, float]
    gain: float


def fit_highlight(residuals: np.ndarray, normals: np.ndarray, to_camera: np.ndarray, weights: np.ndarray) -> Highlight:
    """Find the direction whose lobe, fitted to every other observation of each texel, best explains the rest.

    residuals (n, M): what the diffuse term leaves, mean of the channels; normals, to_camera (n, M, 3): unit, in the
    lamp frame of each view; weights (n, M) >= 0.  Every texel has its own K_s >= 0; the direction and one of SIGMAS are
    shared.  Accepted only if the observations that were left out gain LEAST_GAIN more than most
    directions give.
    """
    residuals, weights = residuals.astype(np.float32), weights.astype(np.float32)
    facing = np.maximum(np.sum(normals * to_camera, axis=-1), GRAZING)
    odd = (np.cumsum(weights > 0, axis=1) % 2).astype(np.float32)
    before = float(np.sum(weights * residuals**2))
    if before <= 0:
        return Highlight(NOWHERE, 0.0)
    gains = np.zeros(DIRECTIONS)
    tried = hemisphere(DIRECTIONS)
    for k, towards in enumerate(tried):
        half = to_camera + towards
        half = half / np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-6)
        apart = np.sum((normals - half) ** 2, axis=-1)  # alpha^2 but for its fourth power
        lit = (np.sum(normals * towards, axis=-1) > 0) / facing
        for sigma in SIGMAS:
            lobe = facet_lobe(apart, sigma) * lit
            both = (weights * odd, weights * (1 - odd))
            gain = sum(_gain(lobe, residuals, fitted, left, before) for fitted, left in (both, both[::-1]))
            gains[k] = max(gains[k], gain)
    # residuals of neighbouring views are alike for other reasons too (wrong normals, shadows) that favour no direction
    best = int(np.argmax(gains))
    gain = float(gains[best] - np.quantile(gains, ELSEWHERE))
    x, y, z = tried[best].tolist()
    return Highlight((x, y, z) if gain > LEAST_GAIN else NOWHERE, gain)


def _gain(lobe: np.ndarray, residuals: np.ndarray, fitted: np.ndarray, left: np.ndarray, before: float) -> float:
    """Compute the share of the squared residual that K_s from the `fitted` observations takes off those `left` out."""
    below = np.sum(fitted * lobe**2, axis=1)
    ridge = RIDGE * float(np.mean(below)) + 1e-30  # texels that never came near the mirror direction say nothing
    ks = np.maximum(np.sum(fitted * lobe * residuals, axis=1), 0) / (below + ridge)
    off = 2 * ks[:, None] * lobe * residuals - (ks[:, None] * lobe) ** 2
    return float(np.sum(left * off)) / before


def hemisphere(count: int) -> np.ndarray:
    """Return unit vectors (count, 3) float32 with z > 0, evenly spread on a spiral."""
    k = np.arange(count) + 0.5
    z = 1 - k / count
    turn = np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1).astype(np.float32)


FEWER = 1500  # texels by which a lamp is placed
LEAST_NEAR_GAIN = 0.01  # of the residual that the inverse square of a near lamp has to take off


def settle(
    stated: CaptureLamps,
    sample: Sample,
    cameras: list[Camera],
    light_of: np.ndarray,
    *,
    falloff: str,
    encoding: str = "linear",
    beside: bool = True,
) -> tuple[CaptureLamps, dict]:
    """Choose the lighting to fit with, and report how it was found.

    cameras: one an observation; light_of (M,): index of its light.  falloff: "auto", "none" or "inverse_square".
    encoding: in which errors count.  beside: whether a lamp stated at the camera may be found beside it.
    """
    if stated.kind == "unknown":
        return _fit_irradiance(sample, cameras, light_of, len(stated.vectors), encoding)
    centre, moved = sample.positions.mean(axis=0) if len(sample.positions) else np.zeros(3), {}
    if stated.kind == "camera" and beside:
        few, lit = sample.thin(FEWER), [np.flatnonzero(light_of == light) for light in range(len(stated.vectors))]
        found = [find_lamp(few, [cameras[o] for o in of], of, falloff=falloff != "none") for of in lit]
        if any(map(any, found)):
            stated, distance = CaptureLamps("position", tuple(found)), np.linalg.norm(cameras[0].centre - centre)
            moved = {"beside_camera_deg": np.degrees(np.arctan2(np.hypot(*np.array(found).T[:2]), distance)).tolist()}
    if stated.kind == "direction" or falloff == "none":
        return stated, {"falloff": "none", **moved}
    places = [stated.lamp(camera, int(light)).vector for camera, light in zip(cameras, light_of, strict=True)]
    near = replace(stated, reference=float(np.mean(np.linalg.norm(np.array(places) - centre, axis=1))))
    if falloff == "inverse_square":
        return near, {"falloff": falloff, **moved}
    few, centres = sample.thin(FEWER), np.array([camera.centre for camera in cameras])
    left = [
        measure_misfit(few, centres, [kind.lamp(*pair) for pair in zip(cameras, light_of.tolist(), strict=True)])
        for kind in (stated, near)
    ]
    chosen = near if left[1] < (1 - LEAST_NEAR_GAIN) * left[0] else stated
    name = "none" if chosen is stated else "inverse_square"
    residuals = {"residual_without_falloff": left[0], "residual_with_falloff": left[1]}
    return chosen, {"falloff": name, **residuals, **moved}


def _fit_irradiance(
    sample: Sample, cameras: list[Camera], light_of: np.ndarray, lights: int, encoding: str
) -> tuple[CaptureLamps, dict]:
    """Fit an irradiance and, if the views confirm it, a direction of highlights for each light."""
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
    return CaptureLamps("environment", tuple(vectors), tuple(harmonics)), {"environment": reports}
