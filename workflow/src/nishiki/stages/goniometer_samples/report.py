"""The section of a cloth's page on its measurements: which views were measured for each direction of light."""

from typing import Any

from nishiki.artifacts.artifact import Artifact
from nishiki.capture.schema_base import OBJECT_FACTS
from nishiki.report.files import contents, read_json
from nishiki.report.numbers import figure, percent
from nishiki.report.page import Block, Figure, Figures, Fold, Section, Table


def coverage_section(samples: Artifact) -> Section:
    """The drawing, and a row for each direction of light."""
    blocks: list[Block] = ["Views that were measured for each direction of light."]
    if drawing := contents(samples, "coverage.svg"):
        caption = "Each disc is one direction of light; dots are views seen from above, the weft to the right."
        blocks.append(Figures([Figure("Coverage", caption, svg=drawing.decode())], 1))
    if rows := coverage_rows(read_json(samples, "reflectance.json") or {}):
        head = ("θi", "φi", "views", "unusable", "covered", "widest gap", "steepest view")
        blocks.append(Fold("Coverage", f"{len(rows)} directions of light", [Table(head, rows, "rrrrrrr")]))
    return Section("coverage", "Measurements", blocks)


def coverage_rows(stored: dict[str, Any]) -> list[tuple]:
    """Coverage of each direction of light; stored : reflectance.json."""
    return [
        (
            *(f"{figure(row.get(name))}°" for name in ("theta_deg", "phi_deg")),
            row.get("views"),
            row.get("unusable"),
            percent(None if row.get("covered") is None else 100 * row["covered"]),
            *(f"{figure(row.get(name))}°" for name in ("gap_deg", "steepest_deg")),
        )
        for row in stored.get("coverage") or []
    ]


def facts(diagnostics: dict[str, Any], capture: dict[str, Any]) -> list[tuple[str, str]]:
    """Label and text of what is known of the measurements; capture : diagnostics of ingest, if there are any."""
    about = capture.get("capture") or {}
    named = {"object_id": "Object", **OBJECT_FACTS}
    named |= {key: key.capitalize() for key in ("creator", "date", "rights", "notes")}
    rows = [(label, str(about[key])) for key, label in named.items() if about.get(key)]
    directions, along = diagnostics.get("directions"), diagnostics.get("normal_incidence")
    if directions is not None:
        text = f"{directions} pairs of directions, {diagnostics.get('incidences')} of light"
        rows.append(("Measured", text + (f"; {along} with the light along the normal" if along is not None else "")))
    symmetry = {"quarter": "two mirror planes", "half": "half a turn", "none": "none"}
    texts = {
        "Cloths": ", ".join(diagnostics.get("regions") or []),
        "Channels": ", ".join(diagnostics.get("channels") or []),
        "Symmetry": symmetry.get(diagnostics.get("symmetry", ""), str(diagnostics.get("symmetry") or "")),
        "Weave": str(diagnostics.get("weave") or ""),
    }
    return rows + [(label, text) for label, text in texts.items() if text]
