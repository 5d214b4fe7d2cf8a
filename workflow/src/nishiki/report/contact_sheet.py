"""Draw the photographs of a capture as a contact sheet, each with its measured and stated properties."""

from collections.abc import Sequence

import numpy as np

from nishiki.formats.problems import Problem, error_text
from nishiki.observations.consistency import Judgement
from nishiki.photometric.arrangement import turn_axes
from nishiki.report.page import Block, Figure, Figures, Note, Page, PageSection, render_page
from nishiki.report.pictures import colour_picture
from nishiki.report.svg import PALETTE, SOFT, Drawing
from nishiki.version import PROJECT_VERSION

WIDTH = 260  # of a photograph on the sheet, pixels
STATED, SHOWN, MOVED = PALETTE[:3]
LAMP_ELSEWHERE_DEG, HALF_AS_STRONG, ROOM_LIGHT, SHIFT_PX = 10.0, np.log(2), 0.1, 1.0
"""Deviations that count as one mark against a photograph when the odd ones are sorted to the front."""
SHIFT_ENLARGED = 10.0  # times that a shift is drawn, at most to the rim of the picture
KEY = (
    "Arrows point towards the lamp: blue as stated, orange as the photograph shows it. A green "
    "arrow in the corner is the shift of the photograph against the first one, ten times enlarged."
)
UNITS = (
    "Gains are relative to the median photograph; the offset is light that does not follow the lamp, relative to a "
    "frontal lamp; the numbers after the signs are standard errors; shifts are columns and rows, in pixels. Where the "
    "camera moved, gain, offset and direction are those after the photographs are brought together."
)


def contact_sheet(judgement: Judgement, problems: Sequence[Problem], title: str) -> str:
    """Draw the page (HTML) of one capture; the photographs that deviate most from the statements come first."""
    marks, directions = _rate(judgement), _photographed_directions(judgement)
    order = np.argsort(-marks, kind="stable")
    figures = [_figure(judgement, int(j), directions[j]) for j in order]
    blocks: list[Block] = []
    if problems:
        blocks.append(Note([str(p) for p in sorted(problems, key=lambda p: p.severity)], listed=True, warning=True))
    if judgement.consistency is None:
        blocks.append("Nothing can be predicted here: too few lamps, too few pixels with light, or a mirror.")
    sheet = PageSection("photographs", "Photographs, the odd ones first", [KEY, UNITS, Figures(figures, columns=4)])
    said = PageSection("problems", "What was found", blocks or ["Nothing."])
    subtitle = "The photographs against each other"
    return render_page(Page(title, subtitle, [said, sheet], PROJECT_VERSION, "./nishiki check"))


def _photographed_directions(judgement: Judgement) -> np.ndarray:
    """Return directions (lights, 3) measured in the photographs; NaN where undetermined."""
    found = judgement.arrangement
    if found is not None and found.rearranged:
        return turn_axes(judgement.directions[list(found.order)], found.axes)
    if judgement.consistency is None:
        return np.full(judgement.directions.shape, np.nan)
    return judgement.consistency.direction


def _angles(judgement: Judgement) -> np.ndarray:
    cosines = (_photographed_directions(judgement) * judgement.directions).sum(axis=1)
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def _rate(judgement: Judgement) -> np.ndarray:
    """Sum the marks (lights,) against each photograph."""
    marks = np.nan_to_num(_angles(judgement)) / LAMP_ELSEWHERE_DEG
    marks = marks + np.where(judgement.moved, judgement.movement.largest / SHIFT_PX, 0)
    found = judgement.consistency
    if found is not None:
        marks = marks + np.abs(np.log(np.maximum(found.gain, 1e-3))) / HALF_AS_STRONG
        marks = marks + np.abs(np.nan_to_num(found.offset)) / ROOM_LIGHT
        strangers = found.find_strangers(judgement.directions)
        marks[[*found.failed, *(pair[0] for pair in found.repeats), *strangers]] += 1000
    return np.round(marks, 2)  # below that the order of the photographs stays


def _figure(judgement: Judgement, j: int, shown: np.ndarray) -> Figure:
    """Draw one photograph with the arrows of its lamp and of its shift, and its numbers."""
    values, top = judgement.grey[j], max(float(np.nanquantile(judgement.grey, 0.98)), 1e-12)
    picture = colour_picture(np.repeat(np.clip(values / top, 0, 1)[..., None], 3, axis=2))
    height = WIDTH * values.shape[0] / values.shape[1]
    drawing = Drawing(WIDTH, height, f"{judgement.names[j]} with the directions of its lamp and its shift")
    drawing.picture(0, 0, WIDTH, height, picture.source)
    reach = 0.45 * min(WIDTH, height)
    for direction, colour, width in ((judgement.directions[j], STATED, 6.0), (shown, SHOWN, 2.5)):
        if np.isfinite(direction).all():  # as long as the lamp is low
            _arrow(drawing, (WIDTH / 2, height / 2), reach * direction[:2] * (1, -1), colour, width)
    if judgement.moved[j]:
        corner, shift = np.array([0.2 * WIDTH, 0.8 * height]), SHIFT_ENLARGED * judgement.movement.shift[j]
        room = 0.18 * min(WIDTH, height) / max(float(np.abs(shift).max()), 1e-9)
        _arrow(drawing, corner, shift * min(1.0, room), MOVED, 4.0)
    return Figure(judgement.names[j].split("/")[-1], "; ".join(_numbers(judgement, j)), svg=drawing.finish())


def _arrow(drawing: Drawing, start: Sequence[float] | np.ndarray, step: np.ndarray, colour: str, width: float) -> None:
    (x, y), (tip_x, tip_y) = start, np.asarray(start) + step
    for paint, broad in (("#fff", width + 2), (colour, width)):  # light seam, so that it is seen on any picture
        drawing.path(f"M{x:.1f} {y:.1f}L{tip_x:.1f} {tip_y:.1f}", stroke=paint, width=broad)
        drawing.circle(tip_x, tip_y, broad + 1, fill=paint)
    drawing.circle(x, y, 3, fill=SOFT)


def _numbers(judgement: Judgement, j: int) -> list[str]:
    stated, shown = (
        f"azimuth {np.degrees(np.arctan2(y, x)) % 360:.0f}°, elevation {np.degrees(np.arcsin(np.clip(z, -1, 1))):.0f}°"
        for x, y, z in (judgement.directions[j], _photographed_directions(judgement)[j])
    )
    (x, y), sigma = judgement.movement.shift[j], judgement.movement.sigma[j]
    shift = [f"shift {x:+z.2f}, {y:+z.2f} {error_text(sigma, 2)} px"] if np.isfinite(sigma) else []
    arrangement, found = judgement.arrangement, judgement.consistency
    lines = [f"stated {stated}"]
    if arrangement is not None and arrangement.rearranged:
        lamp = judgement.names[arrangement.order[j]].split("/")[-1]
        return [*lines, f"shows {shown}, the lamp listed for {lamp}", *shift]
    if found is None or not np.isfinite(found.residual[j]):
        return [*lines, *shift]
    if j in found.failed:
        lines.append("no light of its lamp")
    lines += [f"repeats {judgement.names[b].split('/')[-1]}" for a, b in found.repeats if a == j]
    return [
        *lines,
        f"shows {shown} {error_text(found.direction_sigma_deg[j], 1)}°, {_angles(judgement)[j]:.1f}° from it",
        f"gain {found.gain[j]:.3f} {error_text(found.gain_sigma[j], 3)}",
        f"offset {found.offset[j] + 0.0:z.3f} {error_text(found.offset_sigma[j], 3)}",
        *shift,
        f"misfit {100 * found.residual[j]:.1f} %",
    ]
