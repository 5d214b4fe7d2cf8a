"""A measured table of reflectances made into a capture folder."""

from __future__ import annotations

from pathlib import Path

import yaml

from nishiki.capture.goniometer_tables import ReflectanceTable, is_table, read_table
from nishiki.capture.layouts import photographs_in
from nishiki.capture.schema_base import FORMAT
from nishiki.capture.taking import take
from nishiki.formats.problems import CaptureError, Problem, error, warning


def recognise_table(source: Path) -> Path | None:
    """The table of reflectances that the source is, or that lies in this folder without photographs; else None.

    Raises CaptureError (layout-unknown) where a folder holds several.
    """
    if source.is_file():
        return source if is_table(source, named=True) else None
    if not source.is_dir() or photographs_in(source):
        return None
    visible = (path for path in source.iterdir() if not path.name.startswith(".") and path.is_file())
    tables = sorted(path for path in visible if is_table(path))
    if len(tables) > 1:
        what, remedy = "several tables of reflectances", f"Convert one: {tables[0]}"
        named = ", ".join(path.name for path in tables[:5])
        raise CaptureError(error("layout-unknown", str(source), what, found=named, remedy=remedy))
    return tables[0] if tables else None


def write_table_capture(
    folder: Path, table: Path, *, title: str | None, link: bool
) -> tuple[ReflectanceTable, list[Problem]]:
    """Write the capture into a new folder; returns the table and what the user should know.

    The table is taken over unchanged, once it has been read. Raises the CaptureErrors of `read_table`.
    """
    content = read_table(table, table.name)
    folder.mkdir(parents=True)
    name = take(table, folder / table.name, link)
    block = {"table": name, "symmetry": "quarter", "weave": "unknown"}
    settings = {"format": FORMAT, "title": title or table.stem, "geometry": "goniometer", "goniometer": block}
    text = "# Capture folder: see docs/capture-folder.md\n" + yaml.safe_dump(
        settings, sort_keys=False, allow_unicode=True
    )
    (folder / "capture.yaml").write_text(text, encoding="utf-8")
    what = "two mirror planes, through weft and warp, are taken for granted"
    remedy = "Use --open and set goniometer.symmetry (quarter, half, none) and goniometer.weave if it is otherwise"
    return content, [*content.warnings, warning("symmetry-assumed", table.name, what, remedy=remedy)]
