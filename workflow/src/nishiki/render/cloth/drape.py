"""The cloth that pictures show: a square of 1 m that fell over a ball, simulated once and kept as a file.

`tests/benchmarks/draped_cloth.py` made the file: extended position-based dynamics (Macklin et al. 2016 and 2019) of a
sheet of 250 g/m2 over a ball of 16 cm. The points are kept as whole steps of 2 micrometres, as differences of
differences along both axes: they are small, so that they compress to half of what single precision would take.
"""

from pathlib import Path

import numpy as np

FILE = Path(__file__).with_name("draped_cloth.npz")
STEP = 2e-6
"""Metres; it turns no normal of the smooth surface by more than 0.05 degrees."""


def write_drape(path: Path, points: np.ndarray) -> None:
    """Write a grid of points (n, n, 3), metres."""
    steps = np.round(points / STEP).astype(np.int32)
    differences = np.diff(np.diff(steps, axis=0, prepend=0), axis=1, prepend=0)
    np.savez_compressed(path, differences=differences)


def read_drape(path: Path = FILE) -> np.ndarray:
    """(n, n, 3) float64 points in metres, [i, j] at weft i and warp j; y is up, the floor is y = 0."""
    with np.load(path) as stored:
        return STEP * np.cumsum(np.cumsum(stored["differences"], axis=0), axis=1)
