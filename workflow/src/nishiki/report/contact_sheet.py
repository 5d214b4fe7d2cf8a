"""The photographs of a capture against each other as a contact sheet: what each shows beside what is stated of it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nishiki.formats.problems import Problem
from nishiki.observations.consistency import Judgement
from nishiki.photometric.arrangement import turned
from nishiki.report.page import Block, Figure, Figures, Note, Page, Section, render_page
from nishiki.report.pictures import colour_picture
from nishiki.report.svg import PALETTE, SOFT, Drawing
from nishiki.version import PROJECT_VERSION

WIDTH = 260  # of a photograph on the sheet, pixels
STATED, SHOWN = PALETTE[0], PALETTE[1]
LAMP_ELSEWHERE_DEG, HALF_AS_STRONG, ROOM_LIGHT = 10.0, np.log(2), 0.1
"""What counts as one mark against a photograph when the odd ones are sorted to the front."""


def contact_sheet(judgement: Judgement, problems: Sequence[Problem], title: str) -> str:
    """Draw the page (HTML) of one capture; the photographs that differ most from what is stated come first."""
    seen, odd = _seen(judgement), _oddness(judgement)
    order = np.argsort(-odd, kind="stable")
    figures = [_figure(judgement, int(j), seen) for j in order]
    blocks: list[Block] = []
    told = [str(problem) for problem in problems if problem.severity == "error"]
    told += [str(problem) for problem in problems if problem.severity != "error"]
    if told:
        blocks.append(Note(told, listed=True, warning=True))
    if judgement.consistency is None:
        blocks.append("Nothing can be predicted here: too few lamps, too few pixels with light, or a mirror.")
    key = "Arrows point towards the lamp: blue as stated, orange as the photograph shows it, compared with the others."
    units = (
        "Gains are relative to the median photograph; the offset is light that does not follow the lamp, relative to "
        "a frontal lamp; the numbers after the signs are standard errors."
    )
    sheet = Section("photographs", "Photographs, the odd ones first", [key, units, Figures(figures, columns=4)])
    said = Section("problems", "What was found", blocks or ["Nothing."])
    return render_page(
        Page(title, "The photographs against each other", [said, sheet], PROJECT_VERSION, "./nishiki check")
    )


def _seen(judgement: Judgement) -> np.ndarray:
    """Return directions (lights, 3) that the photographs show; NaN where nothing can be told."""
    found = judgement.arrangement
    if found is not None and not found.as_stated:
        return turned(judgement.directions[list(found.order)], found.axes)
    if judgement.consistency is None:
        return np.full(judgement.directions.shape, np.nan)
    return judgement.consistency.direction


def _angles(judgement: Judgement) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((_seen(judgement) * judgement.directions).sum(axis=1), -1, 1)))


def _oddness(judgement: Judgement) -> np.ndarray:
    marks = np.nan_to_num(_angles(judgement)) / LAMP_ELSEWHERE_DEG
    found = judgement.consistency
    if found is not None:
        marks = marks + np.abs(np.log(np.maximum(found.gain, 1e-3))) / HALF_AS_STRONG
        marks = marks + np.abs(np.nan_to_num(found.offset)) / ROOM_LIGHT
        marks[[*found.failed, *(pair[0] for pair in found.repeats)]] += 1000
    return np.round(marks, 2)  # below that the order of the photographs stays


def _figure(judgement: Judgement, j: int, seen: np.ndarray) -> Figure:
    """Return one photograph with the arrows of its lamp, and its numbers."""
    values = judgement.values[j]
    top = max(float(np.nanquantile(judgement.values, 0.98)), 1e-12)
    picture = colour_picture(np.repeat(np.clip(values / top, 0, 1)[..., None], 3, axis=2))
    rows, columns = values.shape
    height = WIDTH * rows / columns
    drawing = Drawing(WIDTH, height, f"{judgement.names[j]} with the directions of its lamp")
    drawing.picture(0, 0, WIDTH, height, picture.source)
    for direction, colour, width in ((judgement.directions[j], STATED, 6.0), (seen[j], SHOWN, 2.5)):
        if np.isfinite(direction).all():
            _arrow(drawing, direction, colour, width, height)
    return Figure(judgement.names[j].split("/")[-1], "; ".join(_numbers(judgement, j)), svg=drawing.finish())


def _arrow(drawing: Drawing, direction: np.ndarray, colour: str, width: float, height: float) -> None:
    """From the middle towards the lamp, as long as the lamp is low."""
    reach = 0.45 * min(WIDTH, height)
    x, y = WIDTH / 2, height / 2
    right, down = reach * direction[0], -reach * direction[1]
    tip_x, tip_y = x + right, y + down
    for paint, broad in (("#fff", width + 2), (colour, width)):  # light seam, so that it is seen on any picture
        drawing.path(f"M{x:.1f} {y:.1f}L{tip_x:.1f} {tip_y:.1f}", stroke=paint, width=broad)
        drawing.circle(tip_x, tip_y, broad + 1, fill=paint)
    drawing.circle(x, y, 3, fill=SOFT)


def _numbers(judgement: Judgement, j: int) -> list[str]:
    direction = judgement.directions[j]
    stated = f"stated {_degrees(direction)}"
    arrangement, found = judgement.arrangement, judgement.consistency
    lines = [stated]
    if arrangement is not None and not arrangement.as_stated:
        lamp = judgement.names[arrangement.order[j]].split("/")[-1]
        return [stated, f"shows {_degrees(_seen(judgement)[j])}, the lamp listed for {lamp}"]
    if found is None or not np.isfinite(found.residual[j]):
        return lines
    if j in found.failed:
        lines.append("no light of its lamp")
    lines += [f"repeats {judgement.names[b].split('/')[-1]}" for a, b in found.repeats if a == j]
    lines += [
        f"shows {_degrees(found.direction[j])} ± {found.direction_sigma_deg[j]:.1f}°, "
        f"{_angles(judgement)[j]:.1f}° from it",
        f"gain {found.gain[j]:.3f} ± {found.gain_sigma[j]:.3f}",
        f"offset {found.offset[j] + 0.0:z.3f} ± {found.offset_sigma[j]:.3f}",
        f"misfit {100 * found.residual[j]:.1f} %",
    ]
    return lines


def _degrees(direction: np.ndarray) -> str:
    azimuth = np.degrees(np.arctan2(direction[1], direction[0])) % 360
    return f"azimuth {azimuth:.0f}°, elevation {np.degrees(np.arcsin(np.clip(direction[2], -1, 1))):.0f}°"
