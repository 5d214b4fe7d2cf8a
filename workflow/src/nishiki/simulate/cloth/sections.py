"""Sections through the simulated cloth: outlines of the yarns, the surface above them, and how its facets lie."""

from __future__ import annotations

import numba
import numpy as np

from nishiki.simulate.cloth.geometry import Solids, Yarns
from nishiki.simulate.cloth.rays import inside
from nishiki.simulate.cloth.reflectance import Cloth, seen_from

_OUTLINE = 96


def sections(solids: Solids) -> dict:
    """Sections for the truth folder, lengths in mm: in the weft plane (x, z) along the middle of every weft yarn of
    a repeat, in the warp plane (y, z) along the middle of every warp yarn of a repeat.

    Each: at (place on the other axis), along (outline of the yarn that runs in the plane: upper and lower side), across
    (outlines of the crossing yarns), surface (the highest point of the cloth at each place). Lists of (place, z).
    """
    found = {}
    for plane, yarns, crossing in (("weft", solids.weft, solids.warp), ("warp", solids.warp, solids.weft)):
        count = len(yarns.shape)
        found[plane] = [
            _section(solids, plane, yarns, crossing, yarn) for yarn in range(min(count, _repeat(solids, count)))
        ]
    return found


def _repeat(solids: Solids, count: int) -> int:
    """Yarns of a repeat: the smallest shift along both axes that leaves the pattern as it is."""
    pattern = solids.pattern
    for size in range(1, count + 1):
        if count % size == 0 and (np.roll(pattern, size, axis=0) == pattern).all():
            return size
    return count


def _section(solids: Solids, plane: str, yarns: Yarns, crossing: Yarns, yarn: int) -> dict:
    offset, _, half = yarns.shape[yarn]
    at = (yarn + 0.5) * yarns.spacing + offset
    place = np.arange(yarns.path.shape[1]) * (yarns.length / yarns.path.shape[1])
    height = yarns.path[yarn, :, 0]
    outline = np.concatenate([[place, height + half], [place[::-1], height[::-1] - half]], axis=1).T
    angle = np.linspace(0.0, 2.0 * np.pi, _OUTLINE, endpoint=False)
    u = np.cos(angle)
    zeta = np.sign(np.sin(angle)) * np.sqrt(np.maximum(1.0 - np.abs(u) ** crossing.exponent, 0.0))
    across = []
    for k, (shift, a, b) in enumerate(crossing.shape):
        sample = int(at / crossing.length * crossing.path.shape[1]) % crossing.path.shape[1]
        centre, _, roll, _ = crossing.path[k, sample]
        middle = (k + 0.5) * crossing.spacing + shift
        across.append(np.column_stack([middle + a * u, centre + b * zeta + roll * a * u]))
    line = np.linspace(0.0, yarns.length, 40 * len(crossing.shape), endpoint=False)
    points = np.column_stack([line, np.full(len(line), at)])
    surface = highest(solids, points if plane == "weft" else points[:, ::-1])
    return {
        "at_mm": at,
        "along": _rounded(outline),
        "across": [_rounded(shape) for shape in across],
        "surface": _rounded(np.column_stack([line, surface])),
    }


def _rounded(points: np.ndarray) -> list:
    return np.round(points, 6).tolist()


def highest(solids: Solids, places: np.ndarray) -> np.ndarray:
    """(n,) z of the cloth's surface seen from above at places (n, 2) x, y in mm; the lowest z where there is a hole."""
    out = np.empty(len(places))
    _highest(solids.numbers, np.ascontiguousarray(places, float), out)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _highest(numbers, places, out):
    step = 0.002 * (numbers[3] - numbers[2])
    for n in range(places.shape[0]):
        z = numbers[3]
        while z > numbers[2] and inside(places[n, 0], places[n, 1], z, numbers) == 0:
            z -= step
        out[n] = z


def slopes(cloth: Cloth) -> dict:
    """How the surface that is seen from above lies: share of the cell's area by the facets' slope angle in the weft
    and in the warp plane, in bins of 2° from −90° to 90°; of warp and weft yarns apart."""
    seen = seen_from(cloth, np.array([[0.0, 0.0, 1.0]])).lit[0] > 0.0
    points = cloth.points
    normal, area = points.frame[seen, :3], points.area[seen]
    edges = np.arange(-90.0, 91.0, 2.0)
    found = {"edges_deg": edges.tolist()}
    for plane, axis in (("weft", 0), ("warp", 1)):
        angle = np.degrees(np.arctan2(normal[:, axis], normal[:, 2]))
        for kind, system in enumerate(("warp", "weft")):
            some = points.kind[seen] == kind
            weight = (area * normal[:, 2])[some] / cloth.solids.area
            share = np.histogram(angle[some], edges, weights=weight)[0]
            found[f"{system} yarns, {plane} plane"] = np.round(share, 6).tolist()
    return found
