"""Polarising optics as Mueller matrices, and what a series of generator and analyser angles can tell of a surface.

Stokes vectors (I, Q, U, V); angles from the first axis, the same way round for generator and analyser seen along the
light. Intensities are relative to the light that leaves the generator, as it would be without an analyser.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


def polariser(angle: float) -> np.ndarray:
    """(4, 4) ideal linear polariser at `angle` (radians)."""
    c, s = np.cos(2 * angle), np.sin(2 * angle)
    return 0.5 * np.outer([1, c, s, 0], [1, c, s, 0])


def retarder(retardance: float, angle: float) -> np.ndarray:
    """(4, 4) linear retarder with its fast axis at `angle` (radians): E. Collett, Field Guide to Polarization, 2005."""
    c, s, cd, sd = np.cos(2 * angle), np.sin(2 * angle), np.cos(retardance), np.sin(retardance)
    return np.array(
        [
            [1, 0, 0, 0],
            [0, c * c + s * s * cd, c * s * (1 - cd), -s * sd],
            [0, c * s * (1 - cd), s * s + c * c * cd, c * sd],
            [0, s * sd, -c * sd, cd],
        ]
    )


@dataclass(frozen=True)
class Arm:
    """One side of the instrument: a linear polariser, and before the object a retarder that turns (None: the polariser
    itself turns). retardance, polariser_angle, offset (of the turning part): radians."""

    retardance: float | None = None
    polariser_angle: float = 0.0
    offset: float = 0.0

    def generated(self, angle: float) -> np.ndarray:
        """(4,) Stokes vector of unit intensity that leaves the generator turned to `angle`."""
        if self.retardance is None:
            stokes = 2 * polariser(angle + self.offset)[:, 0]
        else:
            stokes = retarder(self.retardance, angle + self.offset) @ (2 * polariser(self.polariser_angle)[:, 0])
        return stokes

    def analysed(self, angle: float) -> np.ndarray:
        """(4,) row by which the analyser turned to `angle` weighs the Stokes vector that it meets."""
        if self.retardance is None:
            return polariser(angle + self.offset)[0]
        return (polariser(self.polariser_angle) @ retarder(self.retardance, angle + self.offset))[0]


def design_matrix(generator: Arm, analyser: Arm, angles: np.ndarray) -> np.ndarray:
    """(n, 16): intensity of state k = row k times the surface's Mueller matrix, row by row. angles (n, 2) radians:
    generator, analyser."""
    rows = [np.kron(analyser.analysed(a), generator.generated(g)) for g, a in angles]
    return np.array(rows)


LINEAR = tuple(4 * row + column for row in range(3) for column in range(3))


def solvable(design: np.ndarray) -> tuple[tuple[int, ...], float] | None:
    """Elements of the Mueller matrix (indices into 16) that a design determines: all, or the nine of linear
    polarisation where nothing in the design depends on the others; with the condition number. None: neither."""
    for elements in (tuple(range(16)), LINEAR):
        rest = [k for k in range(16) if k not in elements]
        if len(design) < len(elements) or np.abs(design[:, rest]).max(initial=0) > 1e-9:
            continue
        sizes = np.linalg.svd(design[:, elements], compute_uv=False)
        if sizes[-1] > 1e-9 * sizes[0]:
            return elements, float(sizes[0] / sizes[-1])
    return None


def equal_steps(angles_deg: np.ndarray) -> np.ndarray:
    """The angles, or the multiples of 180/n of n equal steps where each of them is such a multiple rounded to whole
    degrees: names like 23 and 68 mean 22.5 and 67.5."""
    angles_deg = np.asarray(angles_deg, np.float64)
    count = len(np.unique(angles_deg))
    step = 180 / max(count, 1)
    multiples = step * np.rint(angles_deg / step)
    rounded = np.abs(angles_deg - multiples) <= 0.5
    if rounded.all() and (angles_deg == np.rint(angles_deg)).all() and len(np.unique(multiples)) == count:
        return multiples
    return angles_deg


def retardance_of(k1: float, k2: float, wavelength_nm: float) -> float:
    """Radians, by the dispersion k1 / wavelength + k2 / wavelength^3 (Y. Queau et al., Design and simplified
    calibration of a Mueller imaging polarimeter for material classification, Optics Letters 43, 2018)."""
    return k1 / wavelength_nm + k2 / wavelength_nm**3
