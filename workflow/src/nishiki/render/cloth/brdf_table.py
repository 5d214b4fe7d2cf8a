"""A cloth's BRDF as a table over half vector and difference, small enough for a page, and the look-up in it.

Gloss changes fast with the half vector h of light and view and slowly with the difference between them (Rusinkiewicz, A
new change of variables for efficient BRDF representation, 1998). The table has these four coordinates:

    (u, v) = (p_x + p_y, p_x - p_y), p = h / (|h_x| + |h_y| + h_z): a square for the half space, without a pole;
    ring   = t / t_max, t the angle between light and h, t_max the one at which light or view meets the horizon:
             every node is a pair of directions above it;
    turn   : azimuth of the difference about h, from the x axis as the shortest turn carries it from the normal to h.

It holds q = sqrt(f i_z o_z), which is finite at the horizon, and is linear between nodes.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product

import numpy as np

from nishiki.render.cloth.scene import Brdf, three
from nishiki.threads import threads

SIDES, RINGS, TURNS = 41, 13, 16
"""Nodes along u and v, along the ring, and of a whole turn. Measured in docs/stages/cloth_viewer.md."""
EDGE = 0.98
"""Largest |u| and |v|: at 1 the half vector is on the horizon, and light and view with it."""
OUTERMOST = 0.995
"""The last ring: at 1 light or view is on the horizon, where BRDFs are 0."""
STEPS = 4095
"""Whole steps of the stored numbers, from 0 to the largest."""
AT_ONCE = 1 << 14


@dataclass(frozen=True)
class BrdfTable:
    """codes (SIDES, SIDES, RINGS, TURNS, 3) uint16: sqrt(f i_z o_z) in steps of largest / STEPS; f in 1 / sr."""

    codes: np.ndarray
    largest: float
    channels: int = 3

    @classmethod
    def of(cls, brdf: Brdf) -> BrdfTable:
        """Evaluate a BRDF at the nodes, on all threads."""
        square = EDGE * np.linspace(-1, 1, SIDES)
        rings = np.minimum(np.linspace(0, 1, RINGS), OUTERMOST)
        turns = np.arange(TURNS) / TURNS
        nodes = [axis.ravel() for axis in np.meshgrid(square, square, rings, turns, indexing="ij")]
        values = np.empty((nodes[0].size, 3))

        def fill(start: int) -> None:
            rows = slice(start, start + AT_ONCE)
            incident, outgoing = directions(*(axis[rows] for axis in nodes))
            f = three(brdf.evaluate(incident, outgoing))
            values[rows] = np.sqrt(np.maximum(f * incident[:, 2:] * outgoing[:, 2:], 0))

        with ThreadPoolExecutor(threads()) as pool:
            for _ in pool.map(fill, range(0, len(values), AT_ONCE)):
                pass  # reading the results passes on an exception
        largest = float(values.max()) or 1.0
        codes = np.round(values / largest * STEPS).astype(np.uint16)
        return cls(codes.reshape(SIDES, SIDES, RINGS, TURNS, 3), largest)

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """(..., 3) sr^-1 for unit vectors (..., 3) in the frame weft, warp, normal; 0 below the horizon."""
        incident, outgoing = np.broadcast_arrays(incident, outgoing)
        above = (incident[..., 2] > 0) & (outgoing[..., 2] > 0)
        out = np.zeros((*above.shape, 3))
        i, o = incident[above], outgoing[above]
        u, v, ring, turn = coordinates(i, o)
        square = [(np.clip(axis / EDGE, -1, 1) + 1) / 2 * (SIDES - 1) for axis in (u, v)]
        places = [*square, ring * (RINGS - 1), turn * TURNS]
        last = (SIDES - 2, SIDES - 2, RINGS - 2, TURNS)
        lowest = [np.minimum(np.floor(place).astype(int), most) for place, most in zip(places, last, strict=True)]
        q = np.zeros((len(i), 3))
        for corner in product((0, 1), repeat=4):
            shares = [p - low if far else 1 - p + low for p, low, far in zip(places, lowest, corner, strict=True)]
            a, b, c, d = (low + far for low, far in zip(lowest, corner, strict=True))
            q += np.prod(shares, axis=0)[:, None] * self.codes[a, b, c, d % TURNS]
        out[above] = (q * (self.largest / STEPS)) ** 2 / (i[:, 2:] * o[:, 2:])
        return out


def coordinates(incident: np.ndarray, outgoing: np.ndarray) -> tuple[np.ndarray, ...]:
    """u and v, each -1 to 1, ring, 0 to 1, and turn, 0 to 1, of unit vectors (n, 3) above the horizon."""
    total, apart = incident + outgoing, incident - outgoing
    twice_cosine, twice_sine = (np.linalg.norm(vectors, axis=1) for vectors in (total, apart))
    h = total / twice_cosine[:, None]
    along = np.where(twice_sine[:, None] > 1e-9, apart / np.maximum(twice_sine, 1e-300)[:, None], (1.0, 0.0, 0.0))
    x, y = axes_about(h)
    turn = np.mod(np.arctan2(np.sum(along * y, axis=1), np.sum(along * x, axis=1)) / (2 * np.pi), 1.0)
    ring = np.arctan2(twice_sine, twice_cosine) / np.maximum(np.arctan2(h[:, 2], np.abs(along[:, 2])), 1e-12)
    p = h[:, :2] / np.abs(h).sum(axis=1)[:, None]
    return p[:, 0] + p[:, 1], p[:, 0] - p[:, 1], np.clip(ring, 0, 1), turn


def directions(u: np.ndarray, v: np.ndarray, ring: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (n, 3) to light and eye of these coordinates."""
    h = np.stack([(u + v) / 2, (u - v) / 2, 1 - np.maximum(np.abs(u), np.abs(v))], axis=1)
    h /= np.linalg.norm(h, axis=1)[:, None]
    x, y = axes_about(h)
    angle = 2 * np.pi * turn[:, None]
    along = np.cos(angle) * x + np.sin(angle) * y
    apart = (ring * np.arctan2(h[:, 2], np.abs(along[:, 2])))[:, None]
    return np.cos(apart) * h + np.sin(apart) * along, np.cos(apart) * h - np.sin(apart) * along


def axes_about(h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The axes x and y (n, 3) after the shortest turn that carries z to unit vectors (n, 3) above the horizon."""
    p = -1 / (1 + h[:, 2])
    xy = h[:, 0] * h[:, 1] * p
    x = np.stack([1 + h[:, 0] ** 2 * p, xy, -h[:, 0]], axis=1)
    return x, np.stack([xy, 1 + h[:, 1] ** 2 * p, -h[:, 1]], axis=1)
