"""Cross-sections drawn as SVG: a section alone, or over outlines of yarns that are known otherwise."""

from html import escape

import numpy as np

from nishiki.report.svg import GRID, INK, PALETTE, SOFT


def draw_section(section, *, title: str, repeats: int = 2, outlines=(), width: int = 640) -> str:
    """SVG text: `repeats` periods of a section, equal scales of both axes; the surface's body is filled.

    outlines : polylines (k, 2) in the section's units, drawn below it (true yarns, another section): their first hump's
    top at (0, top of the section) is the caller's business, nothing is moved.
    """
    points, _ = section.profile(800)
    train = np.concatenate([np.add(points, (k * section.period, 0.0)) for k in range(repeats)])
    every = np.concatenate([train, *[np.asarray(o, float) for o in outlines]])
    low, high = np.nanmin(every[:, 1]), np.nanmax(every[:, 1])
    scale = (width - 20) / (repeats * section.period)
    margin = 10 + 12 / scale
    tall = (high - low) * scale + 46
    base = tall - 26

    def place(polyline):
        return 10 + polyline[:, 0] * scale, base - (polyline[:, 1] - low) * scale

    parts = [
        f'<svg viewBox="0 0 {width} {tall:.0f}" width="{width}" height="{tall:.0f}" role="img" '
        f'aria-label="{escape(title, quote=True)}">'
    ]
    floor = np.array([[train[-1, 0], low - margin / scale], [train[0, 0], low - margin / scale]])
    parts.append(f'<path d="{_path(*place(np.concatenate([train, floor])))}Z" fill="{GRID}"/>')
    for outline in outlines:
        x, y = place(np.asarray(outline, float))
        parts.append(f'<path d="{_path(x, y)}" fill="none" stroke="{PALETTE[1]}" stroke-width="1.4"/>')
    parts.append(f'<path d="{_path(*place(train))}" fill="none" stroke="{PALETTE[0]}" stroke-width="1.8"/>')
    theta = np.degrees(section.theta_a)
    note = f"steepest flank {theta:.0f}°, height {section.height / section.period:.3f} of the period"
    parts.append(f'<text x="10" y="{tall - 8:.1f}" font-size="12" fill="{INK}">{escape(title)}</text>')
    parts.append(
        f'<text x="{width - 10}" y="{tall - 8:.1f}" font-size="11" fill="{SOFT}" text-anchor="end">{note}</text>'
    )
    return "".join([*parts, "</svg>"])


def _path(x: np.ndarray, y: np.ndarray) -> str:
    """Path commands; NaN breaks the line."""
    commands, drawing = [], False
    for a, b in zip(x, y, strict=True):
        known = bool(np.isfinite(a) and np.isfinite(b))
        if known:
            commands.append(f"{'L' if drawing else 'M'}{a:.1f} {b:.1f}")
        drawing = known
    return "".join(commands)
