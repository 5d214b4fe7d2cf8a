"""Make a capture folder from an existing folder of photographs and lamps; the sources are only read.

The registry of folder layouts states what each is recognised by, and what reads it. A further layout is one entry there
and one module with its two functions. The first entry whose `matches` returns evidence is read, so that lamps come
before cameras, and photographs before what was computed from them.
"""

import os
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from nishiki.capture import layout_writers, photogrammetry, turntable_layouts
from nishiki.capture.layouts import (
    DIRECTIONS,
    RELIGHTABLE,
    Layout,
    find_lights_file,
    find_spheres,
    read_diligent,
    read_rtibuilder,
    read_with_lights_file,
    read_with_spheres,
)
from nishiki.capture.mosaic import COLUMNS, NAME, TABLE, FieldRow, is_capture, is_mosaic, read_fields, within
from nishiki.capture.options import ConvertOptions, file_problems, folder_problems
from nishiki.capture.registered import PictureIndex, Registration, colmap_folder, read_colmap
from nishiki.capture.relightable import RelightableRendering, read_relightable, recognise_relightable, write_rendering
from nishiki.capture.rti_projects import find_rti_project
from nishiki.capture.spheres.measure import find_photographs, read_with_balls
from nishiki.formats.files import Refused, bound, files_with, leads_out, whole_folder
from nishiki.formats.picture_files import IMAGE_SUFFIXES
from nishiki.formats.problems import CaptureError, Problem, expect_one, name_some, raise_errors, refuse

UNKNOWN, EMPTY = "no lamps found, nor cameras", "no photographs in this folder"


@dataclass(frozen=True)
class MosaicLayout:
    """Fields of a mosaic, each with the layout of its folder."""

    fields: tuple[FieldRow, ...]
    layouts: tuple[Layout | RelightableRendering, ...]
    options: ConvertOptions  # for each field
    name, geometry, channels, warnings = "fields", "mosaic", (), ()

    @property
    def count(self) -> int:
        """Number of the photographs, and of pictures to render, of all fields."""
        return sum(layout.count for layout in self.layouts)

    @property
    def parts(self) -> str:
        """Fields and photographs in words."""
        return f"{len(self.fields)} fields, {self.count} photographs"


SourceLayout = (
    Layout | turntable_layouts.RoundLayout | RelightableRendering | layout_writers.MeasuredTable | MosaicLayout
)
"""Return type of readers: `name`, `count` of the photographs, `parts` in words, `geometry`, `channels` and `warnings`.
Each has a writer, see `convert.WRITERS`."""


@dataclass(frozen=True)
class FolderLayout:
    """One kind of source."""

    name: str  # what users call it
    # function (source, options) -> evidence, such as the lights file, or None; quick. CaptureError where the layout is
    # recognised and ambiguous.
    matches: Callable[[Path, ConvertOptions], Any]
    # function (source, evidence, options) -> SourceLayout. CaptureError where the source cannot be used.
    read: Callable[[Path, Any, ConvertOptions], SourceLayout]
    files: bool = False  # whether a source may be a file


def file_of_cameras(suffix: str, *marks: bytes, name: str = "", places: tuple[str, ...] = (".",)) -> Callable:
    """Make a function that finds the only file with a suffix and these marks in its head; one of this name first."""

    def find(source: Path) -> Path | None:
        for folder in filter(Path.is_dir, (source / place for place in places)):
            found = []
            for path in files_with(folder, (suffix,)):
                with path.open("rb") as stream:
                    head = stream.read(photogrammetry.HEAD)
                found += [path] if all(mark in head for mark in marks) else []
            named = [path for path in found if path.name == name] or found
            remedy = f"Keep the one of these photographs{f', or call it {name}' if name else ''}"
            if one := expect_one(named, source, f"several files {suffix} of cameras", remedy):
                return one
        return None

    return find


CAMERAS: tuple[tuple[str, Callable[[Path], Path | None], Callable[[Path, PictureIndex], Registration]], ...] = (
    ("COLMAP", colmap_folder, read_colmap),
    ("Meshroom", file_of_cameras(".sfm", name="cameras.sfm"), photogrammetry.read_meshroom),
    ("transforms.json", photogrammetry.transforms_file, photogrammetry.read_transforms),
    ("Metashape", file_of_cameras(".xml", b"<chunk", b"<sensors"), photogrammetry.read_metashape),
    (
        "Bundler",
        file_of_cameras(".out", b"# Bundle file", name="bundle.out", places=(".", "bundle")),
        photogrammetry.read_bundler,
    ),
)
"""Camera formats of other programs: name, function that finds file or folder, function that reads it."""


def cameras_of(program: str, find: Callable, read: Callable[[Path, PictureIndex], Registration]) -> FolderLayout:
    """Make the registry entry for folders with cameras of another program."""

    def read_registered(source: Path, cameras: Path, options: ConvertOptions) -> turntable_layouts.RoundLayout:
        pictures = PictureIndex(source)
        return turntable_layouts.place_registered(source, program, cameras.name, read(cameras, pictures), pictures)

    return FolderLayout(f"cameras of {program}", lambda source, options: find(source), read_registered)


def find_fields(source: Path, options: ConvertOptions) -> tuple[FieldRow, ...] | None:
    """Return the fields of a table, or all folders with photographs where the user declares them fields."""
    if is_mosaic(source):
        return read_fields(source)
    if not options.fields:
        return None
    kinds = IMAGE_SUFFIXES.union(RELIGHTABLE)
    folders = [each for each in sorted(source.iterdir()) if each.is_dir() and files_with(each, kinds)]
    unusable = [each.name for each in folders if not NAME.fullmatch(each.name)]
    if unusable:
        expected, remedy = "letters, digits, _ and single -", f"Rename it, or name its field in {TABLE}: field,path"
        refuse("field-name", unusable[0], "no name for a field", expected=expected, remedy=remedy)
    if len(folders) < 2:
        refuse("fields-few", str(source), "too few fields", expected="two folders of photographs or more")
    return tuple(FieldRow(each.name, each.name, each) for each in folders)


def read_mosaic(source: Path, fields: tuple[FieldRow, ...], options: ConvertOptions) -> MosaicLayout:
    """Read the folder of each field; lamps that lie beside these folders apply to all fields."""
    options.refuse("Each field has a mask of its own: put it beside the photographs", "mask")
    lights = options.lights_file or find_lights_file(source, options)
    options = replace(options, fields=False, lights_file=lights, title=options.title or source.name)
    layouts = []
    for field in fields:
        layout = read_source(field.path, options)
        if not isinstance(layout, Layout | RelightableRendering):
            refuse("fields-differ", field.place, "neither photographs of a plane nor relightable", found=layout.name)
        layouts.append(layout)
    return MosaicLayout(fields, tuple(layouts), options)


LAYOUTS = (
    FolderLayout("fields", find_fields, read_mosaic),
    FolderLayout("RTIBuilder project", find_rti_project, read_rtibuilder),
    FolderLayout("lights file", find_lights_file, read_with_lights_file),
    FolderLayout(
        "DiLiGenT",
        lambda source, options: source / DIRECTIONS if (source / DIRECTIONS).is_file() else None,
        read_diligent,
    ),
    FolderLayout("mirror spheres", find_spheres, read_with_spheres),
    *(cameras_of(*program) for program in CAMERAS),
    FolderLayout("list of cameras", turntable_layouts.find_camera_list, turntable_layouts.read_middlebury),
    FolderLayout("camera matrices", turntable_layouts.find_matrices, turntable_layouts.read_numbered_matrices),
    FolderLayout(turntable_layouts.TURN, turntable_layouts.find_turn, turntable_layouts.read_turn),
    FolderLayout("polarisation series", turntable_layouts.find_states, turntable_layouts.read_series),
    FolderLayout("relightable image", recognise_relightable, read_relightable, files=True),
    FolderLayout("table of reflectances", layout_writers.recognise_table, layout_writers.read_measurements, files=True),
)

LAST_RESORT = FolderLayout("mirror balls", find_photographs, read_with_balls)
"""Layout tried where no entry of the registry matches. It is no entry, because the test reads all pixels."""


def recognise(source: Path, options: ConvertOptions) -> tuple[FolderLayout, Any] | None:
    """Find the layout of a file or folder and its evidence; None where it is of no known layout."""
    for entry in LAYOUTS:
        if source.is_dir() or (entry.files and source.is_file()):
            evidence = entry.matches(source, options)
            if evidence is not None:
                return entry, evidence
    return None


def read_source(source: Path, options: ConvertOptions, *, search: bool = True) -> SourceLayout:
    """Recognise a source and read it; search: look for mirror balls in photographs of no known layout.

    Raises CaptureError (folder-missing, layout-unknown, and those of the layout's reader).
    """
    known = recognise(source, options)
    if known is not None:
        return known[0].read(source, known[1], options)
    if not source.is_dir():
        remedy = "Name the folder of the photographs; a lights file outside of it by --lights FILE"
        what = "no folder, no table of reflectances and no relightable image" if source.exists() else "no such folder"
        refuse("folder-missing", str(source), what, remedy=remedy)
    photographs = LAST_RESORT.matches(source, options)  # says what is wrong with pictures that are not read
    if photographs and search:
        try:
            return LAST_RESORT.read(source, photographs, options)
        except CaptureError as e:
            if e.problems[0].kind != "layout-unknown":
                raise
    if files_with(source, IMAGE_SUFFIXES):
        remedy = (
            "Name the lights file with --lights, or say --turntable where they show an object from all round. Without "
            "lamps, photograph mirror balls under the same lamps and measure "
            "these: ./nishiki calibrate spheres BALLS CALIBRATION, then --lights CALIBRATION/lamps.dome. Everything "
            "that is recognised by itself: docs/capture-folder.md and docs/imports.md"
        )
        found = "photographs, but no lights file, and no mirror ball in them"
        refuse("layout-unknown", str(source), UNKNOWN, found=found, remedy=remedy)
    inner = [each for each in sorted(source.iterdir()) if each.is_dir() and files_with(each, IMAGE_SUFFIXES)]
    inner.sort(key=lambda each: "mask" in each.name.lower())  # the photographs first
    named = shlex.quote(str(inner[0] if inner else source))
    remedy = f"Name one of them: ./nishiki run {named}" if inner else "Name the folder that holds the photographs"
    remedy += "; or add --fields where they are overlapping fields of one painting" if len(inner) > 1 else ""
    remedy += f"; what each folder holds: ./nishiki convert {shlex.quote(str(source))} --list"
    found = f"some in {name_some(each.name for each in inner)}" if inner else ""
    refuse("layout-unknown", str(source), EMPTY, found=found, remedy=remedy)


NOTHING = ConvertOptions()


class ArchiveEntry(NamedTuple):
    """One folder or file: path relative to the archive, name of its layout, its parts in words, reason or ''."""

    path: str
    layout: str
    parts: str
    reason: str


def list_archive(archive: Path) -> Iterator[ArchiveEntry]:
    """Recognise each folder below an archive, and each file where a folder holds several that stand for themselves.

    A folder that is recognised, a capture, or a Zarr store is not entered. `reason`: why a source cannot be read.
    """
    pending = [(archive, 0)]
    while pending:
        place, depth = pending.pop()
        inner = sorted(path for path in place.iterdir() if not path.name.startswith("."))
        entered = (path for path in inner if path.is_dir() and path.suffix != ".zarr")
        folders = [path for path in entered if not leads_out(path, archive)]
        if is_capture(place):
            yield ArchiveEntry(str(place.relative_to(archive)), "capture", "", "it is a capture already")
            continue
        entry = _entry_of(place, archive)
        single = [path for path in inner if path.is_file() and recognise(path, NOTHING) is not None]
        if entry.reason and len(single) > 1:
            yield from (_entry_of(path, archive) for path in single)
        elif entry.layout or not folders:
            yield entry
        if not entry.layout and depth < bound("folder_depth"):
            pending += [(path, depth + 1) for path in reversed(folders)]


def _entry_of(source: Path, archive: Path) -> ArchiveEntry:
    """Describe one source; the layout is '' where none is recognised and no picture lies there."""
    name, layout = str(source.relative_to(archive)), ""
    try:
        found = recognise(source, NOTHING)
        layout = found[0].name if found else ""
        return ArchiveEntry(name, layout, read_source(source, NOTHING, search=False).parts, "")
    except (CaptureError, Refused) as problem:
        problems = problem.problems if isinstance(problem, CaptureError) else (problem,)
        pictures = len(files_with(source, IMAGE_SUFFIXES)) if source.is_dir() else 0
        known = layout or problems[0].what not in (UNKNOWN, EMPTY)
        reason = f"{problems[0]}" + (f" (and {len(problems) - 1} more)" if len(problems) > 1 else "")
        if not known:
            reason = f"{UNKNOWN}; convert searches the pictures for mirror balls" if pictures else UNKNOWN
        parts = f"{pictures} pictures" if pictures else ""
        return ArchiveEntry(name, layout or ("unknown" if pictures else ""), parts, reason)


JUDGED = (
    *("camera-moved", "lamps-near", "lamp-failed", "photograph-repeated", "photograph-contradicts", "room-light"),
    *("lights-axes-undecided", "lights-heights-undecided", "curves-differ", "white-exchanged", "white-disagrees"),
    *("room-light-differs", "view-contradicts", "views-contradict", "mesh-placement"),
)
"""Kinds of warnings from comparing photographs with each other, which `convert` passes on."""


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
    Layout: layout_writers.write_plane,
    turntable_layouts.RoundLayout: layout_writers.write_round,
    RelightableRendering: write_rendering,
    layout_writers.MeasuredTable: layout_writers.write_table_capture,
    MosaicLayout: write_mosaic,
}
"""Writer of each kind of layout that a reader of the registry returns."""


@dataclass(frozen=True)
class Conversion:
    """Capture folder, recognised layout, number of photographs, and notes for the user."""

    folder: Path
    layout: str
    photographs: int
    warnings: tuple[Problem, ...]
    geometry: str = "plane"
    channels: tuple[str, ...] = ()  # of a table of reflectances, in 1/sr


def convert(source: Path | str, target: Path | str, options: ConvertOptions | None = None, **given) -> Conversion:
    """Make a capture folder from files of other programs, see `registry.LAYOUTS`; it appears whole or not at all.

    Parameters
    ----------
    source : Path or str
        Folder of photographs, table of reflectances or relightable image; it is only read.
    target : Path or str
        Capture folder to make, which must not exist.
    options : ConvertOptions, optional
        Options of the conversion.
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
    source, target = Path(source), Path(target)
    if source.name in ("", ".."):  # titles are taken from the name
        source = Path(os.path.abspath(source))
    if target.exists():
        refuse("target-exists", str(target), "target exists", remedy="Choose another name; nothing is overwritten")
    missing = file_problems(lights=options.lights_file)
    if options.ambient is not None and not options.ambient.is_dir():
        missing += file_problems(ambient=options.ambient)
    raise_errors([*folder_problems(white=options.white, dark=options.dark), *missing])
    layout = read_source(source, options)
    if not isinstance(layout, layout_writers.MeasuredTable):
        options.refuse("They belong to tables of reflectances; leave them out", "values", "azimuths")
    if not isinstance(layout, turntable_layouts.RoundLayout) or layout.matrices is not None:
        options.refuse("Only cameras that are estimated from photographs of a turn need it", "height_mm")
    if not isinstance(layout, turntable_layouts.RoundLayout):
        options.refuse(f"The folder was recognised as {layout.name}", "turntable")
    if getattr(layout, "matrices", None) is None:
        options.refuse("Nothing here has camera matrices to arrange; leave the option out", "turn", "camera_of")
    with whole_folder(target) as partial:
        notes = WRITERS[type(layout)](partial, layout, source, options)
        found = options.examine(partial) if options.examine else []
        raise_errors(found)
    notes += [problem for problem in found if problem.kind in JUDGED]
    return Conversion(target, layout.name, layout.count, (*layout.warnings, *notes), layout.geometry, layout.channels)
