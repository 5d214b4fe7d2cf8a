"""The cloth's surface in three dimensions from its two sections: plain, twill and satin by one construction.

Along the middle of a warp yarn the surface is the warp section: the yarn's float (hump with the flat top), and at every
binding the weft yarn that comes up (the other hump). Across the warp yarns it has the caps of the weft section, the
weft yarn at a binding has the weft section's single hump. The surface is the higher of warp and weft; where their
flanks meet are the section's valleys.
"""

from dataclasses import dataclass
from math import gcd

import numpy as np

from nishiki.weave.section import WarpSection, WeftSection

USUAL = {"plain": (2,), "twill": (3, 4), "satin": (5, 8), "unknown": None}  # yarns of a repeat


@dataclass(frozen=True)
class Surface:
    """One repeat as a height field: x (columns,), y (rows,) rising, height (rows, columns), all in warp spacings;
    is_warp (rows, columns) bool: which yarn is on top; pattern (harness, harness) bool, see weave_pattern."""

    x: np.ndarray
    y: np.ndarray
    height: np.ndarray
    is_warp: np.ndarray
    pattern: np.ndarray

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (n, 3) float32 and triangles (m, 3) int32, anticlockwise seen from above."""
        rows, columns = self.height.shape
        xx, yy = np.meshgrid(self.x, self.y)
        vertices = np.stack([xx, yy, self.height], axis=-1).reshape(-1, 3).astype(np.float32)
        first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        a, b, c, d = first, first + 1, first + columns, first + columns + 1
        faces = np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)])
        return vertices, faces.astype(np.int32)


def weave_pattern(weave: str, harness: int, step: int | None = None) -> np.ndarray:
    """(harness, harness) bool, row = weft yarn, column = warp yarn: True where the warp lies on top.

    Each warp yarn goes below one weft yarn a repeat, `step` further on with each warp yarn (plain 2/1, twill 1, satin
    the smallest step above 1 that has no factor in common with harness; satins of 6 do not exist and become twills).
    """
    if weave == "plain" or harness == 2:
        return np.add.outer(np.arange(2), np.arange(2)) % 2 == 0
    if step is None:
        steps = [s for s in range(2, harness - 1) if gcd(s, harness) == 1] if weave == "satin" else []
        step = steps[0] if steps else 1
    pattern = np.ones((harness, harness), bool)
    yarns = np.arange(harness)
    pattern[(step * yarns) % harness, yarns] = False
    return pattern


def harness_of(weft: WeftSection, weave: str) -> tuple[str, int]:
    """Weave and number of yarns of a repeat: n yarns side by side and one that comes up. "unknown" is told by n."""
    harness = int(np.clip(round(weft.n) + 1, 2, 16))
    if weave == "unknown":
        weave = "plain" if harness == 2 else "twill" if harness <= 4 else "satin"
    least = {"plain": 2, "twill": 3, "satin": 5}[weave]
    return weave, 2 if weave == "plain" else max(harness, least)


def make_surface(
    weft: WeftSection,
    warp: WarpSection,
    *,
    weave: str,
    harness: int,
    samples: int = 24,
    spacing_ratio: float | None = None,
) -> Surface:
    """Height field of one repeat from both sections, `samples` points a yarn spacing.

    The sections have no common scale. spacing_ratio : spacing of the weft yarns over that of the warp yarns, where it
    is known (threads counted); None: the valleys of both sections are equally deep, for they are the same places.
    """
    pattern = weave_pattern(weave, harness)
    count = len(pattern)
    weft = weft.scaled(count / weft.period)
    if spacing_ratio is None:
        warp = warp.scaled(weft.height / warp.height)
    else:
        warp = warp.scaled(count * spacing_ratio / warp.period)
    pitch = warp.period / count
    x = np.arange(count * samples + 1) / samples
    y = np.arange(count * samples + 1) / samples * pitch
    warp_height = np.full((y.size, x.size), -np.inf)
    weft_height = warp_height.copy()
    for column in range(count):
        bindings = (np.flatnonzero(~pattern[:, column]) + 0.5) * pitch
        away = _nearest(x, column + 0.5, count)
        inside = np.abs(away) <= 0.5 + 1e-9
        along = np.full(y.size, -np.inf)
        for binding in bindings:
            float_middle = binding + 0.5 * warp.period
            along = np.maximum(along, _hump(_nearest(y, float_middle, warp.period), warp.shape, warp.m))
            up = _hump(_nearest(y, binding, warp.period), warp.shape, 0.0)
            weft_height = np.maximum(weft_height, up[:, None] + _hump(away, weft.shape, 0.0)[None])
        cap = _cap(away, weft)
        warp_height = np.where(inside[None], np.maximum(warp_height, along[:, None] + cap[None]), warp_height)
    return Surface(x, y, np.maximum(warp_height, weft_height), warp_height >= weft_height, pattern)


def _nearest(places: np.ndarray, middle: float, period: float) -> np.ndarray:
    """Signed distance to the nearest of middle + k period."""
    return (places - middle + 0.5 * period) % period - 0.5 * period


def _hump(away: np.ndarray, shape, flat: float) -> np.ndarray:
    """Height below the top of a hump (<= 0) at a distance from its middle: flat, arc, flank; the flank goes on."""
    theta_a, _, radius = shape[:3]
    beyond = np.maximum(np.abs(away) - 0.5 * flat, 0.0)
    edge = radius * np.sin(theta_a)
    on_arc = np.minimum(beyond, edge)
    drop = radius - np.sqrt(np.maximum(radius**2 - on_arc**2, 0.0))
    return -drop - np.maximum(beyond - edge, 0.0) * np.tan(theta_a)


def _cap(away: np.ndarray, weft: WeftSection) -> np.ndarray:
    """Height below a warp yarn's crest: the contact's arcs, stretched so that yarns lie evenly spaced."""
    if weft.n < 1.5:
        return _hump(away, weft.shape, 0.0)
    sine = np.minimum(np.abs(away) / 0.5, 1.0) * np.sin(weft.contact)
    return -weft.r * (1.0 - np.sqrt(np.maximum(1.0 - sine**2, 0.0)))


def shade(surface: Surface, *, repeats: int = 2, width: int = 640) -> np.ndarray:
    """Picture (rows, columns, 3) uint8 of the surface from above, lit from the upper left; warp and weft tinted."""
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
