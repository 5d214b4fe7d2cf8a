"""One registry of folder layouts: what each is recognised by, and what reads it.

A further layout is one entry here and one module with its two functions. The first entry whose `matches` returns
evidence is read, so that lamps come before cameras, and photographs before what was computed from them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nishiki.capture.balls import find_photographs, read_with_balls
from nishiki.capture.bundler import bundler_file, read_bundler
from nishiki.capture.colmap import colmap_folder, read_colmap
from nishiki.capture.goniometer_convert import MeasuredTable, read_measurements, recognise_table
from nishiki.capture.layouts import (
    DIRECTIONS,
    Layout,
    find_lights_file,
    find_spheres,
    read_diligent,
    read_rtibuilder,
    read_with_lights_file,
    read_with_spheres,
)
from nishiki.capture.meshroom import meshroom_file, read_meshroom
from nishiki.capture.metashape import metashape_file, read_metashape
from nishiki.capture.options import ConvertOptions
from nishiki.capture.relightable import Rendering, read_relightable, recognise_relightable
from nishiki.capture.rtibuilder import RtiProject
from nishiki.capture.transforms import read_transforms, transforms_file
from nishiki.capture.turntable_layouts import (
    RoundLayout,
    cameras_of,
    find_camera_list,
    find_matrices,
    find_states,
    read_middlebury,
    read_numbered,
    read_series,
)
from nishiki.formats.problems import CaptureError, error

UNKNOWN = "no lamps found, nor cameras"
SourceLayout = Layout | RoundLayout | Rendering | MeasuredTable
"""What readers return: `name`, `count` of the photographs, `parts` in words, `geometry`, `channels` and `warnings`.
Each has a writer, see `convert.WRITERS`."""


@dataclass(frozen=True)
class FolderLayout:
    """One kind of source.

    Attributes
    ----------
    name : str
        What users call it.
    signs : str
        What it is recognised by, as the message says that no layout was recognised.
    matches : callable
        Function (source, options) -> evidence, such as the lights file, or None; quick. CaptureError where the layout
        is recognised and ambiguous.
    read : callable
        Function (source, evidence, options) -> SourceLayout. CaptureError where the source cannot be used.
    files : bool
        Whether a source may be a file.
    """

    name: str
    signs: str
    matches: Callable[[Path, ConvertOptions], Any]
    read: Callable[[Path, Any, ConvertOptions], SourceLayout]
    files: bool = False


LAYOUTS = (
    FolderLayout(
        "RTIBuilder project",
        "a project of RTIBuilder (assembly-files, jpeg-exports)",
        lambda source, options: RtiProject.of(source),
        read_rtibuilder,
    ),
    FolderLayout(
        "lights file",
        "a .lp file, Relight's .relight, or an info.json with lights",
        find_lights_file,
        read_with_lights_file,
    ),
    FolderLayout(
        "DiLiGenT",
        DIRECTIONS,
        lambda source, options: source / DIRECTIONS if (source / DIRECTIONS).is_file() else None,
        read_diligent,
    ),
    FolderLayout("mirror spheres", "folders of mirror spheres with circle_data.txt", find_spheres, read_with_spheres),
    FolderLayout(
        "cameras of COLMAP",
        "cameras of COLMAP (cameras and images, .txt or .bin)",
        lambda source, options: colmap_folder(source),
        cameras_of("COLMAP", lambda folder, pictures: read_colmap(folder)),
    ),
    FolderLayout(
        "cameras of Meshroom",
        "cameras of Meshroom (cameras.sfm)",
        lambda source, options: meshroom_file(source),
        cameras_of("Meshroom", lambda file, pictures: read_meshroom(file)),
    ),
    FolderLayout(
        "cameras of transforms.json",
        "cameras of Blender, nerfstudio or another NeRF program (transforms.json)",
        lambda source, options: transforms_file(source),
        cameras_of("transforms.json", read_transforms),
    ),
    FolderLayout(
        "cameras of Metashape",
        "cameras of Metashape (.xml)",
        lambda source, options: metashape_file(source),
        cameras_of("Metashape", lambda file, pictures: read_metashape(file)),
    ),
    FolderLayout(
        "cameras of Bundler",
        "cameras of Bundler (bundle.out with list.txt)",
        lambda source, options: bundler_file(source),
        cameras_of("Bundler", read_bundler),
    ),
    FolderLayout("list of cameras", "a list of cameras (*_par.txt)", find_camera_list, read_middlebury),
    FolderLayout("camera matrices", "a .mat file with matrices P", find_matrices, read_numbered),
    FolderLayout("polarisation series", "photographs named GENERATOR_ANALYSER in degrees", find_states, read_series),
    FolderLayout(
        "relightable image",
        "a relightable image (.ptm, .rti, a folder of relight or webRTIViewer)",
        recognise_relightable,
        read_relightable,
        files=True,
    ),
    FolderLayout(
        "table of reflectances",
        "a table of reflectances (.csv, .brdf, .bin, .binary)",
        recognise_table,
        read_measurements,
        files=True,
    ),
)

LAST_RESORT = FolderLayout(
    "mirror balls", "mirror balls in the frame of the photographs", find_photographs, read_with_balls
)
"""Read where no entry of the registry matches. It is none itself, because whether it applies needs all pixels."""


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
        raise CaptureError(error("folder-missing", str(source), what, remedy=remedy))
    photographs = LAST_RESORT.matches(source, options)  # says what is wrong with pictures that are not read
    found = None
    if photographs and search:
        try:
            return LAST_RESORT.read(source, photographs, options)
        except CaptureError as e:
            if e.problems[0].kind != "layout-unknown":
                raise
            found = e.problems[0].what
    expected = f"one of: {'; '.join(entry.signs for entry in (*LAYOUTS, LAST_RESORT))}"
    remedy = (
        "Name the lights file with --lights. Without one, photograph mirror balls under the same lamps and measure "
        "these: ./nishiki calibrate spheres BALLS CALIBRATION, then --lights CALIBRATION/lamps.dome. Or write "
        "capture.yaml and frames.csv by hand (docs/capture-folder.md)"
    )
    raise CaptureError(error("layout-unknown", str(source), UNKNOWN, expected=expected, found=found, remedy=remedy))
