"""Cameras of Bundler: `bundle.out` and the list of photographs beside it, as Bundler, VisualSFM and others write them.

A point X is seen at p = R X + t; x, y = -p_x / p_z, -p_y / p_z (x right, y up, looking along -z). Distorted by
1 + k1 r^2 + k2 r^4 it falls on f x, f y: pixels from the middle of the picture, y upwards.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nishiki.capture.registered import GL, Pictures, RegisteredView, Registration, finite, reading_cameras, rigid
from nishiki.capture.turntable_schema import Intrinsics
from nishiki.formats.files import files_with, read_bytes
from nishiki.formats.problems import CaptureError, error, expect_one, left_out, raise_errors
from nishiki.formats.text_tables import expect_rows, reading

HEADING = b"# Bundle file"
LINES = 5  # of a camera
POINTS = 1000  # that are compared with the sizes of the photographs
OUTSIDE = 1.0  # pixels by which a point may lie outside of its photograph


def bundler_file(source: Path) -> Path | None:
    """The only file of Bundler's in a folder or in `bundle`; None without.

    CaptureError (layout-unknown) where there are several.
    """
    for folder in (source, source / "bundle"):
        found = []
        for path in files_with(folder, (".out",)) if folder.is_dir() else ():
            with path.open("rb") as stream:
                if stream.read(len(HEADING)) == HEADING:
                    found.append(path)
        named = [path for path in found if path.name == "bundle.out"] or found
        what, remedy = "several files of Bundler", "Keep the last one that it wrote, or call it bundle.out"
        if one := expect_one(named, source, what, remedy):
            return one
    return None


def read_bundler(path: Path, pictures: Pictures) -> Registration:
    """The photographs that have a camera; notes name the others.

    Raises CaptureError: cameras-unreadable, cameras-many, photograph-missing; photographs-count where the list is not
    as long as the cameras; camera-values where points lie outside of their photographs, which are then of another size.
    """
    names = _names(path, pictures.folder)
    with reading_cameras(path.name, "Bundler", "Export them again, as Bundler version 0.3"):
        content = read_bytes(path, "json_bytes")
        lines = content.split(b"\n", 2 + LINES * (len(names) + 1) + 3 * POINTS)
        count = int(lines[1].split()[0])
        expect_rows(count, "views", path.name, "cameras")
        if count != len(names):
            expected, found = f"{count}, one a camera of {path.name}", f"{len(names)}"
            remedy = "Put the list of photographs that Bundler was given beside it (list.txt)"
            what = "names of photographs"
            raise CaptureError(
                error("photographs-count", path.name, what, expected=expected, found=found, remedy=remedy)
            )
        cameras = [_numbers(lines[2 + LINES * i : 2 + LINES * (i + 1)], 15) for i in range(count)]
        seen = _furthest(lines[2 + LINES * count :], count)
        views, unplaced, problems = [], [], []
        for name, camera, (x, y) in zip(names, cameras, seen, strict=True):
            if not camera[0] > 0:
                unplaced.append(name)
                continue
            rows, columns = pictures.size(name, path.name)
            if 2 * x > columns + OUTSIDE or 2 * y > rows + OUTSIDE:
                what, remedy = "points lie outside of the photograph", "Give the photographs that Bundler was given"
                expected, found = f"at least {2 * x:.0f} x {2 * y:.0f} pixels", f"{columns} x {rows}"
                problems.append(error("camera-values", name, what, expected=expected, found=found, remedy=remedy))
            pose = GL @ np.column_stack([rigid(camera[3:12].reshape(3, 3)), camera[12:]])
            f, k1, k2 = camera[:3]
            lens = Intrinsics(fx=f, fy=f, cx=(columns - 1) / 2, cy=(rows - 1) / 2, distortion=(k1, k2, 0, 0, 0))
            views.append(RegisteredView.of(name, (rows, columns), lens, pose))
        if not views:
            raise ValueError("no photograph has a camera")
    raise_errors(problems)
    return Registration(tuple(views), tuple(left_out(unplaced, path.name, "photographs without a camera")))


def _names(path: Path, folder: Path) -> list[str]:
    """Photographs by camera, from the list beside the file or in the folder of the photographs.

    CaptureError (photographs-count) without a list: nothing else tells which camera took which.
    """
    places = [path.with_name(f"{path.name}.list.txt"), path.with_name("list.txt"), folder / "list.txt"]
    places += [p for p in files_with(path.parent, (".txt",)) if "list" in p.name.lower()]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        what, remedy = (
            "no list of the photographs",
            "Put list.txt beside it: the photographs in the order of the cameras",
        )
        raise CaptureError(error("photographs-count", path.name, what, remedy=remedy))
    with reading(found.name, "cameras"):
        text = read_bytes(found, "table_bytes").decode("utf-8-sig")
    # a name is followed by 0 and a focal length where that was known
    return [
        " ".join(words[:-2] if len(words) > 2 and words[-2] == "0" else words)
        for words in map(str.split, text.splitlines())
        if words
    ]


def _numbers(lines: list[bytes], count: int) -> np.ndarray:
    words = b" ".join(lines).split()
    if len(words) != count:
        raise ValueError(f"{len(words)} numbers where {count} are expected: {b' '.join(words)[:60].decode('latin-1')}")
    return np.array([finite(word.decode("latin-1")) for word in words])


def _furthest(lines: list[bytes], count: int) -> np.ndarray:
    """(cameras, 2): largest distance of points from the middle of each photograph, across and up, of the first ones."""
    seen = np.zeros((count, 2))
    for line in lines[2 : 3 * POINTS : 3]:
        words = line.split()
        views = np.array(words[1:], np.float64).reshape(-1, 4)
        if int(words[0]) != len(views) or not (0 <= views[:, 0]).all() or not (views[:, 0] < count).all():
            raise ValueError(f"a point's list of photographs: {line[:60].decode('latin-1')}")
        np.maximum.at(seen, views[:, 0].astype(int), np.abs(views[:, 2:]))
    return seen
