"""Read folders of photographs from other projects: which picture belongs to which lamp."""

import math
import os
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path, PurePath

import numpy as np

from nishiki.capture import rti_projects, stated_lights
from nishiki.capture.frames import SourcePhotographs, inside
from nishiki.capture.lights import Lights, light_name, lights_from_vectors, read_lights
from nishiki.capture.options import ConvertOptions
from nishiki.capture.pairing import find_bands
from nishiki.capture.spheres.optics import direction_from_sphere
from nishiki.capture.taking import read_grey
from nishiki.formats.files import NAME_BYTES, bound, files_with, is_plain, leads_out, read_text, same_name
from nishiki.formats.images import read_header
from nishiki.formats.picture_files import IMAGE_SUFFIXES
from nishiki.formats.problems import CaptureError, Problem, error, expect_one, left_out, raise_errors, refuse, warning
from nishiki.formats.relight import INFO, LAYERS, is_relight_folder
from nishiki.formats.relight_planes import TILE, is_web_rti
from nishiki.formats.text_tables import expect_rows, reading, table_lines

MASK_WORD = re.compile(r"(^|[._\- ])mask([._\- ]|$)", re.IGNORECASE)
MASK_SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".exr")
UNREAD_SUFFIXES = frozenset(".tga .bmp .webp .gif .heic .heif .jp2 .ppm .pgm .pnm .pfm .hdr .psd".split())
PROBE_DATA = "circle_data.txt"
DIRECTIONS = "light_directions.txt"
RELIGHTABLE = (".ptm", ".rti")
DISAGREEMENT = np.radians(3.0)


@dataclass(frozen=True)
class Layout(SourcePhotographs):
    """photographs[i] was taken under lights.names[i]; intensities (lights, channels) or None; mask or None."""

    name: str
    photographs: tuple[Path, ...]
    lights: Lights
    intensities: np.ndarray | None
    mask: Path | None
    warnings: tuple[Problem, ...]
    kind: str = "direction"  # what the lamps' vectors are, `direction` or `position_mm`
    pitch_mm: float = 0.0  # width of a pixel on the object, 0 if it is not known
    region: tuple[int, int, int, int] | None = None  # row, column, rows, columns to use, None for all
    shifts: np.ndarray | None = None  # (lights, 2): see `Frame.shift_px`
    # names of the channels where each has a file of its own, and band_files[i] the files of photograph i
    bands: tuple[str, ...] = ()
    band_files: tuple[tuple[Path, ...], ...] = ()
    # further files of the capture by name, of which `mask.png` is the mask where there is no other
    files: Mapping[str, bytes] = field(default_factory=dict)
    notes: str = ""  # for capture.yaml
    geometry = "plane"

    @property
    def parts(self) -> str:
        """Photographs and lamps in words."""
        return f"{self.count} photographs, {len(self.lights.names)} lamps"


def natural_parts(text: str) -> list:
    """Split a name into sort keys by which cat.2 comes before cat.10."""
    return [int(part) if part.isdecimal() else part.casefold() for part in re.split(r"([0-9]+)", text)]


def natural_key(path: Path) -> list:
    """Return `natural_parts` of a file's name."""
    return natural_parts(path.name)


def photographs_in(folder: Path) -> list[Path]:
    """List a folder's pictures in natural order: no masks, no hidden files, of relight's folders no planes and maps.

    CaptureError (outside-folder, name-unusable) where one is a link that leads out of the folder, or its name cannot
    be that of a file in a capture.
    """
    pictures = files_with(folder, IMAGE_SUFFIXES)
    fitted, tiled = (folder / INFO).is_file(), is_web_rti(folder)
    others = (
        p
        for p in pictures
        if not (MASK_WORD.search(p.stem) or (fitted and LAYERS.fullmatch(p.stem)) or (tiled and TILE.fullmatch(p.stem)))
    )
    chosen = sorted(others, key=natural_key)
    raise_errors(problem for path in chosen for problem in source_problems(path, folder))
    if not chosen and not fitted and not tiled:
        unread = [path.name for path in files_with(folder, UNREAD_SUFFIXES)]
        if unread:
            expected = "PNG, JPEG, TIFF, OpenEXR or camera raw"
            found = f"{unread[0]} and {len(unread) - 1} more" if len(unread) > 1 else unread[0]
            suffix = os.path.splitext(unread[0])[1]
            remedy = f"Convert them to PNG without changing size or values (ImageMagick: mogrify -format png *{suffix})"
            what = "these pictures are of a format that is not read"
            refuse("image-unsupported", str(folder), what, expected=expected, found=found, remedy=remedy)
    return chosen


def source_problems(path: Path, folder: Path) -> list[Problem]:
    """Check that a file belongs to its folder: a link to a file elsewhere does not."""
    if not is_plain(path.name) or len(os.fsencode(path.name)) > NAME_BYTES:
        what, remedy = "name of a photograph", f"Rename it: at most {NAME_BYTES} bytes of UTF-8, no control characters"
        return [error("name-unusable", path.name, what, found=repr(path.name[:60]), remedy=remedy)]
    if leads_out(path, folder):
        found, remedy = os.path.realpath(path), "Copy the folder with its links followed (cp -rL) and convert the copy"
        return [error("outside-folder", path.name, "link out of the folder", found=found, remedy=remedy)]
    return []


def find_lights_file(source: Path, options: ConvertOptions) -> Path | None:
    """Find the lights file of a folder: given, the only `.lp`, or Relight's.

    None without, and where the folder holds a relightable image in place of the photographs. CaptureError
    (layout-unknown) where there are several.
    """
    listed = files_with(source, (".lp",))
    file = options.lights_file or expect_one(listed, source, "several .lp files", "Name one: --lights FILE")
    if file is None and not (source / DIRECTIONS).is_file():
        file = rti_projects.find_relight(source)
    rendered = is_relight_folder(source) or is_web_rti(source) or files_with(source, RELIGHTABLE)
    if file is None or photographs_in(source) or not rendered:
        return file
    return (
        None
        if file.name == INFO or _find_folder(source, state_lights(source, file, options).lights, file) == source
        else file
    )


def read_with_lights_file(source: Path, file: Path, options: ConvertOptions) -> Layout:
    """Read the lights, find their photographs, and resolve with these whatever the file leaves open."""
    stated = state_lights(source, file, options)
    return _complete(_with_lights(source, stated, file, options.mask or find_mask(source)), stated, file, options)


def state_lights(source: Path, file: Path, options: ConvertOptions) -> stated_lights.StatedLights:
    """Read a lights file of any kind for the photographs in a folder or in those below it."""
    if (file.suffix or file.name).lower() in rti_projects.RELIGHT_SUFFIXES:
        return rti_projects.read_relight(file, options.lights_kind, options.width_mm)
    folders = [source, *(path for path in source.iterdir() if path.is_dir())] if source.is_dir() else []
    present = {path.name for folder in folders for path in files_with(folder, IMAGE_SUFFIXES)}
    return stated_lights.read_lights_file(file, options.lights_kind, present)


def _complete(layout: Layout, stated: stated_lights.StatedLights, file: Path, options: ConvertOptions) -> Layout:
    """Complete the layout with further statements of the file and decisions based on the photographs."""
    sample = cache(lambda: stated_lights.sample_photographs(layout.photographs, options.encoding))
    if len(layout.lights.names) != len(stated.lights.names):  # a line a band
        stated = replace(stated, intensities=None, rival=None, shifts=None)
    stated, columns = replace(stated, lights=layout.lights), read_header(layout.photographs[0]).columns
    stated = stated_lights.decide(stated, file.name, sample, columns, options.width_mm)
    stated = stated_lights.decide_strengths(stated, file.name, sample)
    stated = stated if options.white else stated_lights.scale_to_middle(stated, file.name, sample)
    more = [note for note in stated.lights.warnings if note not in layout.warnings]
    notes = [note for note in (*layout.warnings, *more) if not (options.region and note.kind == rti_projects.CROPPED)]
    return replace(
        layout,
        lights=stated.lights,
        kind=stated.kind,
        pitch_mm=stated.width_mm / columns or stated.pitch_mm,
        intensities=stated.intensities,
        region=stated.region,
        shifts=stated.shifts,
        warnings=tuple(notes),
    )


def settle_directions(layout: Layout, options: ConvertOptions) -> Layout:
    """Estimate the distance of near lamps of known directions from the photographs."""
    kind = "position_mm" if options.lights_kind == "position_mm" else "direction"
    stated = stated_lights.StatedLights(layout.lights, kind, intensities=layout.intensities)
    return _complete(layout, stated, Path(layout.name), options)


def read_rtibuilder(source: Path, folders: dict[str, Path], options: ConvertOptions) -> Layout:
    """Read the lights of an RTIBuilder project, given or its own, and find the photographs they name, by stem."""
    lights_file = options.lights_file or rti_projects.find_project_lights(source, folders)
    stated = state_lights(source, lights_file, options)
    lights = stated.lights
    if all(file is None for file in lights.files):
        remedy = "Convert the folder of photographs with --lights"
        refuse("layout-unknown", lights_file.name, "the lights file names no photographs", remedy=remedy)
    folder, others = rti_projects.find_project_photographs(source, folders, lights)
    layout = _with_lights(folder, stated, lights_file, options.mask or find_mask(source) or find_mask(folder))
    layout = _complete(layout, stated, lights_file, options)
    what = f"an RTIBuilder project: the lights of {lights_file.name} and the photographs of {folder.name}"
    found = f"the same photographs in {', '.join(others)}, not used" if others else ""
    words = [str(folders[others[-1]]), "--lights", str(lights_file)] if others else []
    remedy = f"For the last of those: ./nishiki convert {shlex.join(words)}" if others else ""
    note = warning("project-folders", str(source), what, found=found, remedy=remedy)
    return replace(layout, name="RTIBuilder project", warnings=(note, *layout.warnings))


def find_spheres(source: Path, options: ConvertOptions) -> list[Path] | None:
    """Find the folders of mirror spheres with their circles; None without."""
    return sorted(path.parent for path in source.glob(f"*/{PROBE_DATA}")) or None


def find_mask(source: Path) -> Path | None:
    """Find the only picture called a mask in a folder."""
    masks = masks_in(source)
    return masks[0] if len(masks) == 1 else None


def masks_in(folder: Path) -> list[Path]:
    """List pictures of a folder whose names hold the word mask. CaptureError: outside-folder, name-unusable."""
    masks = [path for path in files_with(folder, MASK_SUFFIXES) if MASK_WORD.search(path.stem)]
    raise_errors(problem for path in masks for problem in source_problems(path, folder))
    return masks


def _with_lights(source: Path, stated: stated_lights.StatedLights, lights_file: Path, mask: Path | None) -> Layout:
    """Match photographs to a lights file: by the names in it, else in the natural order of their names."""
    kind = "position_mm" if stated.open_kind else stated.kind
    banded = find_bands(source, stated.lights, photographs_in, kind=kind)
    if banded is not None:
        photographs = tuple(files[0] for files in banded.files)
        layout = Layout("a file a band", photographs, banded.lights, None, mask, banded.warnings)
        return replace(layout, bands=banded.channels, band_files=banded.files)
    folder, lights = source, stated.lights
    if not (present := photographs_in(source)):
        folder = _find_folder(source, lights, lights_file)
        present, mask = photographs_in(folder), mask or find_mask(folder)
    if all(file is None for file in lights.files):
        _expect_count(source, present, len(lights.names))
        return _in_order(source, present, lights, None, mask, "directions in order", kind=kind)
    by_name = {same_name(p.name): p for p in present}
    by_stem = {same_name(p.stem): p for p in present}
    held = f"{present[0].name} ... {present[-1].name}" if present else "no photographs"
    remedy = "Put it there, or mend its name in the lights file"
    chosen, missing = [], []
    for name, file in zip(lights.names, lights.files, strict=True):
        if path := by_name.get(same_name(re.split(r"[\\/]", file or "")[-1])) or by_stem.get(same_name(name)):
            chosen.append(path)
        else:
            what = f"no photograph '{file}'"
            missing.append(error("photograph-missing", str(folder), what, found=held, remedy=remedy))
    raise_errors(missing)
    extra = [p.name for p in present if p not in chosen]
    notes = left_out(extra, str(source), "pictures that the lights file does not name")
    return Layout("lights file", tuple(chosen), lights, None, mask, (*lights.warnings, *notes))


def _find_folder(source: Path, lights: Lights, file: Path) -> Path:
    """Find the folder that the lights file names for all photographs, of a folder without any; else return itself."""
    named = {same_name(PurePath(*re.split(r"[\\/]", file or "")).parent.name) for file in lights.files}
    place = PurePath(*re.split(r"[\\/]", next((file for file in lights.files if file), ""))).parent
    if ".." in place.parts and (source / place).is_dir():
        what, there = "the photographs lie outside of the folder of their lights", (source / place).resolve()
        remedy = f"Convert their folder: ./nishiki convert {shlex.join([str(there), 'CAPTURE', '--lights', str(file)])}"
        refuse("photograph-missing", str(source), what, found=str(there), remedy=remedy)
    found = [
        path
        for path in sorted(source.iterdir())
        if named == {same_name(path.name)} and path.is_dir() and not leads_out(path, source)
    ]
    return found[0] if found else source


def read_diligent(source: Path, directions: Path, options: ConvertOptions) -> Layout:
    """Read a data set in the layout of DiLiGenT: directions, intensities and names by line, else names in order."""
    mask = options.mask or find_mask(source)
    bare = read_lights(directions)
    names = source / "filenames.txt"
    present = photographs_in(source)
    if names.is_file():
        with reading(names.name, "lights"):
            listed = [line.strip() for _, line in table_lines(names, names.name)]
        expect_rows(len(listed), "lights", names.name, "lights")
        present = [inside(source, name, names.name) for name in listed]
    _expect_count(source, present, len(bare.names))
    intensities = None
    scales = source / "light_intensities.txt"
    if scales.is_file():
        try:
            with reading(scales.name, "intensities"):
                lines = [line for _, line in table_lines(scales, scales.name)]
            intensities = np.loadtxt(lines or [""], ndmin=2) if lines else np.zeros((0, 1))
        except ValueError as e:
            raise CaptureError(error("intensities-unreadable", scales.name, "not a table of numbers")) from e
        if len(intensities) != len(present) or not (np.isfinite(intensities) & (intensities > 0)).all():
            what = f"expected {len(present)} rows of numbers above 0, found {' x '.join(map(str, intensities.shape))}"
            refuse("intensities-invalid", scales.name, what)
    layout = _in_order(source, present, bare, intensities, mask, "DiLiGenT")
    if names.is_file():
        layout = replace(layout, intensities=intensities, warnings=bare.warnings)
    return settle_directions(layout, options)


def read_with_spheres(source: Path, probes: list[Path], options: ConvertOptions) -> Layout:
    """Measure lamps on spheres that were photographed with the object; both in natural order of the file names."""
    mask = options.mask or find_mask(source)
    numbered = re.compile(r"\d")
    folders = [p for p in source.iterdir() if p.is_dir() and p not in probes]
    objects = [pictures for pictures in map(photographs_in, folders) if pictures]
    if len(objects) != 1:
        what = f"expected one folder of photographs beside the mirror spheres, found {len(objects)}"
        refuse("layout-unknown", str(source), what)
    photographs = objects[0]
    spheres = []
    for probe in probes:
        pictures = [p for p in photographs_in(probe) if numbered.search(p.stem)]
        _expect_count(probe, pictures, len(photographs))
        spheres.append([_towards_lamp(p, *_circle(probe)) for p in pictures])
    notes, vectors = [], []
    for i, photograph in enumerate(photographs):
        towards = np.array([sphere[i] for sphere in spheres])
        vectors.append(towards.sum(axis=0) / np.linalg.norm(towards.sum(axis=0)))
        angle = np.arccos(np.clip(towards @ vectors[-1], -1, 1)).max()
        if angle > DISAGREEMENT:
            found = f"{np.degrees(angle):.1f} degrees from their mean"
            what = "mirror spheres disagree about the lamp"
            notes.append(warning("probes-disagree", photograph.name, what, found=found))
    lights = lights_from_vectors([p.stem for p in photographs], np.array(vectors), file="mirror spheres")
    layout = Layout("mirror spheres", tuple(photographs), lights, None, mask, (*notes, *lights.warnings))
    return settle_directions(layout, options)


def _circle(probe: Path) -> tuple[float, float, float]:
    """Read row, column and radius in pixels of a mirror sphere. PSBox counts from 1, and rows from the bottom."""
    file = f"{probe.name}/{PROBE_DATA}"
    try:
        with reading(file, "probe"):
            text = read_text(probe / PROBE_DATA, "table_bytes", name=file)
        column, row, radius = (float(word) for word in text.replace(",", " ").split()[:3])
    except ValueError as e:
        raise CaptureError(error("probe-unreadable", file, "circle", expected="column, row and radius")) from e
    if not all(map(math.isfinite, (column, row, radius))) or not 1 <= radius <= bound("image_side"):
        what = f"expected a column, a row and a radius of a pixel or more, found {column:g}, {row:g}, {radius:g}"
        refuse("probe-unreadable", file, what)
    return row, column - 1, radius


def _towards_lamp(path: Path, height: float, column: float, radius: float) -> np.ndarray:
    """Measure the lamp's direction on a mirror sphere. CaptureError (probe-unreadable) where it shows none.

    height : of the sphere's centre above the lower edge of the picture, in pixels (the lowest row is 1).
    """
    picture = read_grey(path).astype(np.float64)
    row = len(picture) - height
    if not (0 <= row < picture.shape[0] and 0 <= column < picture.shape[1]):
        what = f"a mirror sphere at row {row:g}, column {column:g} of {picture.shape[0]} x {picture.shape[1]} pixels"
        refuse("probe-unreadable", path.name, what)
    try:
        return direction_from_sphere(picture, (row, column), radius)
    except ValueError as e:
        raise CaptureError(error("probe-unreadable", path.name, "mirror sphere", found=str(e))) from e


def _in_order(
    source: Path,
    present: list[Path],
    lights: Lights,
    intensities: np.ndarray | None,
    mask: Path | None,
    name: str,
    *,
    kind: str = "direction",
) -> Layout:
    """Assign directions without names to the photographs in the natural order of their names."""
    named = lights_from_vectors([light_name(p.name) for p in present], lights.vectors, file=str(source.name), kind=kind)
    what = "directions have no file names: given to the photographs in the natural order of their names"
    found = f"{present[0].name} ... {present[-1].name}"
    note = warning("lights-in-order", source.name, what, found=found, remedy="Check that the order is the lamps' order")
    return Layout(name, tuple(present), named, intensities, mask, (note, *named.warnings))


def _expect_count(source: Path, present: list[Path], count: int) -> None:
    if len(present) != count:
        what = f"expected {count} photographs, one a light, found {len(present)}"
        remedy = "Move other pictures away, or name the photographs in the lights file"
        refuse("photographs-count", str(source), what, remedy=remedy)
