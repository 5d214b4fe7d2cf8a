"""A drawing of the views that were measured for each direction of light."""

from __future__ import annotations

import numpy as np

from nishiki.goniometry.coverage import IncidenceCoverage
from nishiki.goniometry.directions import disc, unit
from nishiki.goniometry.symmetry import images
from nishiki.goniometry.table import ReflectanceSet
from nishiki.report.svg import GRID, INK, PALETTE, SOFT, _text

MOST = 24  # panels; of more directions of light the spread is shown
SIZE, RADIUS, ACROSS = 170, 66, 4


def coverage_plot(measured: ReflectanceSet, found: tuple[IncidenceCoverage, ...]) -> str:
    """SVG text: a disc a direction of light; normal in the middle, horizon at the rim, weft to the right, warp up.

    Filled dots: measured; open: their mirror images, where the light allows; crosses: measured but not usable; the
    diamond is the light.
    """
    chosen = [found[i] for i in np.unique(np.linspace(0, len(found) - 1, min(MOST, len(found))).round().astype(int))]
    rows = -(-len(chosen) // ACROSS)
    width, height = ACROSS * SIZE, rows * SIZE + 24
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'role="img" aria-label="views measured for each direction of light" font-family="sans-serif">'
    ]
    for i, light in enumerate(chosen):
        parts += _panel(measured, light, (i % ACROSS + 0.5) * SIZE, (i // ACROSS + 0.5) * SIZE)
    left_out = f"; {len(found) - len(chosen)} directions of light not shown" if len(chosen) < len(found) else ""
    note = f"filled: measured, open: by symmetry, cross: not usable, diamond: light; circles at 30, 60, 90°{left_out}"
    return "".join([*parts, _text(6, height - 8, note, size=10, colour=SOFT), "</svg>"])


def _panel(measured: ReflectanceSet, light: IncidenceCoverage, x: float, y: float) -> list[str]:
    parts = [
        f'<circle cx="{x:g}" cy="{y:g}" r="{RADIUS * part / 3:.1f}" fill="none" stroke="{GRID}"/>' for part in (1, 2, 3)
    ]
    lit = unit(*np.radians([light.theta_deg, light.phi_deg]))
    usable = measured.valid[light.rows].all(axis=1)
    views = measured.outgoing[light.rows]
    same = [m for m in images(measured.symmetry) if np.allclose(m @ lit, lit, atol=1e-6)][1:]
    for image in same:
        marks = (f'<circle cx="{a:.1f}" cy="{b:.1f}" r="1.4"/>' for a, b in _places(views[usable] @ image.T, x, y))
        parts.append(f'<g fill="none" stroke="{PALETTE[0]}" stroke-width=".5" opacity=".6">{"".join(marks)}</g>')
    marks = (f'<circle cx="{a:.1f}" cy="{b:.1f}" r="1.6"/>' for a, b in _places(views[usable], x, y))
    parts.append(f'<g fill="{PALETTE[0]}">{"".join(marks)}</g>')
    crosses = (f'<path d="M{a - 2:.1f} {b - 2:.1f}l4 4m0 -4l-4 4"/>' for a, b in _places(views[~usable], x, y))
    parts.append(f'<g stroke="{PALETTE[1]}" fill="none">{"".join(crosses)}</g>')
    ((a, b),) = _places(lit[None], x, y)
    parts.append(f'<path d="M{a:.1f} {b - 5:.1f}l5 5l-5 5l-5 -5z" fill="none" stroke="{INK}" stroke-width="1.2"/>')
    title = f"light {light.theta_deg:g}°, {light.phi_deg:g}°: {light.views} views"
    return [*parts, _text(x, y + RADIUS + 13, title, anchor="middle", size=10)]


def _places(directions: np.ndarray, x: float, y: float) -> list[tuple[float, float]]:
    """Places on the drawing, y down."""
    flat = disc(directions) * RADIUS
    return list(zip((x + flat[:, 0]).tolist(), (y - flat[:, 1]).tolist(), strict=True))
