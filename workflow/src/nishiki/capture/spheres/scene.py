"""How well lamps explain the photographs of a scene: Lambert's law on blocks of pixels beside the mirror spheres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BLOCK = 8  # pixels of the side of a block
LEAST_BLOCKS = 40
DARK = 0.05  # of the bright blocks: darker ones tell nothing
SHADOW = 0.1  # of a block's brightest photograph: below it may lie in shadow
SATURATED = 0.95
TRIALS = 59  # orders of the lamps that are tried
MOST_RESIDUAL = 0.3
MOST_CHANCE = 0.05
LEAST_Z = 0.2  # of normals whose slopes count


@dataclass(frozen=True)
class SceneFit:
    """Agreement of lamps with a scene.

    Attributes
    ----------
    residual : float
        Share of the squared light that Lambert's law leaves.
    by_chance : float
        Share of random orders of the lamps that leave as little.
    tilt_deg : float
        Angle of the mean slope: a surface that returns to its height at the edge of the photograph is level on average.
    """

    residual: float
    by_chance: float
    tilt_deg: float

    @property
    def agrees(self) -> bool:
        """Whether the lamps explain the scene, and no other order of them does."""
        return self.residual < MOST_RESIDUAL and self.by_chance < MOST_CHANCE


def bright_blocks(stack: np.ndarray, free: np.ndarray) -> np.ndarray | None:
    """Average the light (n, blocks) of bright blocks beside the spheres; None where they are few.

    stack (n, rows, columns): light of the photographs, 1 at full scale; free (rows, columns): pixels of the scene.
    """
    rows, columns = (side // BLOCK for side in free.shape)

    def split(picture: np.ndarray) -> np.ndarray:
        return picture[..., : rows * BLOCK, : columns * BLOCK].reshape(-1, rows, BLOCK, columns, BLOCK)

    light = split(stack).mean(axis=(2, 4))[:, split(free).all(axis=(2, 4))[0]]
    brightest = light.max(axis=0) if light.size else np.zeros(0)
    if len(brightest) >= LEAST_BLOCKS:
        light = light[:, (brightest > DARK * np.percentile(brightest, 99)) & (brightest < SATURATED)]
    return light if light.shape[1] >= LEAST_BLOCKS else None


def residual_of(light: np.ndarray, directions: np.ndarray) -> float:
    """Compute the share of the squared light of blocks (n, blocks) that Lambert's law leaves.

    A turn of all lamps does not change it.
    """
    shares = light / np.linalg.norm(light, axis=0)
    across = np.linalg.qr(directions)[0]
    return float(1 - ((across.T @ shares) ** 2).sum() / shares.shape[1])


def fit_scene(light: np.ndarray | None, directions: np.ndarray) -> SceneFit | None:
    """Fit normals to blocks (n, blocks) of a scene under distant lamps (n, 3); None without blocks."""
    if light is None or len(directions) < 4:
        return None
    random = np.random.default_rng(0)
    residual = residual_of(light, directions)
    others = [residual_of(light, random.permutation(directions)) for _ in range(TRIALS)]
    used = light > SHADOW * light.max(axis=0)
    matrix = np.einsum("nb,ni,nj->bij", used, directions, directions) + 1e-6 * np.eye(3)
    normals = np.linalg.solve(matrix, np.einsum("nb,nb,ni->bi", used, light, directions)[..., None])[..., 0]
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    slopes = normals[:, :2] / np.maximum(normals[:, 2:], LEAST_Z)
    return SceneFit(
        residual,
        float(np.mean([other <= residual for other in others])),
        float(np.degrees(np.arctan(np.linalg.norm(slopes.mean(axis=0))))),
    )
