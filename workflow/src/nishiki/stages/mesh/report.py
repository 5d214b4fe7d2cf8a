"""The section of an object's page on its surface."""

from typing import Any

from nishiki.artifacts.artifact import Artifact
from nishiki.report.files import contents
from nishiki.report.page import Block, Cell, Figure, Figures, Section, Table
from nishiki.report.pictures import file_picture

PREVIEWS = ("preview.png", "mesh.png")


def geometry_section(mesh: Artifact | None, widest: int) -> Section | None:
    """Counts, silhouettes and a picture of the surface."""
    if mesh is None:
        return None
    blocks: list[Block] = [Table((), rows(mesh.diagnostics), "lr")]
    preview = next((data for name in PREVIEWS if (data := contents(mesh, name)) is not None), None)
    if preview is not None:
        blocks.append(Figures([Figure("The surface", "as the stage mesh drew it.", file_picture(preview, widest))]))
    return Section("geometry", "Geometry", blocks)


def rows(mesh: dict[str, Any]) -> list[tuple[str, Cell]]:
    """What is known of the surface: label and value; mesh : diagnostics of the stage."""
    fit, decimation = mesh.get("fit") or {}, mesh.get("decimation") or {}
    values: list[tuple[str, Cell]] = [(name, mesh.get(name)) for name in ("source", "unit", "vertices", "triangles")]
    values.append(("watertight", {True: "yes", False: "no"}.get(mesh.get("watertight"))))
    values += [("parts", mesh.get("parts")), ("holes through the body (genus)", mesh.get("genus"))]
    for name, count in (mesh.get("cleaned") or {}).items():
        values.append((f"removed or mended: {name.replace('_', ' ')}", count or None))
    values += [
        ("triangles before decimation", decimation.get("triangles_before")),
        ("deviation by decimation, pixels", decimation.get("deviation_px")),
        ("silhouettes covered (IoU), mean", fit.get("iou_mean")),
        ("silhouettes covered (IoU), least", fit.get("iou_least")),
        ("of views left out (IoU), mean", fit.get("iou_held_out")),
    ]
    return [(name, value) for name, value in values if value is not None]
