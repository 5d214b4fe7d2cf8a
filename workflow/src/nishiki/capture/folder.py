"""A capture folder as one frozen value: the description of a plane, and how folders of every geometry are read."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import model_validator

from nishiki.artifacts.declaration import Closed
from nishiki.capture.frames import DIALECTS, BaseCapture, Frame, exposure_problems, inside, lamp_problems, read_frames
from nishiki.capture.goniometer import GoniometerCapture, GoniometerFile, examine_goniometer
from nishiki.capture.lights import Lights, direction_problems, read_lights
from nishiki.capture.mosaic import MosaicCapture, examine_mosaic, is_mosaic
from nishiki.capture.schema import Count, Positive, Session, read_mapping, validate
from nishiki.capture.tables import Curves, read_curves
from nishiki.capture.turntable import TurntableCapture, TurntableFile, examine_turntable
from nishiki.colour.colour import ILLUMINANTS
from nishiki.errors import require
from nishiki.formats.files import bound, leads_out
from nishiki.formats.problems import WHERE_IS_IT, CaptureError, Problem, error, raise_errors, refuse, warning
from nishiki.formats.text_tables import expect_rows, number_of, reading, table_rows

LOST_BY_FIT = (
    "cast shadows and highlights are as smooth as that fit made them, what it left over is gone, its coefficients have "
    "8 bits, and neither the scale of brightness nor the strengths and distances of the lamps are known"
)
"""Information missing from a capture whose pictures were rendered from a relightable image."""


class LightsFile(Closed):
    """Lamp positions or directions, from a lights file."""

    file: str
    kind: Literal["direction", "position_mm"] = "direction"
    intensities: str | None = None
    axes_confirmed: bool = False  # by the user, so that undecided axes are not warned about


class CaptureFile(Session):
    """capture.yaml of a plane."""

    lights: LightsFile
    geometry: Literal["plane", "turntable", "goniometer"] = "plane"
    pixel_pitch_mm: Positive | None = None
    region_of_interest: tuple[Count, Count, Count, Count] | None = None
    mask: str | None = None
    regions: str | None = None
    rendered_from: str | None = None

    @model_validator(mode="after")
    def _pitch_for_positions(self) -> "CaptureFile":
        if self.lights.kind == "position_mm" and self.pixel_pitch_mm is None:
            raise ValueError("lights of kind position_mm need pixel_pitch_mm (millimetres a pixel on the object)")
        return self


MIRROR_BALLS = "mirror_balls.png"
"""Picture in a capture whose lamps were measured on mirror balls, in the axes of the photographs."""

T = TypeVar("T")


@dataclass(frozen=True)
class Capture(BaseCapture):
    """A flat object under many lamps."""

    lights: Lights  # all lamps of the lights file
    intensities: np.ndarray | None  # (lights, channels) float64 or None
    mask: Path | None
    regions: Path | None
    warnings: tuple[Problem, ...]  # what was tolerated

    @property
    def observed(self) -> tuple[Frame, ...]:
        """Frames of the object (sample and check), in the order of the table: one a light."""
        return tuple(f for f in self.frames if f.role in ("sample", "check"))

    @property
    def directions(self) -> np.ndarray:
        """(observed, 3) float64: unit direction of each observed frame's lamp."""
        return self.lights.directions[[self.lights.index(f.light) for f in self.observed]]

    def white_of(self, light: str) -> Frame | None:
        """Return the white board's frame under this light."""
        place = self.lights.find(light)
        return next((f for f in self.frames_of("white") if self.lights.find(f.light) == place), None)


def payload_of(root: Path) -> Path:
    """Find the folder that holds capture.yaml: root, or root/data.

    Raises CaptureError: folder-missing, folder-empty, capture-missing, outside-folder, seal-interrupted.
    """
    if not root.is_dir():
        half = root.with_name(root.name + ".sealing")
        if (half / "data").is_dir():
            remedy = "Run seal again on the same name: it completes the sealing; nothing is lost"
            what = "sealing was interrupted"
            refuse("seal-interrupted", str(root), what, found=half.name, remedy=remedy)
        refuse("folder-missing", str(root), "no such capture folder", remedy=WHERE_IS_IT)
    for payload in (root / "data", root):
        description = payload / "capture.yaml"
        if description.is_file():
            if leads_out(description, root):
                what = f"link out of the folder, to {description.resolve()}: copy the file itself"
                refuse("outside-folder", str(description), what)
            return payload
    if not any(root.iterdir()):
        refuse("folder-empty", str(root), "capture folder is empty")
    refuse("capture-missing", str(root), "folder holds no capture.yaml", remedy=WHERE_IS_IT)


AnyCapture = Capture | TurntableCapture | GoniometerCapture | MosaicCapture


def load_capture(root: Path | str) -> AnyCapture:
    """Read and check the tables of a capture folder; no photograph is opened.

    Parameters
    ----------
    root : str or Path
        Capture folder, sealed or not: the folder that holds `capture.yaml`, or the one above its `data`.

    Returns
    -------
    Capture, TurntableCapture, GoniometerCapture or MosaicCapture
        By its geometry, `plane`, `turntable`, `goniometer` or `mosaic`. A mosaic has `fields` and their `captures`; the
        others have `settings` (the checked `capture.yaml`), `frames` (name, role and lamp of each photograph) and
        `warnings`; a plane also has `lights` and `directions`, a (photographs, 3) float64 ndarray of unit vectors to
        the lamps, x right, y up, z towards the camera.

    Raises
    ------
    nishiki.formats.problems.CaptureError
        A `UserError` that lists every error found in the tables, not only the first.

    References
    ----------
    The folder's format: "Capture folders" in the documentation. Sealed folders: J. Kunze and others (2018), The BagIt
    File Packaging Format, RFC 8493.

    Examples
    --------
    >>> import nishiki
    >>> capture = nishiki.read_capture("captures/painting")
    >>> capture.geometry
    'plane'
    >>> len(capture.observed), capture.directions.shape
    (5, (5, 3))
    >>> [frame.role for frame in capture.observed]
    ['sample', 'sample', 'sample', 'sample', 'check']
    """
    capture, problems = examine(Path(root))
    raise_errors(problems)
    assert capture is not None  # without one there are errors
    return capture


def examine(root: Path) -> tuple[AnyCapture | None, list[Problem]]:
    """Read the capture (None where its tables cannot be read) and list everything wrong in its tables."""
    if is_mosaic(root):
        return examine_mosaic(root, examine)
    problems: list[Problem] = []

    def attempt(read: Callable[[], T]) -> T | None:
        try:
            return read()
        except CaptureError as e:
            problems.extend(e.problems)
            return None

    payload = attempt(lambda: payload_of(root))
    if payload is None:
        return None, problems
    parsed = attempt(lambda: read_mapping(payload / "capture.yaml"))
    if parsed is None:
        return None, problems
    geometry = parsed.get("geometry", "plane")
    models: dict[Any, type[Any]] = {"turntable": TurntableFile, "goniometer": GoniometerFile}
    settings = attempt(lambda: validate(models.get(geometry, CaptureFile), parsed, "capture.yaml"))
    listed = not (isinstance(settings, GoniometerFile) and settings.goniometer.table)  # a table has no photographs
    frames: tuple[Frame, ...] | None = ()
    if listed:
        table = payload / "frames.csv"
        if table.is_symlink():  # it must lie in the folder itself
            table = attempt(lambda: inside(payload, "frames.csv", "capture folder"))
        known = table and geometry in tuple(DIALECTS)
        frames = attempt(lambda: read_frames(require(table), geometry=geometry)) if known else None
    if settings is None:
        return None, problems

    def resolve(file: str | None, key: str) -> Path | None:
        return attempt(lambda: inside(payload, file, f"capture.yaml {key}")) if file else None

    curves = resolve(settings.camera.sensitivities, "camera.sensitivities")
    names = settings.camera.channels
    label = settings.camera.sensitivities
    sensitivities = attempt(lambda: read_curves(curves, names=names, label=label)) if curves else None
    illuminant = _illuminant(settings, resolve, attempt)
    if isinstance(settings, TurntableFile | GoniometerFile):
        read = BaseCapture(root, payload, settings, frames or (), sensitivities, illuminant)
        further = examine_turntable if settings.geometry == "turntable" else examine_goniometer
        capture, remarks = further(read, frames is not None, attempt)
        return capture, problems + remarks
    lights_path, kind = resolve(settings.lights.file, "lights.file"), settings.lights.kind
    lights = attempt(lambda: read_lights(lights_path, kind=kind)) if lights_path else None
    mask, regions = resolve(settings.mask, "mask"), resolve(settings.regions, "regions")
    scales = resolve(settings.lights.intensities, "lights.intensities")
    if resolve(settings.rendered_from, "rendered_from"):
        what = f"these pictures are no photographs: they were rendered from {settings.rendered_from}; {LOST_BY_FIT}"
        problems.append(warning("rendered", "capture.yaml", what))
    if lights is None or frames is None:
        return None, problems
    intensities = attempt(lambda: read_intensities(scales, lights, names)) if scales else None
    problems += match_frames(frames, lights, settings)
    doubts = tuple(p for p in (*problems, *lights.warnings) if p.severity == "warning")
    common = (root, payload, settings, frames, sensitivities, illuminant)
    return Capture(*common, lights, intensities, mask, regions, doubts), problems + list(lights.warnings)


def _illuminant(settings: Session, named: Callable, attempt: Callable) -> Curves | str | None:
    """Read the name of a CIE illuminant, or a curve from the file: one, or that of each channel's lamp."""
    value = settings.illuminant
    if value is None or value in ILLUMINANTS:
        return value
    if "." not in value and "/" not in value:
        where, expected = "capture.yaml illuminant", f"a CSV file or one of {', '.join(ILLUMINANTS)}"
        return attempt(lambda: refuse("illuminant-unknown", where, "unknown", expected=expected, found=value))
    path = named(value, "illuminant")
    curves = attempt(lambda: read_curves(path, label=value)) if path else None
    if curves is None or len(curves.names) == 1:
        return curves
    return attempt(lambda: read_curves(require(path), names=settings.camera.channels, label=value))


def read_intensities(path: Path, lights: Lights, channels: tuple[str, ...]) -> np.ndarray:
    """Read the radiometric scale (lights, channels) float64 > 0 from a table with columns light and the channels.

    Raises CaptureError (kinds intensities-unreadable, intensities-many, intensities-invalid, intensities-light).
    """
    with reading(path.name, "intensities"):
        names, *rows = [cells for _, cells in islice(table_rows(path, path.name), bound("lights") + 2)] or [[]]
    expect_rows(len(rows), "lights", path.name, "intensities")
    if sorted(names) != sorted(("light", *channels)):
        what = f"expected the columns light,{','.join(channels)}, found {','.join(names)[:80]}"
        refuse("intensities-unreadable", path.name, what)
    table = np.full((len(lights.names), len(channels)), np.nan)
    problems = []
    for number, cells in enumerate(rows, start=2):
        row, where = dict(zip(names, cells, strict=False)), f"{path.name} row {number}"
        light = row.get("light", "")
        place = lights.find(light)
        if place is None:
            problems.append(error("intensities-light", where, f"no light '{light}'"))
            continue
        table[place] = [number_of(row.get(channel, "")) for channel in channels]
        if not all(0 < v < math.inf for v in table[place]):
            problems.append(error("intensities-invalid", where, "expected numbers above 0"))
    missing = [lights.names[i] for i in np.flatnonzero(np.isnan(table).any(axis=1))]
    if missing and not problems:
        problems.append(error("intensities-light", path.name, f"no intensity for light {', '.join(missing[:5])}"))
    raise_errors(problems)
    return table


def match_frames(frames: tuple[Frame, ...], lights: Lights, settings: CaptureFile) -> list[Problem]:
    """Check that frames and lights belong together, and that the sample's lights determine normals."""
    problems = lamp_problems(frames, lights, settings.lights.file)
    problems += _band_problems(frames, settings.camera.channels)
    observed = [f for f in frames if f.role in ("sample", "check")]
    whites = [f for f in frames if f.role == "white"]
    seen, boards = (Counter(lights.find(f.light) for f in group) for group in (observed, whites))
    for place, name in enumerate(lights.names):
        for count, role in ((seen[place], "sample or check"), (boards[place], "white")):
            if count > 1:
                what = f"expected one {role} frame under light '{name}', found {count}"
                problems.append(error("light-repeated", "frames.csv", what))
        if whites and seen[place] and boards[place] == 0:
            remedy = "Photograph the board under every light, or list no white frames at all"
            problems.append(error("white-missing", "frames.csv", f"light '{name}' has no white frame", remedy=remedy))
    problems += exposure_problems(frames)
    if whites and settings.lights.intensities:
        what = "white frames are used; lights.intensities is not"
        problems.append(warning("intensities-unused", "capture.yaml", what))
    places = (lights.find(f.light) for f in frames if f.role == "sample")
    samples = [place for place in places if place is not None]
    return problems + direction_problems(lights.directions[samples], settings.lights.file)


def _band_problems(frames: tuple[Frame, ...], channels: tuple[str, ...]) -> list[Problem]:
    """Check that photographs with a file for each band have one for each of camera.channels."""
    problems = []
    for frame in frames:
        listed = {channel for part in frame.bands for channel in part.channels}
        where = f"frames.csv row {frame.row}"
        of = f"{frame.role} frame" + (f" of light '{frame.light}'" * bool(frame.light))
        if listed and listed < set(channels):
            lacking = ", ".join(name for name in channels if name not in listed)
            problems.append(error("band-missing", where, f"{of} has no row for the band {lacking}"))
        elif listed - set(channels):
            what = f"{of} has a band that is not one of camera.channels: {', '.join(sorted(listed - set(channels)))}"
            problems.append(error("band-unknown", where, what))
    return problems
