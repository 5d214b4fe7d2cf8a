"""Draw the cross-sections of a woven cloth, measure what is visible of them, and draw its surface.

A section is a train of two humps of equal height a period. A hump is a straight flank of slope theta_a and length l,
an arc of radius r and angle theta_a, and the mirror image of both (Takeda and Tanaka, figs. 5 and 6). The first hump
may carry a flat
top of length m between its arcs, or be a row of n yarns: n - 1 contacts, each of two further arcs of angle `contact`.
From any direction what is seen of one side of a hump is one piece that begins at its top, so a single length says all.
The light comes along the normal and reaches all of it.

Derivation, with t = pi/2 - theta the angle of the ray above the horizontal and u = (sin t, cos t) normal to the ray.
A ray that leaves the arc (centre C) where it is tangent has u.p = u.C + r. With the valley at the origin and
C = (-l cos theta_a - r sin theta_a, l sin theta_a - r cos theta_a) it meets the next flank, s (cos theta_a,
sin theta_a), at s = (l sin(theta_a - t) + r (1 - cos(theta_a - t))) / sin(theta_a + t), and where that is beyond l the
next arc at the angle t2 from its top with r (1 - cos(t + t2)) = u.(C' - C) = 2 sin t (l cos theta_a + r sin theta_a).
1 - cos x is written 2 sin^2(x / 2), so that nothing cancels at grazing directions.

Both sections are trains of two humps a period. Lengths are in any unit: masking depends on their ratios alone.
The weft section's row of yarns touches at the equator (contact = pi/2). The paper prints 2 a' as the length of a
contact, which with its own arcs a'_0 and a'_1 would give G(0) != 1; yarns that touch as full circles show pi r' from
above, and with that length G(0) = 1, G is continuous at every angle where the surface is smooth, and never rises.
"""

from dataclasses import asdict, dataclass, replace
from math import pi

import numpy as np

HALF_PI = 0.5 * pi


def facing_length(theta_a, length, radius, theta) -> np.ndarray:
    """Compute the length seen from the top down on a hump's side that faces the viewer; theta >= 0, from the normal.

    Numbers or arrays that broadcast.
    """
    t, arc = HALF_PI - theta, radius * theta_a
    low = np.clip(t, 0.0, theta_a)
    shade = length * np.sin(theta_a - low) + 2.0 * radius * np.sin(0.5 * (theta_a - low)) ** 2
    reach = np.sin(theta_a + low)
    flank = np.maximum(arc + length - shade / np.where(reach > 0.0, reach, np.inf), 0.0)  # without an arc 0 but rounded
    rise = np.sin(low) * (length * np.cos(theta_a) / np.maximum(radius, 1e-300) + np.sin(theta_a))
    top = radius * np.clip(2.0 * np.arcsin(np.sqrt(np.minimum(rise, 1.0))) - low, 0.0, theta_a)
    seen = np.where(shade <= length * reach, flank, top)
    return np.where(t < 0.0, 0.0, np.where(t > theta_a, arc + length, seen))


def facing_contact(contact, theta) -> np.ndarray:
    """Compute the angle seen from the top down on a contact arc that faces the viewer; theta >= 0, broadcasts.

    For contact = pi/2 it is theta + arcsin(2 cos theta - 1), written without cancellation.
    """
    t = HALF_PI - theta
    low = np.clip(t, 0.0, contact)
    seen = 2.0 * np.arcsin(np.sqrt(np.minimum(np.sin(low) * np.sin(contact), 1.0))) - low
    return np.where(t < 0.0, 0.0, np.where(t > contact, contact, np.clip(seen, 0.0, contact)))


def side_lengths(shape, theta) -> tuple[np.ndarray, ...]:
    """Compute the visible lengths and contact angles on the + and the - side from signed theta.

    shape: (theta_a, l, r, m, n, contact), numbers or arrays that broadcast with theta.
    """
    theta_a, length, radius, _, _, contact = shape
    far = np.abs(theta)
    # of the side that is turned away one sees the top only, of its contact arc too
    rest = np.maximum(HALF_PI - far, 0.0)
    facing, near_arc = facing_length(theta_a, length, radius, far), facing_contact(contact, far)
    averted, far_arc = np.where(rest > theta_a, radius * theta_a + length, radius * rest), np.minimum(rest, contact)
    ahead = np.asarray(theta) >= 0.0
    pairs = (facing, averted), (averted, facing), (near_arc, far_arc), (far_arc, near_arc)
    return tuple(np.where(ahead, *pair) for pair in pairs)


def total_length(shape):
    """Compute the surface length of one period: 4 l + 4 a + m + (n - 1) 2 r contact."""
    theta_a, length, radius, flat, yarns, contact = shape
    return 4.0 * (length + radius * theta_a) + flat + 2.0 * (yarns - 1.0) * radius * contact


def visible_share(shape, theta) -> np.ndarray:
    """Compute the share of the surface that is seen from theta (signed), 0 to 1; broadcasts."""
    seen = side_lengths(shape, theta)
    humps = 2.0 * (seen[0] + seen[1])
    contacts = (shape[4] - 1.0) * shape[2] * (seen[2] + seen[3])
    share = np.minimum((humps + shape[3] + contacts) / total_length(shape), 1.0)
    return np.where(np.abs(theta) > HALF_PI, 0.0, share)


@dataclass(frozen=True)
class Section:
    """The common part of the two sections; `shape` is (theta_a, l, r, m, n, contact)."""

    @property
    def shape(self) -> tuple[float, float, float, float, float, float]:
        """(theta_a, l, r, m, n, contact)."""
        raise NotImplementedError

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

    def elements(self) -> np.ndarray:
        """List the pieces of one period from valley to valley, (pieces, 3): length, slope angle at start and end.

        Slope: angle of the tangent above the x axis. The number of yarns is rounded to the next whole one.
        """
        theta_a, length, radius, flat, yarns, contact = self.shape
        arc, side = radius * theta_a, radius * contact
        up = [(length, theta_a, theta_a), (arc, theta_a, 0.0)]
        down = [(arc, 0.0, -theta_a), (length, -theta_a, -theta_a)]
        row = [(side, 0.0, -contact), (side, contact, 0.0)] * (round(yarns) - 1)
        return np.array([*up, (flat, 0.0, 0.0), *row, *down, *up, *down])

    def profile(self, samples: int = 400) -> tuple[np.ndarray, np.ndarray]:
        """Trace one period as a polyline of about `samples` points: points (k, 2), outward unit normals (k, 2).

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

    def scale(self, factor: float):
        """Scale all lengths of the section by `factor` > 0."""
        names = ("l", "r", "m") if hasattr(self, "m") else ("l", "r")
        return replace(self, **{name: getattr(self, name) * factor for name in names})

    def as_dict(self) -> dict[str, float]:
        """Return the fields by name, as numbers."""
        return {name: float(value) for name, value in asdict(self).items()}


@dataclass(frozen=True)
class WarpSection(Section):
    """Section along the warp: theta_a (radians), flank l, radius r, flat top m of one of the two humps."""

    theta_a: float
    l: float  # noqa: E741 - the paper's letter
    r: float
    m: float = 0.0

    @property
    def shape(self) -> tuple[float, float, float, float, float, float]:
        """(theta_a, l, r, m, n, contact)."""
        return (float(self.theta_a), float(self.l), float(self.r), float(self.m), 1.0, HALF_PI)


@dataclass(frozen=True)
class WeftSection(Section):
    """Section along the weft: theta_a (radians), flank l, radius r, one of the two humps a row of n touching yarns."""

    theta_a: float
    l: float  # noqa: E741 - the paper's letter
    r: float
    n: float = 1.0
    # angle of the arcs on both sides of a contact; pi/2 (circles that touch) is the model, less stands for yarns that
    # are pressed together or flattened and meet at that slope. n need not be whole (mean over a cloth)
    contact: float = HALF_PI

    @property
    def shape(self) -> tuple[float, float, float, float, float, float]:
        """(theta_a, l, r, m, n, contact)."""
        return (float(self.theta_a), float(self.l), float(self.r), 0.0, float(self.n), float(self.contact))


@dataclass(frozen=True)
class WovenSurface:
    """One repeat as a height field."""

    x: np.ndarray  # (columns,)
    y: np.ndarray  # (rows,) rising
    height: np.ndarray  # (rows, columns), all in warp spacings
    is_warp: np.ndarray  # (rows, columns) bool: which yarn is on top
    pattern: np.ndarray  # (harness, harness) bool: where the warp lies on top

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Triangulate: vertices (n, 3) float32 and triangles (m, 3) int32, anticlockwise seen from above."""
        rows, columns = self.height.shape
        xx, yy = np.meshgrid(self.x, self.y)
        vertices = np.stack([xx, yy, self.height], axis=-1).reshape(-1, 3).astype(np.float32)
        first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        a, b, c, d = first, first + 1, first + columns, first + columns + 1
        faces = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
        return vertices, faces.astype(np.int32)


def shade(surface: WovenSurface, *, repeats: int = 2, width: int = 640) -> np.ndarray:
    """Draw the surface from above, lit from the upper left: (rows, columns, 3) uint8; warp and weft tinted."""
    tiles = (repeats, repeats)
    height = np.tile(surface.height[:-1, :-1], tiles)
    kind = np.tile(surface.is_warp[:-1, :-1], tiles)
    steps = surface.y[1] - surface.y[0], surface.x[1] - surface.x[0]
    columns = np.linspace(0, height.shape[1] - 1, width)
    tall = round(width * steps[0] * height.shape[0] / (steps[1] * height.shape[1]))
    rows = np.linspace(height.shape[0] - 1, 0, int(np.clip(tall, width // 4, 4 * width)))
    dy, dx = np.gradient(np.pad(height, 2, mode="wrap"), *steps)
    dy, dx = dy[2:-2, 2:-2], dx[2:-2, 2:-2]
    normal = np.stack([-dx, -dy, np.ones_like(dx)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    lamp = np.array([-0.5, 0.5, np.sqrt(0.5)])
    low = height.min()
    depth = 0.35 + 0.65 * (height - low) / max(height.max() - low, 1e-12)  # valleys see less of the sky
    light = 0.25 * depth + 0.75 * np.clip(normal @ lamp, 0.0, None)
    tint = np.where(kind[..., None], (0.80, 0.72, 0.55), (0.40, 0.50, 0.62))
    linear = (light[..., None] * tint)[np.round(rows).astype(int)][:, np.round(columns).astype(int)]
    return np.round(255.0 * np.clip(linear, 0.0, 1.0) ** (1 / 2.2)).astype(np.uint8)
