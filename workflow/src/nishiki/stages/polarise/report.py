"""The section of an object's page on the separation of diffuse and specular light."""

from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.report.files import contents
from nishiki.report.numbers import figure, percent
from nishiki.report.page import Figure, Figures, Section
from nishiki.report.pictures import file_picture

MOST_PICTURES = 2


def separation_section(polarise: Artifact | None, widest: int) -> Section | None:
    """What the polarisers separated, with the first pictures that the stage drew."""
    if polarise is None:
        return None
    shown = list((polarise.diagnostics.get("pictures") or {}).items())[:MOST_PICTURES]
    items = [
        Figure(f"View {view}: all light, diffuse, specular", "", file_picture(contents(polarise, file), widest))
        for file, view in shown
    ]
    return Section("separation", "Separation", [*sentences(polarise.diagnostics), Figures(items)])


def sentences(diagnostics: dict[str, Any]) -> list[str]:
    """Mean share of each component, of negative and of doubtful pixels; the white boards."""
    views = diagnostics.get("by_view") or []

    def mean(name: str) -> float | None:
        values = [view[name] for view in views if view.get(name) is not None]
        return float(np.mean(values)) if values else None

    negative, doubtful = (None if mean(name) is None else 100 * mean(name) for name in ("negative", "doubtful"))
    unit = {"white board": "1 is a white board", "full scale": "1 is the full scale of the camera"}
    texts = [
        "Diffuse and specular parts by the state of the polarisers. On average over the object's frames: diffuse "
        f"{figure(mean('diffuse'))}, specular {figure(mean('specular'))} ({unit[diagnostics['unit']]}). By the "
        f"formulas alone {percent(negative)} of the specular values are negative, which is noise, and "
        f"{percent(doubtful)} lie further below 0 than three standard deviations of their noise."
    ]
    changed = [view["changed"] for view in views if (view.get("changed") or {}).get("specular") is not None]
    if changed:
        diffuse, specular = (
            figure(float(np.mean([each[name] for each in changed]))) for name in ("diffuse", "specular")
        )
        texts.append(
            "Smoothing by the noise that was measured in the photographs changed the specular part by "
            f"{specular} and the diffuse part by {diffuse} (root mean squares)."
        )
    for light, board in (diagnostics.get("boards") or {}).items():
        if board and board.get("channel"):
            values = ", ".join(figure(value) for value in board["channel"])
            texts.append(f"White board under {light or 'lamp'}: β = {values} by channel.")
    return texts
