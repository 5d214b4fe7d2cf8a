"""Convert relightable images (`.ptm`, `.rti`, folders of relight) to captures of pictures rendered from them.

Unless the user names them, the lamps are ours: RINGS around the normal, within what domes cover and where a fit
interpolates. Of several that were tried on photographs these give the best normals (docs/notes/imports.md).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.capture.folder import LOST_BY_FIT
from nishiki.capture.layout_writers import write_tables
from nishiki.capture.layouts import RELIGHTABLE as SUFFIXES
from nishiki.capture.layouts import photographs_in, state_lights
from nishiki.capture.lights import Lights, lights_from_vectors
from nishiki.capture.options import NO_PHOTOGRAPHS, ConvertOptions, file_problems
from nishiki.capture.schema import FORMAT
from nishiki.capture.taking import take, take_mask
from nishiki.formats.banded_pictures import png_bytes
from nishiki.formats.coding import RGB
from nishiki.formats.files import Refused, expect_memory, files_with
from nishiki.formats.legacy_rti import HshFile, PtmFile, open_hsh, open_ptm
from nishiki.formats.problems import CaptureError, Problem, expect_one, raise_errors, warning
from nishiki.formats.relight import INFO, RelightFolder, is_relight_folder, open_relight
from nishiki.formats.relight_planes import WEB_INFO, is_web_rti, open_web_rti
from nishiki.formats.text_tables import refusal

RINGS = ((20, 6), (35, 9), (50, 9))  # degrees from the normal, lamps
BYTES_A_PIXEL = 36  # of memory, for a picture that is rendered and coded
RELIGHT = "relight"  # folder of a capture that keeps the files of a relight folder
RelightableImage = PtmFile | HshFile | RelightFolder
LEAST_CLIPPED = 1e-4  # share of a picture's values below which clipping is not worth a warning


@dataclass(frozen=True)
class RelightableRendering:
    """A relightable image, and the lamps under which pictures are rendered from it."""

    file: Path
    image: RelightableImage
    lights: Lights
    warnings: tuple[Problem, ...] = ()
    geometry = "plane"
    channels: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the converted image."""
        return f"rendered from {self.file.name}"

    @property
    def count(self) -> int:
        """Number of the pictures to render."""
        return len(self.lights.names)

    @property
    def parts(self) -> str:
        """Image and lamps in words."""
        return f"no photographs; {self.count} are rendered"


def recognise_relightable(source: Path, options: ConvertOptions | None = None) -> Path | None:
    """Find the relightable image that the source is, or the only one in this folder without photographs.

    A source is a file or a folder of relight; None without.

    Raises CaptureError (layout-unknown) where a folder holds several.
    """
    if source.is_file() and source.name in (INFO, WEB_INFO) and _is_folder_image(source.parent):
        return source.parent.resolve()
    if source.is_file():
        return source if source.suffix.lower() in SUFFIXES else None
    if not source.is_dir() or photographs_in(source):
        return None
    if _is_folder_image(source):
        return source.resolve()
    files = files_with(source, SUFFIXES)
    return expect_one(files, source, "several relightable images", f"Convert one: {next(iter(files), '')}")


def _is_folder_image(folder: Path) -> bool:
    return is_relight_folder(folder) or is_web_rti(folder)


def read_relightable(source: Path, file: Path, options: ConvertOptions) -> RelightableRendering:
    """Choose the lamps for rendering the image. CaptureError where its format is not supported."""
    options.refuse(NO_PHOTOGRAPHS, "white", "dark", "ambient", "checks", "lights_order", "lights_axes")
    raise_errors(file_problems(mask=options.mask))
    return RelightableRendering(file, open_relightable(file), lamps_for(options.lights_file, options))


def open_relightable(path: Path) -> RelightableImage:
    """Open the image in a file, or in a folder of relight or webRTIViewer. CaptureError: relightable-unreadable."""
    try:
        if path.is_dir():
            image = open_relight(path) if is_relight_folder(path) else open_web_rti(path)
        else:
            image = open_hsh(path) if path.suffix.lower() == ".rti" else open_ptm(path)
        expect_memory(BYTES_A_PIXEL * image.shape[0] * image.shape[1], path.name)
    except Refused as e:
        raise CaptureError(refusal(e, "relightable-unreadable")) from e
    return image


def lamps_for(lights_file: Path | None, options: ConvertOptions | None = None) -> Lights:
    """Read the lamps of a file, or return those of RINGS, named by polar angle and azimuth in degrees."""
    if lights_file is not None:
        return state_lights(lights_file.parent, lights_file, options or ConvertOptions()).lights
    names, vectors = [], []
    for ring, (polar, count) in enumerate(RINGS):
        for step in range(count):
            azimuth = 360 * (step + 0.5 * (ring % 2)) / count
            z, turn = np.cos(np.radians(polar)), np.radians(azimuth)
            names.append(f"polar{polar:02d}_azimuth{azimuth:03.0f}")
            vectors.append((np.cos(turn) * np.sqrt(1 - z * z), np.sin(turn) * np.sqrt(1 - z * z), z))
    return lights_from_vectors(names, np.array(vectors), file="rendered lamps")


def write_rendering(folder: Path, layout: RelightableRendering, source: Path, options: ConvertOptions) -> list[Problem]:
    """Render into a new folder, and include the file itself; return notes for the user."""
    file, lights = layout.file, layout.lights
    image = layout.image
    folder.mkdir(parents=True)
    files = [f"frames/{name}.png" for name in lights.names]
    clipped = [_render(image, light, folder / name) for name, light in zip(files, lights.directions, strict=True)]
    rows = [{"file": name, "role": "sample", "light": light} for name, light in zip(files, lights.names, strict=True)]
    polar = np.degrees(np.arccos(lights.directions[:, 2]))
    what = f"{image.layout} {file.name}" if file.is_dir() else f"{image.layout} file {file.name}"
    angles = f"{polar.min():.0f} to {polar.max():.0f} degrees from the normal"
    about = f"rendered from the {what} under {len(rows)} lamps {angles}"
    if image.files:
        inside = RELIGHT if isinstance(image, RelightFolder) else "webrti"
        for name in image.files:
            take(file / name, folder / inside / name, options.link)
        rendered_from = f"{inside}/{image.files[0]}"
    else:
        rendered_from = take(file, folder / file.name, options.link)
    settings = {
        "format": FORMAT,
        "title": options.title or (file.name if file.is_dir() else file.stem),
        "notes": f"These pictures are no photographs. They were {about}; {LOST_BY_FIT}.",
        "geometry": "plane",
        "camera": {"channels": list(RGB), "encoding": options.encoding or "srgb"},
        "lights": {"file": "lights.lp", "kind": "direction"},
        "rendered_from": rendered_from,
    }
    doubts: list[Problem] = []
    pitch = options.width_mm / image.shape[1] if options.width_mm else getattr(image, "pitch_mm", 0.0)
    settings |= {"pixel_pitch_mm": float(f"{pitch:.9g}")} if pitch else {}
    if options.mask is not None:
        place = folder / f"mask{options.mask.suffix.lower()}"
        settings["mask"], doubts = take_mask(options.mask, place, options.link)
    if options.region is not None:
        settings["region_of_interest"] = list(options.region)
    write_tables(folder, settings, rows, lights)
    remedy = "Convert the photographs that it was made from, if they exist"
    rendered = warning("rendered", file.name, f"pictures were {about}; {LOST_BY_FIT}", remedy=remedy)
    notes = [rendered, *lights.warnings, *doubts]
    if max(clipped) >= LEAST_CLIPPED:
        what, found = "values beyond black and full brightness were clipped", f"{100 * np.mean(clipped):.2g} % of all"
        notes.append(warning("rendered-clipped", file.name, what, found=found))
    return notes


def _render(image: RelightableImage, light: np.ndarray, path: Path) -> float:
    """Write one picture as PNG of 16 bits; return the share of clipped values."""
    path.parent.mkdir(exist_ok=True)
    values = image.relight(light)
    codes = np.rint(65535 * np.clip(values, 0, 1)).astype(np.uint16)
    path.write_bytes(png_bytes(codes, level=1))
    return float(np.mean((values < 0) | (values > 1)))
