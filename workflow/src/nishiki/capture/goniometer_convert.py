"""A measured table of reflectances made into a capture folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nishiki.capture.goniometer_tables import ReflectanceTable, is_table, read_table
from nishiki.capture.layouts import photographs_in
from nishiki.capture.options import NO_PHOTOGRAPHS, ConvertOptions
from nishiki.capture.schema_base import FORMAT
from nishiki.capture.taking import settings_text, take
from nishiki.formats.problems import Problem, expect_one, warning


@dataclass(frozen=True)
class MeasuredTable:
    """A table of reflectances in its file."""

    file: Path
    content: ReflectanceTable
    name = "table of reflectances"
    geometry = "goniometer"

    @property
    def warnings(self) -> tuple[Problem, ...]:
        """What reading tolerated."""
        return self.content.warnings

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels, in 1/sr."""
        return self.content.channels

    @property
    def count(self) -> int:
        """Number of the measurements."""
        return len(self.content.values)

    @property
    def parts(self) -> str:
        """Measurements and channels in words."""
        return f"{self.count} measurements, {len(self.channels)} channels"


def recognise_table(source: Path, options: ConvertOptions) -> Path | None:
    """Find the table of reflectances that the source is, or that lies in this folder without photographs.

    Raises CaptureError (layout-unknown) where a folder holds several.
    """
    if source.is_file():
        return source if is_table(source, named=True) else None
    if photographs_in(source):
        return None
    visible = (path for path in source.iterdir() if not path.name.startswith(".") and path.is_file())
    tables = sorted(path for path in visible if is_table(path))
    return expect_one(tables, source, "several tables of reflectances", f"Convert one: {next(iter(tables), '')}")


def read_measurements(source: Path, table: Path, options: ConvertOptions) -> MeasuredTable:
    """Read the table. Raises the CaptureErrors of `read_table`, and option-unusable."""
    options.refuse(NO_PHOTOGRAPHS, "lights_file", "lights_kind", "width_mm", "mask", "white", "dark", "ambient")
    options.refuse(NO_PHOTOGRAPHS, "checks", "encoding", "region")
    values, azimuths = options.values or "brdf", options.azimuths or "cloth"
    return MeasuredTable(table, read_table(table, table.name, values=values, azimuths=azimuths))


def write_table_capture(folder: Path, layout: MeasuredTable, source: Path, options: ConvertOptions) -> list[Problem]:
    """Take the table over unchanged into a new folder; returns what the user should know."""
    table = layout.file
    folder.mkdir(parents=True)
    name = take(table, folder / table.name, options.link)
    stated = {"values": options.values, "azimuths": options.azimuths}
    block = {"table": name} | {key: value for key, value in stated.items() if value}
    block |= {"symmetry": "quarter", "weave": "unknown"}
    settings = {"format": FORMAT, "title": options.title or table.stem, "geometry": "goniometer", "goniometer": block}
    (folder / "capture.yaml").write_text(settings_text(settings), encoding="utf-8")
    what = "two mirror planes, through weft and warp, are taken for granted"
    remedy = "Use --open and set goniometer.symmetry (quarter, half, none) and goniometer.weave if it is otherwise"
    return [warning("symmetry-assumed", table.name, what, remedy=remedy)]
