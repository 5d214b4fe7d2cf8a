"""From photographs to reflectances: what one photograph of the cloth and its white boards give."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from nishiki.goniometry.normalise import reflectance
from nishiki.goniometry.whites import assign_boards
from nishiki.goniometry.windows import WindowSample, central_window, read_window, regions_in_view


class Photograph(Protocol):
    """linear (rows, columns, channels); saturated, usable (rows, columns) bool."""

    linear: np.ndarray
    saturated: np.ndarray
    usable: np.ndarray


@dataclass(frozen=True)
class Regions:
    """labels: picture of the cloth seen along its normal; numbers: the labels wanted, in order; upright, scale: see
    `windows.regions_in_view`."""

    labels: np.ndarray
    numbers: tuple[int, ...]
    upright: str
    scale: float


@dataclass(frozen=True)
class Readings:
    """values, noise (n, regions, channels) float64, sr^-1; valid (n, regions); pixels, saturated (n, regions): number
    that entered, share of them; rules: how many samples took their board by each rule."""

    values: np.ndarray
    noise: np.ndarray
    valid: np.ndarray
    pixels: np.ndarray
    saturated: np.ndarray
    rules: dict[str, int] = field(default_factory=dict)


def read_all(
    read_sample: Callable[[int], Photograph],
    read_white: Callable[[int], Photograph],
    sample_deg: np.ndarray,
    white_deg: np.ndarray,
    *,
    white_reflectance: np.ndarray,
    window_px: int,
    saturated_share: float = 0.0,
    regions: Regions | None = None,
    tick: Callable[[int], None] = lambda i: None,
) -> Readings:
    """Reflectances of all samples; each photograph is read once, one is in memory beside a board's.

    sample_deg (n, 4), white_deg (m, 4): theta_i, phi_i, theta_r, phi_r, NaN for a board's view that is not given;
    regions None: the central window. A reading is valid where pixels of it are in view, at most saturated_share of
    them saturated, and the mean is above 0 in every channel. A board of a sample's own directions is averaged over
    the sample's own pixels, any other over its central window.
    """
    boards = assign_boards(sample_deg, white_deg)
    middles = {i: _middle(read_white(i), window_px) for i in sorted({int(w) for b in boards for w in b.which})}
    names = ("cloth",) if regions is None else regions.numbers
    shape = (len(boards), len(names))
    values, noise = np.zeros((2, *shape, len(white_reflectance)))
    valid, pixels, saturated = np.zeros(shape, bool), np.zeros(shape, np.int64), np.zeros(shape)
    for i, board in enumerate(boards):
        photograph = read_sample(i)
        masks = _masks(photograph, sample_deg[i], window_px, regions)
        boards_read = [read_white(int(w)) for w in board.which] if board.rule == "own" and regions is not None else None
        for k, mask in enumerate(masks):
            reading = read_window(photograph.linear, mask & photograph.usable, photograph.saturated)
            over = [read_window(w.linear, mask & w.usable, w.saturated) for w in boards_read] if boards_read else None
            white, white_noise = _light_of(over or [middles[int(w)] for w in board.which], board.factors)
            values[i, k], noise[i, k] = reflectance(reading.mean, reading.noise, white, white_noise, white_reflectance)
            pixels[i, k], saturated[i, k] = reading.pixels, reading.saturated
            valid[i, k] = reading.pixels > 0 and reading.saturated <= saturated_share and bool((values[i, k] > 0).all())
        tick(i)
    values[~valid], noise[~valid] = 0.0, 0.0
    rules = {rule: sum(b.rule == rule for b in boards) for rule in ("own", "incidence", "cosine")}
    return Readings(values, noise, valid, pixels, saturated, rules)


def _middle(photograph: Photograph, window_px: int) -> WindowSample:
    inside = central_window(photograph.usable.shape, window_px)
    return read_window(photograph.linear, inside & photograph.usable, photograph.saturated)


def _masks(photograph: Photograph, angles_deg: np.ndarray, window_px: int, regions: Regions | None):
    """One mask a region."""
    shape = photograph.usable.shape
    if regions is None:
        return [central_window(shape, window_px)]
    theta, phi = np.radians(angles_deg[2:])
    seen = regions_in_view(
        regions.labels, shape, theta_r=theta, phi_r=phi, upright=regions.upright, scale=regions.scale
    )
    return [seen == number for number in regions.numbers]


def _light_of(readings: Sequence[WindowSample], factors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean light of the boards, each times its factor, and its standard deviation."""
    means = np.array([r.mean * f for r, f in zip(readings, factors, strict=True)])
    noises = np.array([r.noise * f for r, f in zip(readings, factors, strict=True)])
    return means.mean(axis=0), np.sqrt((noises**2).sum(axis=0)) / len(means)
