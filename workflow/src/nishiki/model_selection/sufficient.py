"""Whether a reflection model suffices: what it leaves of the photographs is noise, or less than was asked for."""

from dataclasses import dataclass

import numpy as np

from nishiki.model_selection.decision import Decision

LIMIT = 0.1  # share of what is left that its neighbours tell
MARGIN_DB = 0.2  # a sample of tiles is not the object
REACH = 2.0  # texels to a neighbour
NEIGHBOURS = 16
MOST = 4000  # pixels of a tile that are looked at
STEP = 0.5  # of the parameters' quantiser, in standard deviations of what is left: adds 2 % to it
OVERRIDE = "residual.sufficient: never"


@dataclass(frozen=True)
class Left:
    """What the model leaves on a sample: mean square (full scale 1), structure: share that neighbours tell, pixels."""

    mean_square: float
    structure: float
    pixels: int

    @property
    def psnr_db(self) -> float:
        """Of the model alone; 200 where nothing is left."""
        return min(200.0, float(-10 * np.log10(max(self.mean_square, 1e-20))))

    @property
    def step(self) -> float:
        """Quantiser step at which coding the parameters adds next to nothing."""
        return max(STEP * float(np.sqrt(self.mean_square)), 1e-5)


def what_is_left(tiles) -> Left:
    """From (left (channels, n), observation (n,), s (n,), t (n,)) of some tiles; s, t: places in texels.

    structure: correlation of what is left at a pixel with what is left at its nearest neighbour, in the same picture
    and, where another picture sees the place within REACH, in that one; the larger of the two (J. von Neumann, Ratio of
    the mean square successive difference to the variance, Ann. Math. Stat. 12, 1941, is 2 less twice the first).
    Noise has none. If what is left is a structure that neighbours share and noise that they do not, it is the share of
    the structure in its energy: the most that coding can take off without coding noise.
    """
    sums, squares, count = np.zeros((2, 3)), 0.0, 0
    for left, observation, s, t in tiles:
        squares += float(np.sum(left.astype(np.float64) ** 2))
        count += left.size
        for k, (texel, other) in enumerate(_pairs(observation, s, t)):
            a, b = left[:, texel].astype(np.float64), left[:, other].astype(np.float64)
            sums[k] += np.sum(a * b), np.sum(a * a), np.sum(b * b)
    energy = np.sqrt(sums[:, 1] * sums[:, 2])
    correlation = np.where(energy > 0, sums[:, 0] / np.where(energy > 0, energy, 1), 0.0)
    return Left(squares / max(count, 1), float(max(correlation.max(), 0.0)), count)


def _pairs(observation: np.ndarray, s: np.ndarray, t: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Indices (texel, neighbour) of nearest neighbours: in the same picture, and in another one."""
    from scipy.spatial import cKDTree

    places = np.column_stack([s, t]).astype(np.float64)
    texels = np.arange(0, len(places), max(1, len(places) // MOST))
    if len(places) < 2:
        return []
    distance, near = cKDTree(places).query(places[texels], k=min(NEIGHBOURS, len(places)))
    apart = near != texels[:, None]
    same = observation[near] == observation[texels][:, None]
    pairs = []
    for group in (apart & same, apart & ~same):
        eligible = group & (distance <= REACH)
        first, there = np.argmax(eligible, axis=1), eligible.any(axis=1)
        pairs.append((texels[there], near[there, first[there]]))
    return pairs


def model_suffices(left: Left, target: str, amount: float, *, limit: float = LIMIT) -> bool:
    """Whether nothing but the model needs to be stored: it reaches a PSNR asked for, or leaves noise alone."""
    if left.pixels == 0:
        return False
    if target == "psnr":
        return left.psnr_db >= amount + MARGIN_DB
    return left.structure <= limit


def decided(left: Left, target: str, amount: float, setting: str, *, limit: float = LIMIT) -> Decision:
    """What was decided, for the log and the diagnostics."""
    enough = setting == "auto" and model_suffices(left, target, amount, limit=limit)
    words = "model alone: no residual stored" if enough else "residual stored"
    if target == "psnr":
        return Decision(
            "residual", words, "PSNR of the model alone on a sample of tiles, dB", left.psnr_db, amount,
            "the target is reached; a few percent more bytes" if enough else "nothing", OVERRIDE,
        )  # fmt: skip
    most = -10 * np.log10(max(1 - left.structure, 1e-3))
    loss = f"at most {most:.2g} dB beside the noise, the model reaching {left.psnr_db:.1f} dB" if enough else "nothing"
    criterion = "share of the model's residual that neighbouring pixels predict (noise: 0)"
    return Decision("residual", words, criterion, left.structure, limit, loss, OVERRIDE)
