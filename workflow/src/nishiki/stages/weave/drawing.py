"""Cross-sections of a weave, drawn as SVG."""

import numpy as np

from nishiki.report.svg import GRID, PALETTE, SOFT, Drawing, outline


def draw_section(section, *, title: str, repeats: int = 2, width: int = 640) -> str:
    """SVG text: `repeats` periods of a cross-section, equal scales of both axes; the surface's body is filled."""
    points, _ = section.profile(800)
    train = np.concatenate([np.add(points, (k * section.period, 0.0)) for k in range(repeats)])
    low, high = np.nanmin(train[:, 1]), np.nanmax(train[:, 1])
    scale = (width - 20) / (repeats * section.period)
    height = (high - low) * scale + 46
    base = height - 26
    line = outline(10 + train[:, 0] * scale, base - (train[:, 1] - low) * scale)
    drawing = Drawing(width, height, title, alone=True)
    left, right = 10 + train[0, 0] * scale, 10 + train[-1, 0] * scale
    drawing.path(f"{line}L{right:.1f} {base + 12:.1f}L{left:.1f} {base + 12:.1f}Z", fill=GRID)
    drawing.path(line, stroke=PALETTE[0], width=1.8)
    slope = f"steepest flank {np.degrees(section.theta_a):.0f}°"
    note = f"{slope}, height {section.height / section.period:.3f} of the period"
    drawing.text(10, height - 8, title)
    drawing.text(width - 10, height - 8, note, anchor="end", size=11, colour=SOFT)
    return drawing.finish()
