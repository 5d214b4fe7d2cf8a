"""Cross-sections of a woven cloth: surface model, masking and profile (Takeda and Tanaka n.d., section 4).

Both sections are trains of two humps a period. Lengths are in any unit: masking depends on their ratios alone.
The weft section's row of yarns touches at the equator (contact = pi/2). The paper prints 2 a' as the length of a
contact, which with its own arcs a'_0 and a'_1 would give G(0) != 1; yarns that touch as full circles show pi r' from
above, and with that length G(0) = 1, G is continuous at every angle where the surface is smooth, and never rises.
"""

from dataclasses import asdict, dataclass, replace

import numpy as np
from numba import njit

from nishiki.weave.visibility import total_length, visible_share

HALF_PI = 0.5 * np.pi


class Section:
    """What the two sections have in common; `shape` is (theta_a, l, r, m, n, contact)."""

    shape: tuple[float, float, float, float, float, float]

    @property
    def length(self) -> float:
        """Length of the surface in one period."""
        return float(total_length(self.shape))

    @property
    def period(self) -> float:
        """Extent of one period along the cloth: its points projected on the x axis."""
        theta_a, length, radius, flat, yarns, contact = self.shape
        humps = 4.0 * (length * np.cos(theta_a) + radius * np.sin(theta_a))
        return float(humps + flat + 2.0 * (yarns - 1.0) * radius * np.sin(contact))

    @property
    def height(self) -> float:
        """Top of the humps above the valleys between them."""
        theta_a, length, radius = self.shape[:3]
        return float(length * np.sin(theta_a) + 2.0 * radius * np.sin(0.5 * theta_a) ** 2)

    def masking(self, theta_r) -> np.ndarray:
        """G: share of the surface's length that is seen from theta_r (radians, any shape, sign of no effect).

        1 at theta_r = 0, never rising with |theta_r|, 0 beyond pi/2. Equations 5-13 of the paper, with the
        arcs worked out.
        """
        theta = np.atleast_1d(np.asarray(theta_r, np.float64))
        out = _masking(self.shape, np.ascontiguousarray(theta).ravel())
        return out.reshape(np.shape(theta_r))

    def elements(self) -> np.ndarray:
        """The pieces of one period from valley to valley, (pieces, 3): length, slope angle at its start and end.

        Slope: angle of the tangent above the x axis. The number of yarns is rounded to the next whole one.
        """
        theta_a, length, radius, flat, yarns, contact = self.shape
        arc, side = radius * theta_a, radius * contact
        up = [(length, theta_a, theta_a), (arc, theta_a, 0.0)]
        down = [(arc, 0.0, -theta_a), (length, -theta_a, -theta_a)]
        row = [(side, 0.0, -contact), (side, contact, 0.0)] * (round(yarns) - 1)
        return np.array([*up, (flat, 0.0, 0.0), *row, *down, *up, *down])

    def profile(self, samples: int = 400) -> tuple[np.ndarray, np.ndarray]:
        """One period as a polyline of about `samples` points: points (k, 2) and outward unit normals (k, 2).

        It begins in a valley at (0, 0). A corner's point appears twice, once with the normal of either side.
        """
        pieces = self.elements()
        pieces = pieces[pieces[:, 0] > 0]
        total = pieces[:, 0].sum()
        at, points, normals = np.zeros(2), [], []
        for length, start, end in pieces:
            share = np.linspace(0.0, 1.0, max(2, round(samples * length / total)))
            slope = start + (end - start) * share
            # a chord of an arc has the mean slope and the length 2 R sin(turn / 2): exact, and fit for no turn at all
            middle, turn = 0.5 * (start + slope), 0.5 * (slope - start)
            chord = length * share * np.sinc(turn / np.pi)
            points.append(at + chord[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=-1))
            normals.append(np.stack([-np.sin(slope), np.cos(slope)], axis=-1))
            at = points[-1][-1]
        return np.concatenate(points), np.concatenate(normals)

    def scaled(self, factor: float):
        """The same section with all lengths times `factor` > 0."""
        names = ("l", "r", "m") if hasattr(self, "m") else ("l", "r")
        return replace(self, **{name: getattr(self, name) * factor for name in names})

    def as_dict(self) -> dict[str, float]:
        """Fields by name, as numbers."""
        return {name: float(value) for name, value in asdict(self).items()}

    def _check(self) -> None:
        theta_a, length, radius, flat, yarns, contact = self.shape
        if not np.all(np.isfinite(self.shape)):
            raise ValueError(f"section {self}: expected finite numbers")
        if not 0.0 < theta_a < HALF_PI:
            raise ValueError(f"theta_a = {theta_a}: expected an angle between 0 and pi/2, both excluded")
        if length < 0 or radius < 0 or length + radius <= 0 or flat < 0:
            raise ValueError(f"l = {length}, r = {radius}, m = {flat}: expected lengths >= 0, l or r above 0")
        if yarns < 1 or not 0.0 < contact <= HALF_PI:
            raise ValueError(f"n = {yarns}, contact = {contact}: expected n >= 1 and 0 < contact <= pi/2")


@dataclass(frozen=True)
class WarpSection(Section):
    """Section along the warp: theta_a (radians), flank l, radius r, flat top m of one of the two humps."""

    theta_a: float
    l: float  # noqa: E741 - the paper's letter
    r: float
    m: float = 0.0

    def __post_init__(self):
        self._check()

    @property
    def shape(self) -> tuple[float, float, float, float, float, float]:
        """(theta_a, l, r, m, n, contact)."""
        return (float(self.theta_a), float(self.l), float(self.r), float(self.m), 1.0, HALF_PI)


@dataclass(frozen=True)
class WeftSection(Section):
    """Section along the weft: theta_a (radians), flank l, radius r, one of the two humps a row of n touching yarns.

    contact: angle of the arcs on both sides of a contact; pi/2 (circles that touch) is the model, less stands for
    yarns that are pressed together or flattened and meet at that slope. n need not be whole (mean over a cloth).
    """

    theta_a: float
    l: float  # noqa: E741 - the paper's letter
    r: float
    n: float = 1.0
    contact: float = HALF_PI

    def __post_init__(self):
        self._check()

    @property
    def shape(self) -> tuple[float, float, float, float, float, float]:
        """(theta_a, l, r, m, n, contact)."""
        return (float(self.theta_a), float(self.l), float(self.r), 0.0, float(self.n), float(self.contact))


@njit(cache=True, nogil=True, error_model="numpy")
def _masking(shape, theta):
    out = theta.copy()
    for k in range(theta.size):
        out[k] = visible_share(shape, 0.0, theta[k])
    return out
