"""Describe what was found on mirror balls, and draw it into a photograph."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from nishiki.capture.spheres.optics import Highlight, SphereCamera, outline_points
from nishiki.capture.spheres.outline import Circle, Outline
from nishiki.capture.taking import channel_names, full_scale_of, read_grey
from nishiki.errors import UserError
from nishiki.formats.images import read_codes, read_header
from nishiki.threads import in_threads

MARGIN = 1.65  # of the radius: half the side of the crop around a sphere
LEAST_LAMPS = 4  # that must be measured

Crop = tuple[tuple[slice, slice], np.ndarray]
"""Rows and columns of the photographs, and their light there (n, rows, columns)."""


@dataclass(frozen=True)
class SphereInput:
    """What is given of the spheres."""

    photographs: Sequence[Path]  # one a lamp
    # sequence of (row, column, radius): circles in pixels to a quarter of the radius; empty: spheres are searched
    seeds: Sequence[tuple[float, float, float]] = ()
    mask: Path | None = None  # picture that is non-zero on the spheres
    count: int | None = None  # number of spheres that must be found; None: as many as there are
    # focal length in pixels; infinite: seen from afar; None: from Exif or the agreement of the spheres
    focal_px: float | None = None
    radius_mm: float | None = None  # of every sphere
    object_height_mm: float = 0.0  # of the object's surface above the plane on which the spheres lie
    board: Sequence[Path] = ()  # photographs of a flat board in the object's plane, one a lamp in the same order
    compare: Path | None = None  # a lights file


@dataclass
class Findings:
    """What the photographs show so far; filled step by step, so that a failure can be drawn."""

    mean: np.ndarray  # (rows, columns) float32: of all photographs, reduced, and the brightest of them
    brightest: np.ndarray  # (rows, columns) float32
    factor: float  # pixels of a photograph in a pixel of these
    camera: SphereCamera
    outlines: list[Outline] = field(default_factory=list)  # one a sphere
    # list of (picture, (column, row)): brightest of all photographs around each sphere, and the crop's corner
    crops: list[tuple[np.ndarray, tuple[int, int]]] = field(default_factory=list)
    # by (photograph, sphere); None where there is none
    highlights: dict[tuple[int, int], Highlight | None] = field(default_factory=dict)
    # list of (Circle, str): circles that were examined and why they are no mirror spheres
    rejected: list[tuple[Circle, str]] = field(default_factory=list)
    # reason by the name of each photograph whose lamp cannot be measured
    left_out: dict[str, str] = field(default_factory=dict)


class SpheresError(UserError):
    """No lamps could be measured; `findings` tell how far it came."""

    def __init__(self, text: str, findings: Findings) -> None:
        super().__init__(text)
        self.findings = findings


def read_light(path: Path) -> np.ndarray:
    """Read the light (rows, columns) float32 of a photograph, 1 at full scale; of a JPEG, the square of its codes."""
    header = read_header(path)
    if header.kind != "jpeg":
        return read_grey(path) / np.float32(full_scale_of(path))
    light = read_codes(path, channel_names(header), header=header, luma=True)[..., 0] / np.float32(255)
    return light * light


def crop_around(circle: Sequence[float], shape: tuple[int, int]) -> tuple[slice, slice]:
    """Compute the rows and columns of the crop that holds a circle (column, row, radius) and its surroundings."""
    column, row, radius = circle[:3]
    reach = MARGIN * radius
    return (
        slice(max(0, int(row - reach)), min(shape[0], int(row + reach) + 2)),
        slice(max(0, int(column - reach)), min(shape[1], int(column + reach) + 2)),
    )


def cut_crop(crop: tuple[slice, slice], read: list[Crop]) -> np.ndarray | None:
    """Cut a crop (n, rows, columns) from one of those that were read; None where none contains it."""
    for outer, stack in read:
        if all(o.start <= c.start and c.stop <= o.stop for o, c in zip(outer, crop, strict=True)):
            rows, columns = (slice(c.start - o.start, c.stop - o.start) for o, c in zip(outer, crop, strict=True))
            return stack[:, rows, columns]
    return None


def corner_of(crop: tuple[slice, slice]) -> tuple[int, int]:
    """Return the column and the row of a crop's first pixel."""
    return crop[1].start, crop[0].start


def read_crops(photographs: Sequence[Path], crops: Sequence[tuple[slice, slice]]) -> list[np.ndarray]:
    """Read each photograph once, and cut the light (n, rows, columns) float32 of all photographs in each crop."""

    def cut(path: Path) -> list[np.ndarray]:
        light = read_light(path)
        return [light[crop].copy() for crop in crops]

    cuts = list(in_threads(cut, photographs, 2))
    return [np.array([each[k] for each in cuts]) for k in range(len(crops))]


WIDEST = 1200  # pixels, of the picture on the page
GREEN, RED, GREY = (90, 220, 90), (255, 90, 40), (150, 150, 150)


def draw_findings(findings: Findings) -> np.ndarray:
    """Draw the brightest of all photographs (rows, columns, 3) uint8, reduced.

    Green: outlines of spheres, with their numbers; red: highlights; grey: examined circles that are none.
    """
    import cv2

    scale = min(1.0, WIDEST / max(findings.brightest.shape))
    codes = cv2.resize(display_codes(findings.brightest), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    factor = scale / findings.factor

    def place(points: np.ndarray) -> np.ndarray:
        return np.round(((points + 0.5) * factor - 0.5) * 16).astype(np.int32)

    for circle, _ in findings.rejected:
        rim = outline_points(np.array(circle[:3]), SphereCamera.of(*findings.brightest.shape))
        cv2.polylines(codes, [place(rim).reshape(-1, 1, 2)], True, GREY, 1, cv2.LINE_AA, 4)
    for k, outline in enumerate(findings.outlines):
        rim = outline_points(outline.parameters, findings.camera)
        cv2.polylines(codes, [place(rim).reshape(-1, 1, 2)], True, GREEN, 1, cv2.LINE_AA, 4)
        corner = tuple(int(v) for v in place(rim.max(axis=0)) // 16)
        cv2.putText(codes, str(k + 1), corner, cv2.FONT_HERSHEY_SIMPLEX, 0.5, GREEN, 1, cv2.LINE_AA)
    for highlight in findings.highlights.values():
        if highlight is not None:
            cv2.drawMarker(codes, tuple(int(v) for v in place(highlight.pixel) // 16), RED, cv2.MARKER_CROSS, 5, 1)
    return codes


def draw_sphere(findings: Findings, sphere: int, side: int = 480) -> np.ndarray:
    """Draw the brightest of all photographs around one sphere, with its outline and highlights: (.., .., 3) uint8."""
    import cv2

    brightest, corner = findings.crops[sphere]
    zoom = max(1, int(np.ceil(side / max(brightest.shape))))
    codes = cv2.resize(display_codes(brightest), None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)

    def place(points: np.ndarray) -> np.ndarray:
        return np.round(((np.atleast_2d(points) - corner + 0.5) * zoom - 0.5) * 16).astype(np.int32)

    curve = place(outline_points(findings.outlines[sphere].parameters, findings.camera))
    cv2.polylines(codes, [curve.reshape(-1, 1, 2)], True, GREEN, 1, cv2.LINE_AA, 4)
    for (_, k), highlight in findings.highlights.items():
        if k == sphere and highlight is not None:
            column, row = place(highlight.pixel)[0]
            cv2.drawMarker(codes, (int(column / 16), int(row / 16)), RED, cv2.MARKER_CROSS, 9, 1)
    return codes


def display_codes(light: np.ndarray) -> np.ndarray:
    """Convert light to grey codes (rows, columns, 3) uint8, brightened by a square root."""
    top = float(np.percentile(light, 99.8)) or 1.0
    return np.repeat((255 * np.sqrt(np.clip(light / top, 0, 1))).astype(np.uint8)[..., None], 3, axis=2)
