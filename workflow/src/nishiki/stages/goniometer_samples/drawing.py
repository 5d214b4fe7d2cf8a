"""The views that were measured for each direction of light, drawn as SVG."""

import numpy as np

from nishiki.goniometry.coverage import IncidenceCoverage
from nishiki.goniometry.directions import disc, unit
from nishiki.goniometry.symmetry import images
from nishiki.goniometry.table import ReflectanceSet
from nishiki.report.svg import GRID, INK, PALETTE, SOFT, Drawing

MOST_DISCS = 24
"""Discs of the drawing; of more directions of light the spread is shown."""
SIZE, RADIUS, ACROSS = 170, 66, 4


def coverage_plot(measured: ReflectanceSet, lights: tuple[IncidenceCoverage, ...]) -> str:
    """SVG text: a disc a direction of light; normal in the middle, horizon at the rim, weft to the right, warp up.

    Filled dots: measured; open: their mirror images, where the light allows; crosses: measured but not usable; the
    diamond is the light.
    """
    count = min(MOST_DISCS, len(lights))
    chosen = [lights[i] for i in np.unique(np.linspace(0, len(lights) - 1, count).round().astype(int))]
    width, height = ACROSS * SIZE, -(-len(chosen) // ACROSS) * SIZE + 24
    drawing = Drawing(width, height, "views measured for each direction of light", alone=True)
    for i, light in enumerate(chosen):
        _disc(drawing, measured, light, (i % ACROSS + 0.5) * SIZE, (i // ACROSS + 0.5) * SIZE)
    left_out = f"; {len(lights) - len(chosen)} directions of light not shown" if len(chosen) < len(lights) else ""
    note = f"filled: measured, open: by symmetry, cross: not usable, diamond: light; circles at 30, 60, 90°{left_out}"
    drawing.text(6, height - 8, note, size=10, colour=SOFT)
    return drawing.finish()


def _disc(drawing: Drawing, measured: ReflectanceSet, light: IncidenceCoverage, x: float, y: float) -> None:
    def places(directions: np.ndarray) -> list[tuple[float, float]]:
        flat = disc(directions) * RADIUS
        return list(zip((x + flat[:, 0]).tolist(), (y - flat[:, 1]).tolist(), strict=True))

    for part in (1, 2, 3):
        drawing.circle(x, y, RADIUS * part / 3, stroke=GRID)
    lit = unit(*np.radians([light.theta_deg, light.phi_deg]))
    usable = measured.valid[light.rows].all(axis=1)
    views = measured.outgoing[light.rows]
    for image in [m for m in images(measured.symmetry) if np.allclose(m @ lit, lit, atol=1e-6)][1:]:
        for a, b in places(views[usable] @ image.T):
            drawing.circle(a, b, 1.4, stroke=PALETTE[0], width=0.3)
    for a, b in places(views[usable]):
        drawing.circle(a, b, 1.6, fill=PALETTE[0])
    for a, b in places(views[~usable]):
        drawing.path(f"M{a - 2:.1f} {b - 2:.1f}l4 4m0 -4l-4 4", stroke=PALETTE[1])
    ((a, b),) = places(lit[None])
    drawing.diamond(a, b, 5, stroke=INK, width=1.2)
    title = f"light {light.theta_deg:g}°, {light.phi_deg:g}°: {light.views} views"
    drawing.text(x, y + RADIUS + 13, title, anchor="middle", size=10)
