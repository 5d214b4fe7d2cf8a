"""Find one quantiser step for the whole object that meets a target of bytes, PSNR or bits per pixel.

Every tile is solved at the same step, so that a bit buys the same error everywhere. Passes over all tiles are few:
what is sought is smooth and monotone in the logarithm of the step, so a secant finds it.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from nishiki.codec.design import Design, Extent
from nishiki.codec.entropy import CodedBlock, Model, encode, pack, train
from nishiki.codec.tile_code import (
    CodedScene,
    CodedTile,
    Effort,
    Pixels,
    Refined,
    TileMaps,
    TileSurface,
    Typical,
    encode_tile,
    model_of,
    refine_tile,
    see,
)
from nishiki.threads import in_threads


def principal_channels(covariance: np.ndarray) -> np.ndarray:
    """Compute eigenvectors (C, C) float64 orthonormal of a (C, C) second moment, by falling eigenvalue (the KLT).

    Each row's largest entry is positive, so that the result does not depend on the solver's choice of sign. Entries are
    multiples of 2**-20, a number that a header holds exactly; the identity where nothing is known.
    """
    if not np.isfinite(covariance).all() or np.abs(covariance).max(initial=0) == 0:
        return np.eye(len(covariance))
    _, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    rows = vectors.T[::-1]
    largest = np.take_along_axis(rows, np.abs(rows).argmax(axis=1)[:, None], axis=1)
    return np.round(rows * np.sign(largest) * 2**20) / 2**20


NOTHING = Extent(0, 0, 0, 0, 8, 8)
SLOPE = -0.8  # of the logarithm of the bytes by that of the step, usually; -0.6 to -1.1 were measured
SLOPES = (-20.0, -0.02)
LARGEST_DB = 200.0
APART = 0.1  # of logarithms of steps
FARTHEST = 2.0  # move of the logarithm of the step


class TileSource(Protocol):
    """A source of tiles; called from several threads."""

    tiles: int

    def pixels(self, tile: int) -> Pixels:
        """Return a tile's object pixels, without held-out views."""

    def surface(self, tile: int) -> TileSurface:
        """Return the geometry of a tile."""

    def maps(self, tile: int) -> TileMaps:
        """Return the fitted reflection parameters of a tile."""


@dataclass(frozen=True)
class Sparse:
    """Integers of a block that are mostly zero."""

    shape: tuple[int, ...]
    places: np.ndarray
    values: np.ndarray

    @classmethod
    def of(cls, block: np.ndarray) -> "Sparse":
        """Keep the entries that are not zero."""
        places = np.flatnonzero(block)
        return cls(block.shape, places.astype(np.int32), block.ravel()[places])

    def full(self) -> np.ndarray:
        """Return the block, int32."""
        out = np.zeros(self.shape, np.int32)
        out.ravel()[self.places] = self.values
        return out


@dataclass(frozen=True)
class RatePoint:
    """One pass: step, bytes of tiles and start states, psnr_db over object pixels, kept coefficients."""

    step: float
    bytes: int
    psnr_db: float
    kept: int


@dataclass(frozen=True)
class EncodedObject:
    """A coded object.

    design, models (parameters, residual) and, per tile, extents, integers and their streams (parameters, residual;
    b"" where nothing is stored); pixels, errors as in `CodedTile`, summed; curve: passes made.
    """

    design: Design
    models: tuple[Model, Model]
    extents: list[Extent]
    integers: list[tuple[Sparse, ...] | None]
    streams: list[tuple[bytes, ...]]
    pixels: int
    error: float
    model_error: float
    kept: int
    curve: list[RatePoint]

    @property
    def bytes(self) -> int:
        """Bytes of all streams and start states."""
        return self.bytes_of_tiles + sum(len(pack(m)) for m in self.models)

    @property
    def bytes_of_tiles(self) -> int:
        """Bytes of all streams."""
        return sum(len(s) for tile in self.streams for s in tile)


@dataclass(frozen=True)
class Pilot:
    """The result of a first pass over all tiles.

    Refined parameters, the design with its colours and means, typical weights, and energy (tiles,) float64: sum of
    squares of the pixels that the model does not explain.
    """

    refined: list[Refined | None]
    design: Design
    typical: Typical
    energy: np.ndarray

    def sample(self, count: int) -> list[int]:
        """Choose about `count` of the tiles that any pixel sees, evenly spread over the model's residual energy."""
        seen = [tile for tile, refined in enumerate(self.refined) if refined is not None]
        order = sorted(seen, key=lambda tile: (-self.energy[tile], tile))
        count = min(count, len(order))
        return sorted(order[int((k + 0.5) * len(order) / count)] for k in range(count))

    def at_step(self, step: float, *, parameter_share: float = 1.0) -> "Pilot":
        """Scale the design's steps so that one parameter step changes the pictures as much as one residual step."""
        steps = [
            parameter_share * step * np.sqrt(self.typical.density / max(w, 1e-12)) for w in self.typical.parameters
        ]
        limits = ((1e-6, 1.0), (1e-6, 1.0), (0.02, 1.0))
        rounded = tuple(float(f"{np.clip(s, *limit):.4g}") for s, limit in zip(steps, limits, strict=True))
        return replace(self, design=replace(self.design, step=float(f"{step:.5g}"), parameter_steps=rounded))


def over(work: Callable, items: Sequence, threads: int, progress: Callable | None = None, what: str = "") -> Iterable:
    """Yield results of work(item) in order, several at a time, never more than a few ahead."""
    for done, result in enumerate(in_threads(work, items, threads, 2 * threads)):
        yield result
        if progress:
            progress(done + 1, len(items), what)


def pilot(
    source: TileSource, scene: CodedScene, design: Design, effort: Effort, *, threads: int, progress=None
) -> Pilot:
    """Refine the parameters of every tile; colours, means and typical weights from all of them."""

    def work(tile: int):
        seen = see(source.pixels(tile), source.surface(tile), design)
        if seen is None:
            return None, None, np.zeros(2)
        refined = refine_tile(seen, source.maps(tile), scene, design, effort)
        left = seen.values
        if design.model:
            left = left - seen.feet.look_up(model_of(refined.maps, seen, scene, design))
        left = left[:, seen.usable].astype(np.float64)
        density = seen.feet.density().astype(np.float64)
        return refined, left @ left.T, np.array([np.sum(density**2), np.sum(density)])

    refined, moments, densities = zip(*over(work, range(source.tiles), threads, progress, "parameters"), strict=True)
    total = sum((m for m in moments if m is not None), np.zeros((design.channels,) * 2))
    design = replace(design, colour=_tuple(principal_channels(total)))
    squares, density_sum = np.sum(densities, axis=0)
    density = float(squares / density_sum) if density_sum else 1.0
    energy = np.array([0.0 if m is None else np.trace(m) for m in moments])
    if not design.model:
        return Pilot(list(refined), design, Typical((0.0, 0.0, 0.0), density), energy)
    design, weights = _parameter_statistics([r for r in refined if r is not None], design)
    return Pilot(list(refined), design, Typical(weights, density), energy)


def _tuple(matrix: np.ndarray) -> tuple:
    return tuple(tuple(float(v) for v in row) for row in np.atleast_2d(matrix))


def _parameter_statistics(refined: list[Refined], design: Design) -> tuple[Design, tuple[float, ...]]:
    means, mixes, typical = [], [], []
    for name in ("kd", "ks"):
        values = np.concatenate([getattr(r.maps, name).reshape(-1, design.channels) for r in refined]).astype(float)
        weight = np.concatenate([getattr(r.weights, name).reshape(-1, design.channels) for r in refined]).mean(axis=1)
        total = weight.sum() or 1.0
        mean = np.round(weight @ values / total, 4)
        means.append(tuple(float(v) for v in mean))
        mixes.append(_tuple(principal_channels((values - mean).T @ ((values - mean) * weight[:, None]) / total)))
        typical.append(_usual(weight))
    weight = np.concatenate([r.weights.sigma.ravel() for r in refined]).astype(float)
    width = np.log(np.clip(np.concatenate([r.maps.sigma.ravel() for r in refined]), 1e-3, 1e3)).astype(float)
    means.append((float(np.round(weight @ width / (weight.sum() or 1.0), 4)),))
    typical.append(_usual(weight))
    return replace(design, parameter_means=tuple(means), parameter_colour=tuple(mixes)), tuple(typical)


def _usual(weight: np.ndarray) -> float:
    """Average the weights by themselves: sum of squares over sum, so that texels of no weight do not count."""
    return float(np.sum(weight.astype(float) ** 2) / max(np.sum(weight, dtype=float), 1e-30))


def one_pass(
    source: TileSource, scene: CodedScene, piloted: Pilot, effort: Effort, *, threads: int, progress=None,
    tiles: Sequence[int] | None = None, earlier: EncodedObject | None = None,
) -> EncodedObject:  # fmt: skip
    """Solve, quantise and code every tile, or only `tiles`, at the step of the pilot's design (`Pilot.at_step`).

    earlier: of the same tiles at a similar step; the solver goes on from there.
    """
    tiles, design = range(source.tiles) if tiles is None else tiles, piloted.design

    def work(place: int):
        tile, start = tiles[place], None
        if piloted.refined[tile] is None:
            return None
        if earlier is not None:
            start = earlier.integers[place][1].full() * np.float32(earlier.design.step)
        seen = see(source.pixels(tile), source.surface(tile), design)
        coded = encode_tile(seen, piloted.refined[tile], scene, design, effort, piloted.typical, start)
        empty = np.zeros(0, np.int32)
        light = replace(coded, parameters=empty, residual=empty)
        return light, (Sparse.of(coded.parameters), Sparse.of(coded.residual))

    results = list(over(work, range(len(tiles)), threads, progress, f"tiles at step {design.step:.4g}"))
    coded: list[CodedTile] = [r[0] for r in results if r is not None]
    extents = [NOTHING if r is None else r[0].extent for r in results]
    integers = [None if r is None else r[1] for r in results]
    models, streams = code_streams(integers, extents, design, threads=threads, start=earlier and earlier.models)
    sums = {name: sum(getattr(t, name) for t in coded) for name in ("pixels", "error", "model_error")}
    kept = sum(len(pair[1].places) for pair in integers if pair is not None)
    return EncodedObject(design, models, extents, integers, streams, kept=kept, curve=[], **sums)


def code_streams(
    blocks: list[tuple[Sparse, ...] | None], extents: list[Extent], design: Design, *, threads: int,
    start: tuple[Model, Model] | None = None,
) -> tuple[tuple[Model, Model], list[tuple[bytes, ...]]]:  # fmt: skip
    """Code all tiles after two rounds of training, or one from the models `start`; tiles of zeros become b""."""

    def code(model: Model, part: int):
        def work(tile: int) -> CodedBlock | None:
            held = blocks[tile]
            if held is None or not len(held[part].places):
                return None
            plane = (design.plane if part else design.parameter_plane)(extents[tile])
            return encode(held[part].full(), plane.levels, model)

        return list(over(work, range(len(blocks)), threads))

    models, coded = [], []
    for part in (0, 1):
        model = start[part] if start else Model.initial()
        for _ in range(1 if start else 2):
            model = train([c for c in code(model, part) if c is not None])
        models.append(model)
        coded.append(code(model, part))
    streams = [tuple(b"" if c[tile] is None else c[tile].data for c in coded) for tile in range(len(blocks))]
    return (models[0], models[1]), streams


def psnr(error: float, samples: int) -> float:
    """Compute decibels at full scale 1 of a sum of squares; LARGEST_DB where it is 0 or nothing was measured."""
    if samples == 0 or error <= 0:
        return LARGEST_DB
    return min(LARGEST_DB, float(-10 * np.log10(error / samples)))


def point_of(encoded: EncodedObject, share: float = 1.0) -> RatePoint:
    """Return the result of a pass, or its estimate for the whole object if it covered a share of the tiles."""
    quality = psnr(encoded.error, encoded.pixels * encoded.design.channels)
    size = encoded.bytes + round(encoded.bytes_of_tiles * (1 / share - 1))
    return RatePoint(encoded.design.step, size, quality, round(encoded.kept / share))


def find_step(
    run: Callable[[float, EncodedObject | None], EncodedObject],
    miss: Callable[[RatePoint], float],
    *,
    start: float,
    passes: int,
    tolerance: float = 0.02,
    share: float = 1.0,
    slope: float = SLOPE,
    compete: Callable[[RatePoint], bool] | None = None,
) -> EncodedObject:
    """Find the step that misses the target least by Newton's method on the logarithm of the step.

    run: one pass at a step, going on from the pass before. miss: of a pass, its value less that of the target, which
    falls as the step grows (bytes and kept as logarithms, PSNR as it is). tolerance: of the value. share: of the tiles
    that a pass covers. slope: of the value, until two passes tell it. compete: whether the result of further passes may
    be of use. At least two passes are made where `passes` allows: a solution that goes on from another is better than
    one that begins from nothing.
    """
    curve, steps, off, encoded, best, least = [], [start], [], None, None, math.inf
    while True:
        encoded = run(steps[-1], encoded)
        curve.append(point_of(encoded, share))
        off.append(miss(curve[-1]))
        if best is None or abs(off[-1]) < least or abs(off[-1]) <= tolerance:
            best, least = encoded, abs(off[-1])
        met = abs(off[-1]) <= tolerance and len(curve) > 1
        if met or len(curve) >= passes or (compete is not None and not compete(curve[-1])):
            return replace(best, curve=curve)
        slope = slope_of(steps, off, slope)
        steps.append(_next_step(steps, off, slope))


def slope_of(steps: Sequence[float], off: Sequence[float], slope: float = SLOPE) -> float:
    """Estimate the slope of a value by the logarithm of the step.

    It is taken between the last pass and the nearest to the goal of those more than a tenth away, since passes at
    almost the same step give no slope; without such a pass it is the given one.
    """
    logs = np.log(steps)
    apart = [k for k in range(len(steps) - 1) if abs(logs[k] - logs[-1]) > APART]
    if not apart:
        return slope
    other = min(apart, key=lambda k: abs(off[k]))
    measured = (off[-1] - off[other]) / (logs[-1] - logs[other])
    return float(np.clip(measured, *SLOPES)) if np.isfinite(measured) else slope


def _next_step(steps: list[float], off: list[float], slope: float) -> float:
    logs = np.log(steps)
    ahead = logs[-1] - np.clip(off[-1] / slope, -FARTHEST, FARTHEST)
    low = max((x for x, y in zip(logs, off, strict=True) if y > 0), default=-np.inf)
    high = min((x for x, y in zip(logs, off, strict=True) if y <= 0), default=np.inf)
    if high - low > APART and not low < ahead < high and np.isfinite([low, high]).all():
        ahead = (low + high) / 2
    return float(np.exp(ahead))
