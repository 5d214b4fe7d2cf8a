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
    files = sorted(name for name in polarise.manifest["files"] if name.endswith("_side_by_side.png"))[:MOST_PICTURES]
    items = []
    for name in files:
        view = name.split("/")[-1].split("_")[0]
        items.append(
            Figure(f"View {view}: all light, diffuse, specular", "", file_picture(contents(polarise, name), widest))
        )
    return Section("separation", "Separation", [*sentences(polarise.diagnostics), Figures(items)])


def sentences(diagnostics: dict[str, Any]) -> list[str]:
    """Mean share of each component, of negative and of doubtful pixels; the white boards."""
    views = diagnostics.get("by_view") or []

    def mean(name: str) -> float | None:
        values = [view[name] for view in views if view.get(name) is not None]
        return float(np.mean(values)) if values else None

    negative, doubtful = (None if mean(name) is None else 100 * mean(name) for name in ("negative", "doubtful"))
    texts = [
        "Diffuse and specular parts by the state of the polarisers. On average over the object's frames: diffuse "
        f"{figure(mean('diffuse'))}, specular {figure(mean('specular'))} (1 is a white board); negative specular "
        f"values (noise) at {percent(negative)} of the pixels, doubtful ones {percent(doubtful)}."
    ]
    for light, board in (diagnostics.get("boards") or {}).items():
        if board and board.get("channel"):
            values = ", ".join(figure(value) for value in board["channel"])
            texts.append(f"White board under {light or 'lamp'}: β = {values} by channel.")
    return texts
