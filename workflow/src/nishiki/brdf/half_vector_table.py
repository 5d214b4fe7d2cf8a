"""BRDFs as tables that follow their lobe, as the database of Dupuy and Jakob (2018) has them.

For each direction i of the light the table has a square of numbers (s, t). A warp carries it to half vectors m, in
proportion to the facets that i sees, so that most nodes lie where the gloss is:

    D(m)        facets of a surface that sends back into the light what the BRDF sends back: D ~ 4 sigma f(m, m) m_z
    sigma(i)  = integral of max(i.m, 0) D(m) over m
    v(i, m)   = max(i.m, 0) D(m) / sigma(i), the density that the warp has
    q(s, t)   = f(i, o) o_z 4 sigma(i) / D(m), o = 2 (i.m) m - i: what is stored

Directions are places in a square: x = sqrt(2 theta / pi), y = (phi + pi) / 2 pi. All tables are linear between their
nodes; the warp is the one whose density is so, rows (y) first, then the place in the row (x).
Reference: J. Dupuy and W. Jakob (2018), An adaptive parameterization for efficient material acquisition and rendering,
ACM Transactions on Graphics 37 (6); D by power iteration: J. Dupuy et al. (2015), Extracting microfacet-based BRDF
parameters from arbitrary materials with power iterations, Computer Graphics Forum 34 (4).
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from nishiki.goniometry.directions import unit
from nishiki.threads import in_threads

Evaluate = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""BRDF (n, channels), sr^-1, of unit vectors (n, 3) to light and eye, normal z; 0 below the horizon."""
SIDE = 32
"""Nodes of a square of q;"""
POLAR, AROUND = SIDE, 2 * SIDE + 1
"""of D, sigma and v from the normal to the horizon and around it;"""
INCIDENT = 16
"""Number of angles of the light from the normal."""
AZIMUTHS = 25
"""Number of azimuths of the light, both ends of the turn counted. Measured in docs/notes/stages/cloth_export.md."""
LOWEST = np.radians(88.0)
"""Largest angle of the light from the normal."""
LEAST = 1e-3
"""Cosine of directions on the horizon, which models leave out, and D over its largest: where a surface sends nothing
back, something may still be seen from elsewhere."""
ITERATIONS = 8  # steps of the search


@dataclass(frozen=True)
class HalfVectorTable:
    """A BRDF as a table over the half vector."""

    theta: np.ndarray  # (a,) of the light, radians
    phi: np.ndarray  # (b,) of the light, radians
    facets: np.ndarray  # facets, area (around, polar): D and sigma
    area: np.ndarray
    visible: np.ndarray  # (b, a, around, polar): v, of integral 1 over the square
    values: np.ndarray  # (b, a, channels, side, side): q, 0 for an eye below the horizon

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.values.shape[2]

    @classmethod
    def of(cls, evaluate: Evaluate) -> "HalfVectorTable":
        """Tabulate a BRDF."""
        theta = np.linspace(0, LOWEST, INCIDENT)
        phi = np.linspace(-np.pi, np.pi, AZIMUTHS)
        facets, area = facets_of(evaluate)
        m, x = grid_directions(), np.linspace(0, 1, POLAR)
        jacobian = np.sin(np.pi / 2 * x**2) * x
        s = np.linspace(0, 1, SIDE)
        t, s = (axis.ravel() for axis in np.meshgrid(s, s, indexing="ij"))

        def square(place: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
            light = unit(theta[place[1]], phi[place[0]])
            seen = np.maximum(m @ light, 0) * facets * jacobian
            seen /= float(trapezoid(seen.shape[0]) @ seen @ trapezoid(seen.shape[1]))
            where = warp(seen, s, t)
            half = unit(np.pi / 2 * where[0] ** 2, (2 * where[1] - 1) * np.pi)
            eye = 2 * (half @ light)[:, None] * half - light
            f = evaluate(np.broadcast_to(light, eye.shape), eye) * np.maximum(eye[:, 2:], 0)
            own_area = interpolate_table(area, *square_place(light[None]))
            return seen, f * (4 * own_area / interpolate_table(facets, *where))[:, None]

        places = list(product(range(len(phi)), range(len(theta))))
        squares = list(in_threads(square, places))
        visible = np.array([seen for seen, _ in squares]).reshape(len(phi), len(theta), *facets.shape)
        values = np.array([q.T for _, q in squares]).reshape(len(phi), len(theta), -1, SIDE, SIDE)
        tables = (np.asarray(each, np.float32) for each in (theta, phi, facets, area, visible, values))
        return cls(*tables)

    def evaluate(self, incident: np.ndarray, outgoing: np.ndarray) -> np.ndarray:
        """Evaluate the BRDF (..., channels), sr^-1, of unit vectors (..., 3) in x, y, normal; 0 below the horizon."""
        incident, outgoing = np.broadcast_arrays(incident, outgoing)
        above = (incident[..., 2] > 0) & (outgoing[..., 2] > 0)
        out = np.zeros((*above.shape, self.channels))
        i, o = incident[above], outgoing[above]
        half = (i + o) / np.linalg.norm(i + o, axis=1, keepdims=True)
        theta, phi = np.arctan2(np.hypot(i[:, 0], i[:, 1]), i[:, 2]), np.arctan2(i[:, 1], i[:, 0])
        x, y = square_place(half)
        corners = [
            (of_b * of_a, (b, a)) for b, of_b in between(self.phi, phi) for a, of_a in between(self.theta, theta)
        ]
        s, t = unwarp(self.visible, corners, x, y)
        values = np.moveaxis(self.values, 2, -1)
        q = sum(weight[:, None] * interpolate_table(values, s, t, at) for weight, at in corners)
        scale = interpolate_table(self.facets, x, y) / (4 * interpolate_table(self.area, *square_place(i)))
        out[above] = q * (scale / o[:, 2])[:, None]
        return out

    def arrays(self, description: str) -> dict[str, np.ndarray]:
        """Return the content of a `.bsdf` of three channels, linear sRGB; luminance: by which directions are drawn."""
        return {
            "description": np.frombuffer(description.encode(), np.uint8),
            "phi_i": self.phi,
            "theta_i": self.theta,
            "ndf": self.facets,
            "sigma": self.area,
            "vndf": self.visible,
            "rgb": self.values,
            "luminance": self.values.mean(axis=2),
            "jacobian": np.ones(1, np.uint8),
        }


def facets_of(evaluate: Evaluate) -> tuple[np.ndarray, np.ndarray]:
    """Compute D and sigma (around, polar) of a BRDF, by power iteration on its retroreflection.

    Even facets where that is nothing.
    """
    m = grid_directions()
    upright = np.maximum(m[..., 2], 0)
    lit = m.reshape(-1, 3).copy()
    lit[:, 2] = np.maximum(lit[:, 2], LEAST)
    lit /= np.linalg.norm(lit, axis=1, keepdims=True)
    back = evaluate(lit, lit).mean(axis=1).reshape(upright.shape) * upright
    x = np.linspace(0, 1, POLAR)
    solid = np.sin(np.pi / 2 * x**2) * x * trapezoid(POLAR) * trapezoid(AROUND)[:, None] * 2 * np.pi**2
    seen = np.maximum(m.reshape(-1, 3) @ m.reshape(-1, 3).T, 0)
    facets = np.ones_like(upright)
    for _ in range(ITERATIONS if back.sum() > 0 else 0):
        facets = facets / np.sum(facets * upright * solid)
        facets = (seen @ (facets * solid).ravel()).reshape(upright.shape) * back
    facets = np.maximum(facets, LEAST * facets.max())
    facets /= np.sum(facets * upright * solid)
    return facets, (seen @ (facets * solid).ravel()).reshape(upright.shape)


def warp(density: np.ndarray, s: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Warp s and t (n,), 0 to 1, by a density (rows, columns) to places x, y (n,) in the square."""
    rows, columns = density.shape
    along = running(density)
    totals = along[:, -1]
    marginal = running(totals)
    target = t * marginal[-1]
    row = np.clip(np.searchsorted(marginal, target, side="right") - 1, 0, rows - 2)
    v = linear_root(totals[row], totals[row + 1], target - marginal[row])
    below, above = along[row], along[row + 1]
    line = below + v[:, None] * (above - below)
    target = s * line[:, -1]
    column = np.clip((line <= target[:, None]).sum(axis=1) - 1, 0, columns - 2)
    each = np.arange(len(s))
    first, last = (density[row, at] + v * (density[row + 1, at] - density[row, at]) for at in (column, column + 1))
    u = linear_root(first, last, target - line[each, column])
    return (column + u) / (columns - 1), (row + v) / (rows - 1)


def unwarp(densities: np.ndarray, corners: list, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find s, t (n,) that the warp carries to x, y; its density is the sum of weight densities[at] over corners."""
    rows, columns = densities.shape[-2:]
    along = running(densities)
    totals = along[..., -1]
    marginal = running(totals)
    row, column, v, u = cell(rows, columns, x, y)

    def sum_tables(table: np.ndarray, *place: np.ndarray) -> np.ndarray:
        return sum(weight * table[(*at, *place)] for weight, at in corners)

    def in_row(table: np.ndarray, place: np.ndarray) -> np.ndarray:
        return (1 - v) * sum_tables(table, row, place) + v * sum_tables(table, row + 1, place)

    left, right = in_row(densities, column), in_row(densities, column + 1)
    first, second = sum_tables(totals, row), sum_tables(totals, row + 1)
    s = in_row(along, column) + u * (left + u * (right - left) / 2)
    t = sum_tables(marginal, row) + v * (first + v * (second - first) / 2)
    least = np.finfo(np.float32).tiny
    return s / np.maximum((1 - v) * first + v * second, least), t / np.maximum(
        sum_tables(marginal, np.full_like(row, rows - 1)), least
    )


def running(values: np.ndarray) -> np.ndarray:
    """Integrate linear values over the last axis from its first node to each, in steps between nodes."""
    steps = (values[..., 1:] + values[..., :-1]) / 2
    return np.concatenate([np.zeros_like(values[..., :1]), np.cumsum(steps, axis=-1, dtype=np.float64)], axis=-1)


def linear_root(first: np.ndarray, second: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Find u in 0 to 1 up to which the integral of first + u (second - first) is `area`."""
    slope = second - first
    root = np.sqrt(np.maximum(first**2 + 2 * area * slope, 0))
    return np.clip(2 * area / np.maximum(first + root, 1e-300), 0, 1)


def between(nodes: np.ndarray, values: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the nodes before and after values (n,) by number, with their weights; beyond the last, its value."""
    before = np.clip(np.searchsorted(nodes, values, side="right") - 1, 0, len(nodes) - 2)
    share = np.clip((values - nodes[before]) / (nodes[before + 1] - nodes[before]), 0, 1)
    return [(before, 1 - share), (before + 1, share)]


def cell(rows: int, columns: int, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
    """Find the first row and column (n,) of the nodes around x, y (n,), 0 to 1, and the shares of the next ones."""
    u, v = x * (columns - 1), y * (rows - 1)
    column, row = np.minimum(u.astype(int), columns - 2), np.minimum(v.astype(int), rows - 2)
    return row, column, v - row, u - column


def interpolate_table(table: np.ndarray, x: np.ndarray, y: np.ndarray, at: tuple = ()) -> np.ndarray:
    """Interpolate table[at] (rows, columns, ...) at places x, y (n,), 0 to 1: (n, ...)."""
    rows, columns = table.shape[len(at) : len(at) + 2]
    row, column, v, u = cell(rows, columns, x, y)
    weights = ((1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v)
    places = ((row, column), (row, column + 1), (row + 1, column), (row + 1, column + 1))
    extra = (1,) * (table.ndim - len(at) - 2)
    return sum(w.reshape(-1, *extra) * table[(*at, *place)] for w, place in zip(weights, places, strict=True))


def grid_directions() -> np.ndarray:
    """Compute unit vectors (around, polar, 3) of the nodes of D and sigma."""
    theta, phi = np.pi / 2 * np.linspace(0, 1, POLAR) ** 2, np.linspace(-np.pi, np.pi, AROUND)[:, None]
    return unit(theta, phi)


def square_place(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Map unit vectors (n, 3) to x and y in the square."""
    theta = np.arctan2(np.hypot(directions[:, 0], directions[:, 1]), directions[:, 2])
    phi = np.arctan2(directions[:, 1], directions[:, 0])
    return np.sqrt(np.minimum(theta * 2 / np.pi, 1)), (phi + np.pi) / (2 * np.pi)


def trapezoid(count: int) -> np.ndarray:
    """Return the weights (count,) of the trapezoid rule over 0 to 1."""
    weights = np.full(count, 1 / (count - 1))
    weights[[0, -1]] /= 2
    return weights
