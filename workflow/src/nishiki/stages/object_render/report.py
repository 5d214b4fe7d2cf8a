"""The section of an object's page with the rendered pictures and the film."""

from nishiki.artifacts.artifact import Artifact
from nishiki.report.files import contents, film
from nishiki.report.numbers import figure
from nishiki.report.page import Figure, Figures, Note, Section
from nishiki.report.pictures import file_picture

MOST_PICTURES = 6


def rendered_section(render: Artifact | None, widest: int, video_mb: float) -> Section | None:
    """Pictures of at most `widest` pixels across; None where there are none."""
    if render is None:
        return None
    items, others = [], []
    for name in list(render.diagnostics.get("pictures") or {})[:MOST_PICTURES]:
        data = contents(render, f"{name}.png")
        if data is not None:
            items.append(Figure(words(name), "", file_picture(data, widest)))
    video = render.diagnostics.get("video") or {}
    if video.get("file") in render.manifest["files"]:
        shown = film(render, video["file"], "The turn", f"{figure(video['frames'])} frames.", video_mb)
        (items if isinstance(shown, Figure) else others).append(shown)
    if not items and not others:
        return None
    notes = [Note([note]) for note in render.diagnostics.get("notes") or []]
    intro = "Pictures computed from the decoded record: mesh, reflection model and residual."
    return Section("rendered", "Rendered", [intro, Figures(items, 3), *others, *notes])


def words(name: str) -> str:
    """A picture's file name in words."""
    kind, _, rest = name.partition("-")
    predicted = rest.endswith("-predicted")
    rest = rest.removesuffix("-predicted")
    text = f"Between views {rest.replace('-', ' and ')}" if kind == "between" else f"View {rest}"
    return text + (" (left out, predicted)" if predicted else "")
