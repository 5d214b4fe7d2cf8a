"""Read lamp positions and directions: `.lp` files in all their dialects, plain direction lists, and tables.

A `.lp` file begins with the number of lights; each further line is `[file name] x y z`. In the wild one finds decimal
commas, commas or semicolons between the numbers, Windows paths, quoted names with blanks, no names at all, vectors that
are not of unit length, byte-order marks and blank lines. All are read; what cannot be is an error that names the line.
"""

import codecs
import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.errors import require
from nishiki.formats.files import bound, read_bytes
from nishiki.formats.problems import Problem, error, raise_errors, refuse, warning
from nishiki.formats.text_tables import cells_of, expect_rows, label_problems, reading
from nishiki.goniometry.directions import unit
from nishiki.photometric.arrangement import turn_axes

IMAGE_SUFFIX = re.compile(r"\.(png|tiff?|jpe?g|exr|bmp|dng|cr[23w]|nef|arw|raf|orf|rw2|pef|srw|tga)$", re.IGNORECASE)
SAME_DEG = 0.1  # directions nearer than this are one
UNIT_LENGTH = 0.01  # by which lengths of unit vectors may be off: lists are rounded
COPLANAR_RATIO = 1e-3  # smallest / largest singular value of the direction matrix


@dataclass(frozen=True)
class Lights:
    """Named lamps."""

    names: tuple[str, ...]  # one a light, distinct
    files: tuple[str | None, ...]  # the photograph named beside each light, or None
    vectors: np.ndarray  # (lights, 3) float64 as written in the file
    # (lights, 3) float64, unit length, from the image centre to the lamp (x right, y up, z to the camera)
    directions: np.ndarray
    warnings: tuple[Problem, ...] = ()  # what was tolerated

    def find(self, name: str) -> int | None:
        """Find the position of the light with this name, or of a photograph with this file name; None if unknown."""
        return self._positions.get(name, self._positions.get(light_name(name)))

    def index(self, name: str) -> int:
        """Return the position of a light that is known."""
        return require(self.find(name))

    @cached_property
    def _positions(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}


def light_name(token: str) -> str:
    """Derive the name of a light from a file name: folders of either kind and an image's suffix are dropped."""
    return IMAGE_SUFFIX.sub("", re.split(r"[\\/]", token.strip().strip("\"'"))[-1])


def read_lights(path: Path, *, kind: str = "direction", frontal: bool = True) -> Lights:
    """Read `.lp`, `.csv`, or a list of directions (`.txt`), by the file's suffix.

    kind: 'direction' (unit vectors; other lengths are normalised, with a warning) or 'position_mm'; frontal: refuse
    lamps in or behind the object's plane (z <= 0), which an object in the round may well have.
    Raises CaptureError with every mistake found (kinds: lights-missing, lights-unreadable, lights-many, lights-count,
    light-zero, light-not-finite, light-behind, light-duplicate, name-unusable, lights-none).
    """
    names, numbers = read_numbers(path)
    if numbers.shape[1] != 3:
        refuse("lights-unreadable", path.name, f"{numbers.shape[1]} numbers a line", expected="3")
    return lights_from_vectors(names, numbers, file=path.name, kind=kind, frontal=frontal)


def read_numbers(path: Path, encoding: str | None = None) -> tuple[list[str | None], np.ndarray]:
    """Read the names of a lights file and its numbers (lights, numbers a line) float64, as they are written.

    encoding: of a text that is not Unicode. CaptureError: lights-missing, lights-unreadable, lights-many, lights-count.
    """
    with reading(path.name, "lights"):
        text = _decode(read_bytes(path, "table_bytes", name=path.name), encoding)
        parse = _parse_table if path.suffix.lower() == ".csv" else _parse_list
        names, rows = parse(text, path.name, counted=path.suffix.lower() not in (".csv", ".txt"))
    expect_rows(len(names), "lights", path.name, "lights")
    return names, np.array(rows, np.float64).reshape(len(rows), len(rows[0]) if rows else 3)


def is_unicode(path: Path) -> bool:
    """Check whether the encoding of a lights file is known to be Unicode, so that no code page has to be guessed."""
    with reading(path.name, "lights"):
        content = read_bytes(path, "table_bytes", name=path.name)
    try:
        _decode(content, "ascii")
    except UnicodeDecodeError:
        return content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return True


def _decode(content: bytes, encoding: str | None = None) -> str:
    """Decode a lights file: UTF-16 by its mark, UTF-8, or a code page, Latin-1 if none is given."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode(encoding or "latin-1")  # file names in an old code page; the numbers are ASCII anyway


def lights_from_vectors(
    names: Sequence[str | None], vectors: np.ndarray, *, file: str, kind: str = "direction", frontal: bool = True
) -> Lights:
    """Check and normalise vectors (lights, 3); a light without a name is called by its number, from 1."""
    problems: list[Problem] = []
    if len(vectors) == 0:
        problems.append(error("lights-none", file, "no lights", expected="at least 3 lights"))
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.sqrt((vectors**2).sum(axis=1))
    called = [str(i + 1) if name is None else light_name(name) for i, name in enumerate(names)]
    # the origin of a turntable's positions is the camera, where a lamp may well be
    least = 0.0 if kind == "position_mm" and not frontal else 1e-9
    for name, vector, length in zip(called, vectors, lengths, strict=True):
        what, found = f"light '{name}'", " ".join(f"{v:g}" for v in vector)
        if not math.isfinite(length):
            problems.append(error("light-not-finite", file, f"{what} is not finite", found=found))
        elif length < least:
            problems.append(error("light-zero", file, f"{what} has a vector of zero length", found=found))
        elif frontal and vector[2] <= 0:
            what += " lies in or behind the object's plane: directions point from there to the lamp, z to the camera"
            problems.append(error("light-behind", file, what, expected="z > 0", found=found))
    seen: dict[str, int] = {}
    for i, name in enumerate(called):
        if seen.setdefault(name, i) != i:
            what = f"light '{name}' appears twice (numbers {seen[name] + 1} and {i + 1})"
            problems.append(error("light-duplicate", file, what))
        if not name:
            problems.append(error("name-unusable", file, f"light {i + 1} has no name", found=repr(names[i])))
        problems += label_problems(name, "light", file)
    raise_errors(problems)
    uneven = np.abs(lengths - 1) > UNIT_LENGTH
    if kind == "direction" and uneven.any():
        worst = lengths[np.argmax(np.abs(lengths - 1))]
        what = f"{uneven.sum()} of {len(vectors)} directions are not of unit length and were normalised"
        problems.append(warning("light-not-unit", file, what, found=f"length {worst:.4g}"))
    return Lights(
        tuple(called), tuple(names), vectors, vectors / np.where(lengths > 0, lengths, 1.0)[:, None], tuple(problems)
    )


def rearrange(lights: Lights, order: str | None, axes: str | None) -> tuple[Lights, np.ndarray]:
    """Reorder the lamps among the photographs, and change the lamps' axes.

    Parameters
    ----------
    lights : Lights
        As listed, one a photograph.
    order : str or None
        `shift:N`: photograph i has the lamp listed N places after it, the last ones followed by the first; `reverse`:
        the first photograph has the last lamp; or the numbers of the lamps, from 1, by photograph: `2,1,3`.
    axes : str or None
        x and y of the lamps in terms of those listed, as `x,-y` where the list counts y downwards; heights and a turn,
        see `nishiki.photometric.arrangement.turn_axes`.

    Returns
    -------
    Lights, (lights,) int
        Under the same names, and the place in the list of each.

    Raises
    ------
    CaptureError
        option-unusable for what is none of these.
    """
    places = np.arange(len(lights.names)) if order is None else _order_of(order, len(lights.names))
    vectors = lights.vectors[places]
    if axes is not None:
        try:
            turned = turn_axes(vectors, axes)
        except ValueError:
            remedy = "Write it with an equals sign where it begins with a dash: --lights-axes=-x,y"
            expected = f"expected axes such as x,-y or x,y,2.54z or x,y,turn:30, found {axes}"
            refuse("option-unusable", "lights-axes", expected, remedy=remedy)
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        unit = np.abs(lengths - 1).max() < UNIT_LENGTH
        vectors = turned / np.linalg.norm(turned, axis=1, keepdims=True) if unit else turned
    directions = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return replace(lights, vectors=vectors, directions=directions), places


def _order_of(text: str, count: int) -> np.ndarray:
    places = np.arange(count)
    if text == "reverse":
        return places[::-1]
    if match := re.fullmatch(r"shift:(-?[0-9]{1,9})", text):
        return (places + int(match[1])) % count
    if re.fullmatch(r"[0-9]{1,9}(,[0-9]{1,9})*", text):
        numbers = np.array([int(number) - 1 for number in text.split(",")])
        if sorted(numbers.tolist()) == places.tolist():
            return numbers
    expected = f"shift:N, reverse, or each number from 1 to {count} once, with commas between"
    refuse("option-unusable", "lights-order", f"expected {expected}, found {text[:60]}")


def direction_problems(directions: np.ndarray, file: str) -> list[Problem]:
    """Check that directions (lights, 3) determine a normal: three or more, not all in one plane."""
    if len(directions) < 3:
        return [error("lights-few", file, f"expected photographs under at least 3 lights, found {len(directions)}")]
    values = np.linalg.svd(directions, compute_uv=False)
    if values[2] < COPLANAR_RATIO * values[0]:
        what = "all lights lie in one plane, so that normals are not determined"
        found = f"singular values {values[0]:.3g}, {values[1]:.3g}, {values[2]:.3g}"
        return [error("lights-coplanar", file, what, found=found, remedy="Add a light outside that plane")]
    return []


def _parse_list(text: str, file: str, *, counted: bool) -> tuple[list[str | None], list[list[float]]]:
    """Parse a `.lp` (counted) or a bare list of vectors, one a line."""
    lines = list(islice(_meaningful_lines(text), bound("lights") + 2))  # the first may be the count
    expect_rows(len(lines) - 1, "lights", file, "lights")
    declared = None
    if lines and re.fullmatch(r"[0-9]{1,18}", lines[0][1]):
        declared = int(lines.pop(0)[1])
    elif counted:
        found = lines[0][1][:40] if lines else "an empty file"
        expected = "the number of lights in the first line, then a line '[file name] x y z' for each"
        refuse("lights-unreadable", file, "not a .lp file", expected=expected, found=found)
    parsed = [_parse_line(line) for _, line in lines]
    problems = []
    for (number, line), each in zip(lines, parsed, strict=True):
        if each is None:
            what = f"expected [file name] x y z, found {line[:60]}"
            problems.append(error("lights-unreadable", f"{file} line {number}", what))
    if declared is not None and declared != len(lines):
        what = f"expected {declared} lights as the first line says, found {len(lines)} lines"
        problems.append(error("lights-count", file, what))
    raise_errors(problems)
    names = [each[0] for each in parsed if each]
    rows = [each[1] for each in parsed if each]
    if any(n is None for n in names) and any(n is not None for n in names):
        refuse("lights-unreadable", file, "some lines name a photograph and some do not: name it in all, or in none")
    if len({len(row) for row in rows}) > 1:  # names that end in numbers
        rows = [row[-3:] for row in rows]
    return names, rows


def _meaningful_lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield lines that are neither empty nor comments, with their numbers from 1."""
    for number, line in enumerate(io.StringIO(text, newline=None), start=1):
        if line.strip() and not line.strip().startswith(("#", "//")):
            yield number, line.strip()


def _parse_line(line: str) -> tuple[str | None, list[float]] | None:
    """Parse name (or None) and numbers of a line: all that follow the name of a picture, else the last three.

    None where it is no such line.
    """
    for candidate in (line, re.sub(r"\s#.*$", "", line)):
        # at blanks (numbers may then have decimal commas), semicolons or commas
        blank = [t.rstrip(",;") for t in candidate.split() if t.strip(",;")]
        for tokens in (blank, *([t.strip() for t in candidate.split(mark)] for mark in ";,")):
            numbers = [_number(t) for t in tokens]
            picture = max((i for i, t in enumerate(tokens) if IMAGE_SUFFIX.search(t.strip("\"'"))), default=None)
            start = max(len(tokens) - 3, 0) if picture is None else picture + 1
            found = [v for v in numbers[start:] if v is not None]
            if len(found) >= (3 if picture is None else 2) and len(found) == len(tokens) - start:
                return _name_before(candidate, tokens, start), found
    return None


def _number(token: str) -> float | None:
    if token.count(",") == 1 and "." not in token:
        token = token.replace(",", ".")
    if "_" in token:  # Python would read 1_0 as a number
        return None
    try:
        return float(token)
    except ValueError:
        return None


def _name_before(line: str, tokens: list[str], start: int) -> str | None:
    """Return the text before the numbers, which begin with the token `start`: a file name that may hold blanks."""
    if start == 0:
        return None
    end = len(line)
    for token in reversed(tokens[start:]):
        end = line.rindex(token, 0, end)
    return line[:end].strip().rstrip(",;").strip().strip("\"'")


def _parse_table(text: str, file: str, *, counted: bool) -> tuple[list[Any], list[list[float]]]:
    """Parse lights.csv: light,x,y,z or light,azimuth_deg,polar_deg (azimuth from x to y; polar from the normal)."""
    rows = cells_of(_meaningful_lines(text))
    columns = next(rows, (0, []))[1]
    cartesian, angular = ["light", "x", "y", "z"], ["light", "azimuth_deg", "polar_deg"]
    if sorted(columns) not in (sorted(cartesian), sorted(angular)):
        expected = f"{','.join(cartesian)} or {','.join(angular)}"
        refuse("lights-unreadable", file, f"expected the columns {expected}, found {','.join(columns)[:80]}")
    names, vectors, problems = [], [], []
    for number, cells in islice(rows, bound("lights") + 1):
        row = dict(zip(columns, cells, strict=False))
        values: list[Any] = [_number(row.get(key, "")) for key in (cartesian if "x" in columns else angular)[1:]]
        sound = all(v is not None and math.isfinite(v) for v in values)
        if len(cells) != len(columns) or not row["light"] or not sound:
            what = f"expected a name and {len(values)} numbers, found {','.join(cells)[:60]}"
            problems.append(error("lights-unreadable", f"{file} line {number}", what))
            continue
        names.append(row["light"])
        vectors.append(values if len(values) == 3 else unit(*np.radians(values[::-1])).tolist())
    raise_errors(problems)
    return names, vectors
