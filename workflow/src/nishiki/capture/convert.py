"""An existing folder of photographs and lamps made into a capture folder; the sources are only read."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from nishiki.capture.layout_writers import MeasuredTable, write_plane, write_round, write_table_capture
from nishiki.capture.layouts import Layout
from nishiki.capture.mosaic import COLUMNS, TABLE, within
from nishiki.capture.options import ConvertOptions, file_problems, folder_problems
from nishiki.capture.registry import MosaicLayout, read_source
from nishiki.capture.relightable import Rendering, write_rendered
from nishiki.capture.turntable_layouts import RoundLayout
from nishiki.formats.files import whole_folder
from nishiki.formats.problems import Problem, raise_errors, refuse

JUDGED = (
    *("camera-moved", "lamps-near", "lamp-failed", "photograph-repeated", "room-light", "lights-axes-undecided"),
    *("white-exchanged", "white-disagrees", "view-contradicts", "views-contradict", "mesh-placement"),
)
"""Kinds of warnings that photographs give against each other, which `convert` passes on."""


def write_mosaic(folder: Path, layout: MosaicLayout, source: Path, options: ConvertOptions) -> list[Problem]:
    """Write the capture of each field below a new folder, and the table of all."""
    folder.mkdir(parents=True)
    rows, notes = [",".join(COLUMNS)], []
    for field, each in zip(layout.fields, layout.layouts, strict=True):
        place = replace(field, place=f"fields/{field.name}")
        told = WRITERS[type(each)](folder / place.place, each, field.path, layout.options)
        notes += within(place, [*each.warnings, *told])
        rows.append(",".join([field.name, place.place, *(f"{each:.10g}" for each in field.position_mm or ())]))
    (folder / TABLE).write_text("".join(f"{row}{',,' * (row.count(',') == 1)}\n" for row in rows), encoding="utf-8")
    return notes


WRITERS: dict[type, Callable[..., list[Problem]]] = {
    Layout: write_plane,
    RoundLayout: write_round,
    Rendering: write_rendered,
    MeasuredTable: write_table_capture,
    MosaicLayout: write_mosaic,
}
"""What writes each kind of layout that a reader of the registry returns."""


@dataclass(frozen=True)
class Conversion:
    """The capture folder made, the layout recognised, the number of photographs, what the user should know."""

    folder: Path
    layout: str
    photographs: int
    warnings: tuple[Problem, ...]
    geometry: str = "plane"
    channels: tuple[str, ...] = ()  # of a table of reflectances, in 1/sr


def convert(source: Path | str, target: Path | str, options: ConvertOptions | None = None, **given) -> Conversion:
    """Make a capture folder from what other programs left, see `registry.LAYOUTS`; it appears whole or not at all.

    Parameters
    ----------
    source : Path or str
        Folder of photographs, table of reflectances or relightable image; it is only read.
    target : Path or str
        Capture folder to make, which must not exist.
    options : ConvertOptions, optional
        What the user gives beside.
    **given
        Fields of ConvertOptions, in place of those of `options`.

    Returns
    -------
    Conversion
        The folder, the layout that was recognised, and what the user should know.

    Raises
    ------
    CaptureError
        target-exists, folder-missing, file-missing, and those of `read_source` and of the layout's writer.
    """
    options = replace(options or ConvertOptions(), **given)
    source, target = named(Path(source)), Path(target)
    if target.exists():
        refuse("target-exists", str(target), "target exists", remedy="Choose another name; nothing is overwritten")
    missing = file_problems(lights=options.lights_file)
    if options.ambient is not None and not options.ambient.is_dir():
        missing += file_problems(ambient=options.ambient)
    raise_errors([*folder_problems(white=options.white, dark=options.dark), *missing])
    layout = read_source(source, options)
    if not isinstance(layout, MeasuredTable):
        options.refuse("They belong to tables of reflectances; leave them out", "values", "azimuths")
    if getattr(layout, "matrices", None) is None:
        options.refuse("Nothing here has camera matrices to arrange; leave the option out", "turn", "camera_of")
    with whole_folder(target) as partial:
        notes = WRITERS[type(layout)](partial, layout, source, options)
        found = options.examine(partial) if options.examine else []
        raise_errors(found)
    notes += [problem for problem in found if problem.kind in JUDGED]
    return Conversion(target, layout.name, layout.count, (*layout.warnings, *notes), layout.geometry, layout.channels)


def named(source: Path) -> Path:
    """Return a path that ends in the source's name, from which titles are taken; `.` and `..` have none."""
    return Path(os.path.abspath(source)) if source.name in ("", "..") else source
