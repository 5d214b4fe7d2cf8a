"""Turn photographs of a cloth and its white boards into reflectances."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from nishiki.errors import UserError
from nishiki.goniometry.directions import between, unit

TILE = 4  # pixels: the noise of neighbours, and the texture of yarns, go together


@dataclass(frozen=True)
class WindowSample:
    """The mean of a window."""

    mean: np.ndarray  # (channels,) float64 in the units of the pixels
    noise: np.ndarray  # (channels,): standard deviation of the mean
    pixels: int  # number that entered
    saturated: float  # share of the window's pixels


def read_window(linear: np.ndarray, usable: np.ndarray, saturated: np.ndarray) -> WindowSample:
    """Average the usable pixels of an image (rows, columns, channels); estimate the mean's standard deviation.

    The scatter is that between tiles of TILE x TILE pixels, each weighted by its usable pixels: neighbours that vary
    together would otherwise pass for independent. Saturated pixels enter the mean; their share is told.
    """
    rows, columns, channels = linear.shape
    tile = (np.arange(rows) // TILE)[:, None] * (columns // TILE + 1) + np.arange(columns) // TILE
    chosen = usable.ravel()
    count = int(chosen.sum())
    if count == 0:
        return WindowSample(np.zeros(channels), np.zeros(channels), 0, 0.0)
    tile = tile.ravel()[chosen]
    values = linear.reshape(-1, channels)[chosen].astype(np.float64)
    share = np.bincount(tile) / count
    kept = share > 0
    sums = np.stack([np.bincount(tile, values[:, k])[kept] for k in range(channels)], axis=1)
    share = share[kept]
    mean = sums.sum(axis=0) / count
    tiles = len(share)
    if tiles > 1:
        scatter = ((sums / count - share[:, None] * mean) ** 2).sum(axis=0) * tiles / (tiles - 1)
    else:
        scatter = values.var(axis=0) / count
    return WindowSample(mean, np.sqrt(scatter), count, float(saturated.ravel()[chosen].mean()))


def central_window(shape: tuple[int, int], side: int) -> np.ndarray:
    """Mark the square of this side in the middle: (rows, columns) bool."""
    inside = np.zeros(shape, bool)
    (top, height), (left, width) = (((n - min(n, side)) // 2, min(n, side)) for n in shape)
    inside[top : top + height, left : left + width] = True
    return inside


def axes_of(theta_r: float, phi_r: float, upright: str) -> tuple[np.ndarray, np.ndarray]:
    """Compute the unit vectors to the right and up in a photograph from this direction, in the cloth's frame.

    Directions are in radians.

    upright 'cloth': the warp (y) points up as far as it can; 'arm': the plane through normal and camera is vertical,
    the far side of the cloth on top, as on a camera arm before a turning table.
    """
    view = unit(theta_r, phi_r)
    if upright == "arm":
        up = -unit(theta_r + np.pi / 2, phi_r)
    else:
        up = np.array([0.0, 1.0, 0.0]) - view[1] * view
        up = up / np.linalg.norm(up)
    return np.cross(up, view), up


def regions_in_view(
    labels: np.ndarray, shape: tuple[int, int], *, theta_r: float, phi_r: float, upright: str, scale: float = 1.0
) -> np.ndarray:
    """Project the labels to a photograph of this shape taken from (theta_r, phi_r) in parallel: (rows, columns) uint16.

    labels: of the cloth seen along its normal, warp up, its middle where the axes of the goniometer meet, in the
    middle of every photograph; scale: size of the photograph's pixel over that of the label picture's. A pixel has a
    label only where its centre and its corners, a whole pixel out, fall on that label: borders belong to none.
    """
    labels = np.asarray(labels, np.uint16)
    right, up = axes_of(theta_r, phi_r, upright)
    to_cloth = scale * np.linalg.inv(np.array([right[:2], up[:2]]))  # (right, up) of the picture to (weft, warp)
    u = np.arange(-1, shape[1] + 1) - (shape[1] - 1) / 2  # pixels from the middle, one beyond each border
    w = (shape[0] - 1) / 2 - np.arange(-1, shape[0] + 1)[:, None]
    (last_row, last_column), (weft, warp) = np.subtract(labels.shape, 1), to_cloth
    row = np.floor(last_row / 2 - (warp[0] * u + warp[1] * w) + 0.5).astype(np.int64)
    column = np.floor(last_column / 2 + weft[0] * u + weft[1] * w + 0.5).astype(np.int64)
    inside = (row >= 0) & (row <= last_row) & (column >= 0) & (column <= last_column)
    found = np.where(inside, labels[row.clip(0, last_row), column.clip(0, last_column)], 0)
    middle = found[1:-1, 1:-1]
    whole = [found[top:, left:][: shape[0], : shape[1]] == middle for top in (0, 2) for left in (0, 2)]
    return np.where(np.all(whole, axis=0), middle, 0).astype(np.uint16)


SAME = np.radians(0.1)
GRAZING = 0.05  # cosine between lamp and board below which a board tells nothing of other incidences
Rule = Literal["own", "incidence", "cosine"]


@dataclass(frozen=True)
class Boards:
    """The boards of a sample."""

    # own (the sample's pair of directions), incidence (its light), or cosine (all boards, by the cosine law)
    rule: Rule
    which: np.ndarray  # indices of the boards
    factors: np.ndarray  # their light times these is that of the board under the sample's light


def assign_boards(sample_deg: np.ndarray, white_deg: np.ndarray) -> list[Boards]:
    """Assign boards to each sample.

    They are those of its own directions, else those of its incidence (a diffuse board looks the same from everywhere),
    else all that are not grazed, times cos(theta_i) / cos(theta_W).

    sample_deg (n, 4): theta_i, phi_i, theta_r, phi_r; white_deg (m, 4): likewise, NaN for a view that is not given.
    """
    white = np.radians(np.asarray(white_deg, np.float64))
    lights, views = unit(white[:, 0], white[:, 1]), unit(white[:, 2], white[:, 3])
    cosines = lights[:, 2]
    known: dict[tuple, Boards] = {}
    boards = []
    for row in np.radians(np.asarray(sample_deg, np.float64)):
        key = tuple(np.round(row, 9))
        if key not in known:
            known[key] = _of(unit(row[0], row[1]), unit(row[2], row[3]), lights, views, cosines)
        boards.append(known[key])
    return boards


def _of(light: np.ndarray, view: np.ndarray, lights: np.ndarray, views: np.ndarray, cosines: np.ndarray) -> Boards:
    same_light = between(lights, light) < SAME
    with np.errstate(invalid="ignore"):
        same_pair = same_light & (between(views, view) < SAME)
    rules: tuple[tuple[Rule, np.ndarray], ...] = (("own", same_pair), ("incidence", same_light))
    for rule, chosen in rules:
        which = np.flatnonzero(chosen)
        if len(which):
            return Boards(rule, which, np.ones(len(which)))
    which = np.flatnonzero(cosines > GRAZING)
    if not len(which):
        steep = np.degrees(np.arccos(GRAZING))
        raise UserError(
            f"white boards: expected one lit below {steep:.0f} degrees for a sample at another incidence, found none "
            f"of {len(lights)}. Remedy: photograph the board at the sample's incidences"
        )
    return Boards("cosine", which, light[2] / cosines[which])


@dataclass(frozen=True)
class Averaged:
    """Averages over repeats."""

    rows: np.ndarray  # (m,): index of the first measurement of each pair of directions
    values: np.ndarray  # values, noise: (m, regions, channels)
    noise: np.ndarray
    valid: np.ndarray  # (m, regions)
    repeats: np.ndarray  # (m,): measurements that were brought together


def reflectance(
    light: np.ndarray, noise: np.ndarray, white: np.ndarray, white_noise: np.ndarray, white_reflectance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute rho = (L_sample / L_white) rho_white / pi and its standard deviation, sr^-1.

    All are (..., channels), L in any one unit, exposure times divided out. Relative variances add. The result is 0
    where the board gave no light, or so little that the quotient leaves float64.
    """
    known = white > 0
    safe = np.where(known, white, 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        scale = np.where(known, white_reflectance / (np.pi * safe), 0.0)
        values = light * scale
        deviation = np.hypot(noise * scale, values * (white_noise / safe))
    finite = np.isfinite(values) & np.isfinite(deviation)
    return np.where(finite, values, 0.0), np.where(finite, deviation, 0.0)


def average_repeats(
    angles_deg: np.ndarray, values: np.ndarray, noise: np.ndarray, valid: np.ndarray, exposures: np.ndarray
) -> Averaged:
    """Average measurements of the same pair of directions, weighted by exposure time, those not valid left out.

    angles_deg (n, 4); values, noise (n, regions, channels); valid (n, regions); exposures (n,) > 0. The order of the
    first measurements is kept. Where none of a pair is valid the result is 0 and not valid.
    """
    folded = np.round(np.where(angles_deg[:, [0, 0, 2, 2]] == 0, [[1, 0, 1, 0]], 1) * angles_deg, 4)
    folded[:, [1, 3]] = np.round(folded[:, [1, 3]] % 360, 4) % 360
    _, rows, group = np.unique(folded, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(rows)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    group = rank[group.ravel()]
    rows = rows[order]
    weights = np.where(valid, exposures[:, None], 0.0)
    total = np.zeros((len(rows), valid.shape[1]))
    np.add.at(total, group, weights)
    usable = total > 0
    share = weights / np.where(usable, total, 1.0)[group]
    mean, variance = np.zeros((2, len(rows), *values.shape[1:]))
    # what is not valid may be no number at all: a share of 0 would not take it out
    values, noise = (np.where(valid[..., None], of, 0.0) for of in (values, noise))
    np.add.at(mean, group, share[..., None] * values)
    np.add.at(variance, group, (share[..., None] * noise) ** 2)
    return Averaged(rows, mean, np.sqrt(variance), usable, np.bincount(group))


@dataclass(frozen=True)
class ClothPhotograph:
    """A photograph of the cloth or of a board."""

    # (rows, columns, channels) float32: light as a fraction of full scale, divided by the exposure time where it is
    # given
    linear: np.ndarray
    saturated: np.ndarray  # (rows, columns) bool: in any channel
    usable: np.ndarray  # (rows, columns) bool: finite and no defect, whether saturated or not


@dataclass(frozen=True)
class Regions:
    """The labels of regions."""

    labels: np.ndarray  # picture of the cloth along its normal
    numbers: tuple[int, ...]  # labels in order
    upright: str  # upright, scale: see `windows.regions_in_view`
    scale: float


@dataclass(frozen=True)
class Readings:
    """The reflectances read from photographs."""

    values: np.ndarray  # values, noise (n, regions, channels) float64, sr^-1
    noise: np.ndarray
    valid: np.ndarray  # (n, regions)
    pixels: np.ndarray  # pixels, saturated (n, regions): number and share of saturated ones
    saturated: np.ndarray
    rules: dict[str, int] = field(default_factory=dict)  # number of samples by the rule of their board


def read_all(
    read_sample: Callable[[int], ClothPhotograph],
    read_white: Callable[[int], ClothPhotograph],
    angles_deg: tuple[np.ndarray, np.ndarray],
    *,
    white_reflectance: np.ndarray,
    window_px: int,
    regions: Regions | None = None,
    tick: Callable[[int], None] = lambda i: None,
) -> Readings:
    """Compute reflectances of all samples; each photograph is read once, one is in memory beside a board's.

    angles_deg (n, 4) of samples, (m, 4) of boards: theta_i, phi_i, theta_r, phi_r, NaN for a board's view not given;
    regions None: the central window. A reading is valid where pixels of it are in view, none of them saturated,
    and the mean is above 0 in every channel. A board of a sample's own directions is averaged over
    the sample's own pixels, any other over its central window.
    """
    boards = assign_boards(*angles_deg)
    middles = {i: _middle(read_white(i), window_px) for i in sorted({int(w) for b in boards for w in b.which})}
    names = ("cloth",) if regions is None else regions.numbers
    shape = (len(boards), len(names))
    values, noise = np.zeros((2, *shape, len(white_reflectance)))
    valid, pixels, saturated = np.zeros(shape, bool), np.zeros(shape, np.int64), np.zeros(shape)
    for i, board in enumerate(boards):
        photograph = read_sample(i)
        masks = _masks(photograph, angles_deg[0][i], window_px, regions)
        boards_read = [read_white(int(w)) for w in board.which] if board.rule == "own" and regions is not None else None
        for k, mask in enumerate(masks):
            reading = read_window(photograph.linear, mask & photograph.usable, photograph.saturated)
            over = [read_window(w.linear, mask & w.usable, w.saturated) for w in boards_read] if boards_read else None
            shown = over or [middles[int(w)] for w in board.which]
            white = np.array([r.mean * f for r, f in zip(shown, board.factors, strict=True)]).mean(axis=0)
            noises = np.array([r.noise * f for r, f in zip(shown, board.factors, strict=True)])
            white_noise = np.sqrt((noises**2).sum(axis=0)) / len(noises)
            values[i, k], noise[i, k] = reflectance(reading.mean, reading.noise, white, white_noise, white_reflectance)
            pixels[i, k], saturated[i, k] = reading.pixels, reading.saturated
            valid[i, k] = reading.pixels > 0 and reading.saturated == 0 and bool((values[i, k] > 0).all())
        tick(i)
    values[~valid], noise[~valid] = 0.0, 0.0
    rules = {rule: sum(b.rule == rule for b in boards) for rule in ("own", "incidence", "cosine")}
    return Readings(values, noise, valid, pixels, saturated, rules)


def _middle(photograph: ClothPhotograph, window_px: int) -> WindowSample:
    inside = central_window(photograph.usable.shape, window_px)
    return read_window(photograph.linear, inside & photograph.usable, photograph.saturated)


def _masks(photograph: ClothPhotograph, angles_deg: np.ndarray, window_px: int, regions: Regions | None):
    """Make one mask a region."""
    shape = photograph.usable.shape
    if regions is None:
        return [central_window(shape, window_px)]
    theta, phi = np.radians(angles_deg[2:])
    seen = regions_in_view(
        regions.labels, shape, theta_r=theta, phi_r=phi, upright=regions.upright, scale=regions.scale
    )
    return [seen == number for number in regions.numbers]
