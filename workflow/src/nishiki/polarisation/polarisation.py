"""Separate diffuse and specular reflection of one view from photographs under several polariser states.

The diffuse part left the body after many scatterings and is taken as unpolarised, the specular part as keeping what
the lamp's polariser gave it. Derivations: docs/notes/stages/polarise.md.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.artifacts.declaration import Output
from nishiki.errors import UserError, require
from nishiki.formats.stored import BandedGroup, chunk_path, open_made_by, read_chunk, write_chunk
from nishiki.polarisation.polariser_states import StateSums


@dataclass(frozen=True)
class SeparatedView:
    """The components of one view.

    diffuse, specular (rows, columns, channels) float32, 0 where not valid; specular may be negative, which is noise.
    valid (rows, columns) bool: every photograph that was used is valid there, and what divides is known.
    """

    diffuse: np.ndarray
    specular: np.ndarray
    valid: np.ndarray


def sum_planes(
    photographs: Iterable[tuple[np.ndarray, np.ndarray]], weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sum weighted photographs to (planes, rows, columns, channels) float32, and find where all that count are valid.

    photographs: (values (rows, columns, channels) float32, valid (rows, columns) bool) in the order of the columns of
    weights (planes, states); taken one at a time, those of weight 0 too.
    """
    planes: np.ndarray | None = None
    valid: np.ndarray | None = None
    for column, (values, good) in zip(weights.T, photographs, strict=True):
        if planes is None or valid is None:
            planes, valid = np.zeros((len(weights), *values.shape), np.float32), np.ones(good.shape, bool)
        if not column.any():
            continue
        valid &= good & np.isfinite(values).all(axis=-1)
        values = np.where(np.isfinite(values), values, 0).astype(np.float32)
        for plane, weight in zip(planes, column.astype(np.float32), strict=True):
            plane += weight * values
    return require(planes), require(valid)


def components(
    planes: np.ndarray,
    valid: np.ndarray,
    sums: StateSums,
    *,
    beta: np.ndarray | None = None,
    phase: float | None = None,
    sense: int = 1,
    gain: np.ndarray | None = None,
) -> SeparatedView:
    """Compute the two components of planes made by `sum_planes` with `sums.weights`.

    none: all counts as diffuse. circular (Miyazaki et al. 2007, section 2.2): I_d = I_on / beta, I_s = I_off - I_d;
    beta broadcasts against a picture, NaN where it is unknown (those pixels become invalid). crossed, pairs: I_d = 2
    crossed, I_s = parallel - crossed. linear: I_d = 2 (a - b), I_s = 2 b; b is the amplitude of each pixel, or, with a
    phase (radians), the amplitude at that common angle, which may be negative. mueller: I_s = (m11 + sense m22) / 2,
    I_d = m00 - I_s.
    gain: factor on both, broadcasts; NaN where unknown.
    """
    if (beta is None) == (sums.method == "circular"):
        raise ValueError("circular polarisation needs beta, other methods take none")
    planes, two = np.asarray(planes, np.float32), np.float32(2)
    factor = np.asarray(1.0 if gain is None else gain, np.float32)
    with np.errstate(all="ignore"):
        if beta is not None:
            factor = np.asarray(beta, np.float32)
            diffuse = planes[1] / factor
            specular = planes[0] - diffuse
            valid = valid & (np.atleast_1d(factor) > 0).all(axis=-1)
        elif sums.method == "linear" and phase is None:
            specular = two * np.hypot(planes[1], planes[2], dtype=np.float64).astype(np.float32)
            diffuse, specular = (two * planes[0] - specular) * factor, specular * factor
        else:
            diffuse, specular = (
                sum(weight * plane for weight, plane in zip(weights, planes, strict=True)) * factor
                for weights in _last_step(sums.method, phase, sense)
            )
        unknown = np.isnan(0 * diffuse + 0 * specular)  # of infinities, too
        known = valid & ~np.logical_or.reduce([unknown[..., k] for k in range(unknown.shape[-1])])
    shown = known[..., None]
    return SeparatedView(np.where(shown, diffuse, np.float32(0)), np.where(shown, specular, np.float32(0)), known)


def _last_step(method: str, phase: float | None, sense: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of the planes in diffuse and specular, float32, for methods that are sums of planes."""
    along = (0.0, 0.0) if phase is None else (np.cos(2 * phase), np.sin(2 * phase))
    rows = {
        "none": ([1], [0]),
        "crossed": ([0, 2], [1, -1]),
        "pairs": ([0, 2], [1, -1]),
        "linear": ([2, -2 * along[0], -2 * along[1]], [0, 2 * along[0], 2 * along[1]]),
        "mueller": ([1, -0.5, -0.5 * sense], [0, 0.5, 0.5 * sense]),
    }[method]
    return np.array(rows[0], np.float32), np.array(rows[1], np.float32)


def common_phase(planes: np.ndarray, valid: np.ndarray) -> tuple[float, float]:
    """Find the angle psi0 (radians) of the strongest light over a picture, and the agreement of its pixels.

    The agreement, 0 to 1, is the length of the sum of their vectors over the sum of their lengths; planes as of
    `linear`.
    """
    cosine, sine = (planes[k][valid].astype(np.float64) for k in (1, 2))
    total = np.array([cosine.sum(), sine.sum()])
    lengths = np.hypot(cosine, sine).sum()
    return float(np.arctan2(total[1], total[0]) / 2), float(np.hypot(*total) / lengths) if lengths > 0 else 0.0


def reflected_sense(m11: np.ndarray, m22: np.ndarray) -> int:
    """Decide by the picture whether a mirror's m22 has the sign of m11 (+1) or the opposite (-1).

    +1: angles seen from one side; -1: seen along the light, which a reflection reverses. Polarisation that is kept
    shows in both elements.
    """
    return 1 if float(np.sum(np.sign(m11) * m22, dtype=np.float64)) >= 0 else -1


LIT = 0.1  # of the bright end of a board or picture (99 %): darker pixels say nothing
FILLED = 0.25  # of a block's pixels must be lit


@dataclass(frozen=True)
class Beta:
    """Beta of a board."""

    channel: tuple[float, ...]  # (channels,): beta of the whole board
    field: np.ndarray  # (rows, columns, channels) float32: by place, NaN where it is below the limit
    covered: float  # share of the blocks that the board fills, the others have the channel's value
    low: int  # pixels below the limit in a channel
    spread: tuple[float, float]  # (5th, 95th percentile) of the blocks relative to the channel


def board_ratio(
    over: np.ndarray, under: np.ndarray, *, block: int = 16, least: float, what: str = "beta", local: bool = True
) -> Beta:
    """Divide two board images (rows, columns, channels), sums over blocks of `block` pixels, bilinear in between.

    A ratio below `least` is never divided by: such pixels become NaN and are counted. local False: one value a channel.

    Raises UserError where a channel's ratio as a whole is below `least`, or the board is dark.
    """
    over, under = np.asarray(over, np.float64), np.asarray(under, np.float64)
    known = np.isfinite(over) & np.isfinite(under)  # a value that is missing in one must not count in the other
    over, under = np.where(known, over, 0.0), np.where(known, under, 0.0)
    bright = np.percentile(under, 99, axis=(0, 1))
    if (bright <= 0).any():
        raise UserError(f"{what}: the white board is dark in channel {int(np.argmin(bright))}. Remedy: take it again")
    lit = known & (under > LIT * bright) & (over >= 0)
    top, bottom = (np.where(lit, each, 0.0) for each in (over, under))
    channel = top.sum(axis=(0, 1)) / bottom.sum(axis=(0, 1))
    if (channel < least).any():
        place = int(np.argmin(channel))
        raise UserError(
            f"{what}: the board through the polarisers has {channel[place]:.2g} of its light in channel {place}, the "
            f"limit is {least:g} (below it is noise). Remedy: omit the channel, expose longer, or turn the polariser"
        )
    blocks = channel[None, None]
    covered, spread = 1.0, (1.0, 1.0)
    if local:
        cells = [_cells(each, block) for each in (top, bottom, lit)]
        filled = cells[2] >= FILLED * _cells(np.ones(lit.shape), block)
        blocks = np.where(filled, cells[0] / np.where(filled, cells[1], 1.0), channel)
        covered = float(filled.mean())
        shares = (blocks / channel)[filled]
        spread = tuple(np.percentile(shares, (5, 95)).tolist()) if shares.size else spread
    field = _between(blocks, over.shape[:2], block)
    low = field < least
    field = np.where(low, np.nan, field).astype(np.float32)
    return Beta(tuple(channel.tolist()), field, covered, int(low.any(axis=-1).sum()), spread)


def _cells(values: np.ndarray, block: int) -> np.ndarray:
    """Sum over blocks of block x block pixels, the last ones smaller."""
    rows, columns = (np.arange(0, size, block) for size in values.shape[:2])
    return np.add.reduceat(np.add.reduceat(values.astype(np.float64), rows, axis=0), columns, axis=1)


def _between(blocks: np.ndarray, shape: tuple[int, int], block: int) -> np.ndarray:
    """Interpolate bilinearly between the centres of the blocks, constant outside: (*shape, channels) float64."""
    for axis, size in enumerate(shape):
        count = blocks.shape[axis]
        centres = (np.minimum(np.arange(count) * block + block, size) + np.arange(count) * block - 1) / 2
        place = np.interp(np.arange(size), centres, np.arange(count)) if count > 1 else np.zeros(size)
        lower = np.minimum(place.astype(int), max(count - 2, 0))
        upper = np.minimum(lower + 1, count - 1)
        weight = (place - lower).reshape([-1 if k == axis else 1 for k in range(3)])
        blocks = np.take(blocks, lower, axis=axis) * (1 - weight) + np.take(blocks, upper, axis=axis) * weight
    return blocks


STORE = "components.zarr"
FORMAT = 1  # of the file; readers refuse others


class ComponentWriter:
    """Writes `components.zarr` as the stage declares it."""

    def __init__(
        self,
        folder: Path,
        outputs: Iterable[Output],
        *,
        views: tuple[str, ...],
        lights: tuple[str, ...],
        shape: tuple[int, int],
        channels: tuple[str, ...],
        stamp: dict[str, str],
    ):
        self.path = Path(folder) / STORE
        group = BandedGroup.create(self.path)
        for output in outputs:
            size = (len(views) * len(lights), *shape, 1 if output.name == "valid" else len(channels))
            chunk, about = (1, *size[1:]), output.attributes
            group.create_array(output.name, size, chunk, output.dtype, compression="zstd", attributes=about)
        group.update(
            format=FORMAT,
            views=list(views),
            lights=list(lights),
            channels=list(channels),
            shape=list(shape),
            stamp=stamp,
        )

    def write(self, observation: int, view: SeparatedView) -> None:
        """Write one observation (light_index * views + view_index)."""
        for name, values in (
            ("diffuse", view.diffuse.astype("<f4", copy=False)),
            ("specular", view.specular.astype("<f4", copy=False)),
            ("valid", view.valid.astype(np.uint8)[..., None]),
        ):
            write_chunk(chunk_path(self.path / name, observation, 0), values, compression="zstd")


class Components:
    """The components of one artifact, for reading; one observation is in memory at a time.

    views, lights, channels: names; shape (rows, columns); observations: lights times views.
    """

    def __init__(self, folder: Path | str):
        """Open `components.zarr`, or the folder that holds it. UserError where it is none."""
        path = Path(folder)
        self.path = path if path.name == STORE else path / STORE
        _, stored = open_made_by("polarise", self.path, "components", FORMAT)
        self.views, self.lights, self.channels = (tuple(stored[name]) for name in ("views", "lights", "channels"))
        self.shape: tuple[int, int] = tuple(stored["shape"])
        self.observations = len(self.views) * len(self.lights)

    def read(self, observation: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Read diffuse, specular (rows, columns, channels) float32 and valid (rows, columns) bool of an observation.

        specular may be negative (noise); the observation is light_index * views + view_index.
        """
        if not 0 <= observation < self.observations:
            raise UserError(f"{self.path}: no observation {observation}; there are {self.observations}")
        diffuse, specular = (
            self._chunk(name, observation, len(self.channels), np.float32) for name in ("diffuse", "specular")
        )
        return diffuse, specular, self._chunk("valid", observation, 1, np.uint8)[..., 0] != 0

    def _chunk(self, name: str, observation: int, depth: int, dtype) -> np.ndarray:
        place = chunk_path(self.path / name, observation, 0)
        return read_chunk(place, (*self.shape, depth), dtype, compression="zstd")
