"""Photographs whose cameras another program found: their files, lenses and poses, and the files of COLMAP.

COLMAP: `cameras` and `images`, as text or binary.
"""

import math
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from nishiki.capture.tables import LENS_COLUMNS, Intrinsics
from nishiki.errors import require
from nishiki.formats.files import bound, read_bytes, same_name, walk
from nishiki.formats.images import read_header
from nishiki.formats.picture_files import IMAGE_SUFFIXES
from nishiki.formats.problems import CaptureError, Problem, error, raise_errors, refuse, warning
from nishiki.formats.text_tables import expect_rows, reading
from nishiki.geometry.camera import Camera, point_in_sight

CORNER = 0.5  # pixels that count from the corner of the top left one, where ours count from its centre
GL = np.diag([1.0, -1.0, -1.0])  # camera axes of OpenGL (y up, looking along -z) to ours (y down, looking along z)
FEWEST_AXES = 3  # views whose lines of sight tell together where they look
BROKEN = (struct.error, ElementTree.ParseError)  # what readers of binary files and of XML raise
UNDISTORT = "Take the distortion out of the photographs (colmap image_undistorter), and convert what that writes"
NEAR = 0.5  # root mean square distance of the lines of sight from one point, relative to the cameras' distance


@dataclass(frozen=True)
class RegisteredView:
    """A photograph with its camera.

    Name of the file as the program knows it, size in pixels, projection matrix (3, 4) float64 without distortion, lens.

    The matrix and the lens count pixels from the centre of the first one.
    """

    name: str
    rows: int
    columns: int
    matrix: np.ndarray
    lens: Intrinsics

    @classmethod
    def of(cls, name: str, size: tuple[int, int], lens: Intrinsics, pose: np.ndarray) -> "RegisteredView":
        """Make a view. size: rows, columns; pose: (3, 4) from world to camera."""
        return cls(name, *size, np.array(lens.as_dict()["matrix"]) @ pose, lens)


@dataclass(frozen=True)
class Registration:
    """Content of a program's file of cameras: the photographs with a camera, and notes for the user."""

    views: tuple[RegisteredView, ...]
    notes: tuple[Problem, ...] = ()


@dataclass(frozen=True)
class PictureIndex:
    """Index of the pictures below a folder, by the paths that other programs give them."""

    folder: Path

    @cached_property
    def _listed(self) -> list[tuple[tuple[str, ...], Path]]:
        """Parts of each picture's path, for comparison, and the path, without hidden files."""
        names = (name for name, _ in walk(self.folder) if not any(p.startswith(".") for p in name.split("/")))
        pictures = (name for name in names if Path(name).suffix.lower() in IMAGE_SUFFIXES)
        return [(tuple(map(same_name, name.split("/"))), self.folder / name) for name in pictures]

    def find(self, name: str) -> Path | None:
        """Find the picture whose path ends most like this one, `images` and the folder itself first; None without.

        Both slashes separate folders, and the suffix may be missing. CaptureError (photograph-ambiguous) where several
        pictures fit equally.
        """
        asked = [same_name(part) for part in re.split(r"[\\/]+", name) if part not in ("", ".", "..")]
        fits: dict[tuple[bool, int], list[Path]] = {}
        for parts, path in self._listed if asked else ():
            whole = parts[-1] == asked[-1]
            if whole or same_name(path.stem) in (asked[-1], same_name(Path(asked[-1]).stem)):
                pairs = list(zip(parts[-2::-1], asked[-2::-1], strict=False))
                alike = next((i for i, (ours, theirs) in enumerate(pairs) if ours != theirs), len(pairs))
                fits.setdefault((whole, alike), []).append(path)
        best = fits[max(fits)] if fits else []
        for place in (self.folder / "images", self.folder):
            best = [path for path in best if path.parent == place] or best
        if len(best) > 1:
            found = ", ".join(str(path.relative_to(self.folder)) for path in best[:3])
            what = f"several pictures may be the photograph '{name}': move the others out of the folder"
            refuse("photograph-ambiguous", str(self.folder), what, found=found)
        return best[0] if best else None

    def paths(self, names: Sequence[str], file: str) -> list[Path]:
        """Find the picture of each name. CaptureError (photograph-missing) with every missing one."""
        found = {name: self.find(name) for name in names}
        raise_errors(
            error("photograph-missing", file, f"no photograph '{name}' in {self.folder.name}")
            for name, path in found.items()
            if path is None
        )
        return [require(found[name]) for name in names]

    def size(self, name: str, file: str) -> tuple[int, int]:
        """Read rows and columns of a photograph. CaptureError as `paths`, and those of reading a header."""
        header = read_header(self.paths([name], file)[0])
        return header.rows, header.columns


@contextmanager
def reading_cameras(name: str, program: str, remedy: str) -> Iterator[None]:
    """Convert errors of reading a program's cameras to cameras-missing and cameras-unreadable."""
    try:
        with reading(name, "cameras"):
            yield
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, *BROKEN) as e:
        found = f"without {e}" if isinstance(e, KeyError) else str(e)[:120]
        what = f"not cameras as {program} writes them"
        raise CaptureError(error("cameras-unreadable", name, what, found=found, remedy=remedy)) from e


def aims_at(poses: np.ndarray) -> float | None:
    """Measure how closely the lines of sight meet.

    Distance from the point nearest to all of them, root mean square, over the cameras' median distance from it;
    infinite unless the point is in front of nearly all cameras; None where nothing can be told.

    poses (n, 3, 4): from world to camera, looking along z. Photographs of an object look at it from around it.
    """
    point = point_in_sight([Camera("", np.eye(3), pose[:, :3], pose[:, 3], 1, 1) for pose in poses])
    if point is None or len(poses) < FEWEST_AXES:
        return None
    x, y, depth = (poses @ [*point, 1.0]).T
    return float(np.sqrt((x**2 + y**2).mean()) / np.median(depth)) if (depth > 0).mean() > 0.9 else math.inf


def aim_problems(poses: np.ndarray, file: str) -> list[Problem]:
    """List cameras-outward where the cameras do not face one common place, as they do around an object."""
    aim = aims_at(poses)
    if aim is None or aim < NEAR:
        return []
    what = "the cameras do not look at one object: their lines of sight meet nowhere in front of them"
    remedy = "If they stand around the object, the file has other axes than such files have: write it again"
    return [warning("cameras-outward", file, what, remedy=remedy)]


def rigid(rotation: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) freed of its scale. ValueError where it is none: sheared, mirrored, or not finite."""
    scale = np.cbrt(np.linalg.det(rotation)) if np.isfinite(rotation).all() else 0.0
    turned = rotation / scale if scale > 0 else np.zeros((3, 3))
    if np.abs(turned @ turned.T - np.eye(3)).max() > 1e-3:
        raise ValueError("a rotation that is none: its axes are mirrored, or not at right angles")
    return turned


def finite(value: object) -> float:
    """Parse a number, also written as text. ValueError unless it is finite."""
    if isinstance(value, bool) or not isinstance(value, str | int | float) or not math.isfinite(float(value)):
        raise ValueError(f"'{str(value)[:40]}' where a number is expected")
    return float(value)


def positive(value: object, name: str) -> float:
    """Parse a number above 0. ValueError where it is none."""
    number = finite(value)
    if number <= 0:
        raise ValueError(f"{name} {number:g}, which must be above 0")
    return number


def whole(value: object) -> int:
    """Parse a whole number. ValueError where it is none."""
    if not finite(value).is_integer():
        raise ValueError(f"'{str(value)[:40]}' where a whole number is expected")
    return int(finite(value))


PLACES = (".", "sparse", "sparse/0")
KINDS = (".txt", ".bin")
COLMAP_REMEDY = "Export the model again, as text or binary"
# Name, number of parameters, and how many of these come before the distortion, by COLMAP's number of the model; 0 where
# the model is none of Brown's, as are all of larger numbers. The distortion begins with k1, k2, p1, p2, k3 of Brown's
# model as far as it goes; what follows is another model's.
MODELS = (
    ("SIMPLE_PINHOLE", 3, 3),
    ("PINHOLE", 4, 4),
    ("SIMPLE_RADIAL", 4, 3),
    ("RADIAL", 5, 3),
    ("OPENCV", 8, 4),
    ("OPENCV_FISHEYE", 8, 0),
    ("FULL_OPENCV", 12, 4),
)
NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?(nan|inf)", re.IGNORECASE)
HEADING = re.compile(rb"Number of images:\s*([0-9]{1,9})")


SizedLens = tuple[tuple[int, int], Intrinsics]
"""Rows, columns and lens."""
Image = tuple[str, int, tuple[float, ...]]
"""Name, number of the camera, and the pose: w, x, y, z of the rotation from world to camera, then the translation."""


def colmap_folder(source: Path) -> Path | None:
    """Find the reconstruction of a folder of photographs: in it, in `sparse` or in `sparse/0`; None without."""
    for place in PLACES:
        if any(all((source / place / f"{part}{kind}").is_file() for part in ("cameras", "images")) for kind in KINDS):
            return source / place
    return None


def read_colmap(folder: Path, pictures: PictureIndex | None = None) -> Registration:
    """Read the registered photographs.

    Raises CaptureError: cameras-unreadable, cameras-many; cameras-distorted where a lens cannot be said by Brown's five
    numbers.
    """
    kind = ".bin" if (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file() else ".txt"
    file, notes = f"images{kind}", []
    with reading_cameras(f"cameras{kind}", "COLMAP", COLMAP_REMEDY):
        content = read_bytes(folder / f"cameras{kind}", "table_bytes")
        cameras = _text_cameras(content) if kind == ".txt" else _binary_cameras(content)
    with reading_cameras(file, "COLMAP", COLMAP_REMEDY):
        content = read_bytes(folder / file, "table_bytes")
        images = _text_images(content, notes) if kind == ".txt" else _binary_images(content)
    expect_rows(len(images), "views", file, "cameras")
    return Registration(tuple(_view(image, cameras, file) for image in images), tuple(notes))


def _view(image: Image, cameras: dict[int, SizedLens], file: str) -> RegisteredView:
    from scipy.spatial.transform import Rotation

    name, camera, numbers = image
    if camera not in cameras:
        refuse("cameras-unreadable", file, f"the photograph '{name}' names the camera {camera}, which is not there")
    if not np.isfinite(numbers).all() or not any(numbers[:4]):
        refuse("camera-values", file, f"pose of the photograph '{name}'")
    pose = np.column_stack([Rotation.from_quat(np.roll(numbers[:4], -1)).as_matrix(), numbers[4:]])
    return RegisteredView.of(name, *cameras[camera], pose)


def _camera(model: str, parameters: Sequence[float], rows: int, columns: int) -> SizedLens:
    """Convert a COLMAP camera. CaptureError (cameras-distorted) where its distortion is not Brown's."""
    plain = next((before for name, _, before in MODELS if name == model), 0)
    distortion = [float(value) for value in parameters[plain:]]
    if not plain or any(distortion[len(LENS_COLUMNS) :]):
        what = f"the camera {model} of {columns} x {rows} pixels has a distortion that is not read"
        expected = "PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV"
        refuse("cameras-distorted", "cameras", what, expected=expected, remedy=UNDISTORT)
    fx, fy = (parameters[0], parameters[0]) if plain == 3 else parameters[:2]
    cx, cy = (value - CORNER for value in parameters[plain - 2 : plain])
    brown = tuple((*distortion, *[0.0] * 5)[: len(LENS_COLUMNS)])
    if not (np.isfinite([fx, fy, cx, cy, *brown]).all() and min(fx, fy) > 0):
        raise ValueError(f"camera {model} with {' '.join(f'{value:g}' for value in parameters)}")
    return (rows, columns), Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, distortion=brown)


def _text_cameras(content: bytes) -> dict[int, SizedLens]:
    cameras = {}
    for line in _lines(content):
        number, model, columns, rows, *parameters = line.split()
        count = {name: count for name, count, _ in MODELS}.get(model, len(parameters))
        if count != len(parameters):
            raise ValueError(f"camera {number}: model {model} with {len(parameters)} parameters")
        cameras[int(number)] = _camera(model, list(map(float, parameters)), int(rows), int(columns))
    return cameras


def _text_images(content: bytes, notes: list[Problem]) -> list[Image]:
    """Parse lines `number quaternion translation camera name`, each followed by a line of triples for its points.

    Files that people and scripts write for known poses lack the lines of points, all or some: a line of points is
    known by its numbers, so that no photograph is taken for one.
    """
    images, points = [], True
    for line in _lines(content):
        words = line.split(maxsplit=9)
        if len(line.split()) % 3 == 0 and all(map(_is_number, line.split())):
            if points:
                raise ValueError(f"a line of points without its photograph: {line[:60]}")
            points = True
        elif len(words) == 10 and all(map(_is_number, words[:9])):
            images.append((words[9], int(words[8]), tuple(map(float, words[1:8]))))
            points = False
        else:
            raise ValueError(f"neither a photograph nor points: {line[:60]}")
    stated = HEADING.search(content)
    if stated and int(stated[1]) != len(images):
        what = f"expected {int(stated[1])} photographs as its heading says, found {len(images)}"
        remedy = "If some are missing, export the model again; it may have been cut off"
        notes.append(warning("cameras-count", "images.txt", what, remedy=remedy))
    return images


def _is_number(word: str) -> bool:
    return NUMBER.fullmatch(word) is not None


def _lines(content: bytes) -> list[str]:
    lines = (line.strip() for line in content.decode("utf-8-sig").split("\n"))
    return [line for line in lines if line and not line.startswith("#")]


def _binary_cameras(content: bytes) -> dict[int, SizedLens]:
    cameras, at = {}, 8
    for _ in range(_count(content)):
        number, model, columns, rows = struct.unpack_from("<iiQQ", content, at)
        if not 0 <= model < 1 << 16:
            raise ValueError(f"camera {number}: model number {model}")
        name, count, _ = MODELS[model] if model < len(MODELS) else (f"of model {model}", 0, 0)
        cameras[number] = _camera(name, struct.unpack_from(f"<{count}d", content, at + 24), rows, columns)
        at += 24 + 8 * count
    return cameras


def _binary_images(content: bytes) -> list[Image]:
    images, at = [], 8
    for _ in range(_count(content)):
        _, *numbers, camera = struct.unpack_from("<i7di", content, at)
        end = content.index(b"\0", at + 64)
        (points,) = struct.unpack_from("<Q", content, end + 1)
        images.append((content[at + 64 : end].decode(), camera, tuple(numbers)))
        at = end + 9 + 24 * points
        if at > len(content):
            raise ValueError(f"the file ends before the {points} points of '{images[-1][0]}'")
    return images


def _count(content: bytes) -> int:
    """Return the number of entries that a file begins with, which a broken one may state as any number."""
    (count,) = struct.unpack_from("<Q", content)
    if count > bound("views"):
        raise ValueError(f"{count} entries, more than the {bound('views')} views that are read")
    return count
