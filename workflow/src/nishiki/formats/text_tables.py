"""Text tables of a capture, line by line: bounded, UTF-8, every failure told as a problem of the capture."""

import csv
import io
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path

from nishiki.formats.files import Refused, bound, is_label, read_bytes, remedy
from nishiki.formats.problems import CaptureError, Problem, error, refuse

SEPARATOR = re.compile(r"\s*sep=.\s*", re.IGNORECASE)
DECIMAL_COMMA = re.compile(r"[-+]?[0-9]*,[0-9]+([eE][-+]?[0-9]+)?")
LABEL = "Use a name of at most 100 characters without slashes, line ends and control characters"


MISSING_FRAMES = "Write it, a row a photograph with its file and role, or make a capture folder with ./nishiki convert"


@contextmanager
def reading(name: str, kind: str) -> Iterator[None]:
    """Tell what goes wrong in reading the file `name` as CaptureErrors KIND-missing and KIND-unreadable."""
    try:
        yield
    except FileNotFoundError as e:
        remedy = MISSING_FRAMES if kind == "frames" else "Put the file there, or take its name out of capture.yaml"
        raise CaptureError(error(f"{kind}-missing", name, "file is missing", remedy=remedy)) from e
    except UnicodeDecodeError as e:
        what, found, remedy = f"not {e.encoding.upper()} text", f"{e.reason} at byte {e.start}", "Save it as UTF-8 text"
        raise CaptureError(error(f"{kind}-unreadable", name, what, found=found, remedy=remedy)) from e
    except csv.Error as e:
        raise CaptureError(error(f"{kind}-unreadable", name, "not a table", found=str(e))) from e
    except Refused as e:
        raise CaptureError(refusal(e, f"{kind}-unreadable")) from e


def refusal(e: Refused, kind: str) -> Problem:
    """Report a file that is not read as a problem."""
    return error(kind, e.file, e.what, expected=e.expected, found=e.found, remedy=e.remedy)


def lines_of(content: bytes) -> Iterator[tuple[int, str]]:
    """Lines that are neither empty nor comments (#), with their numbers from 1, without their ends."""
    stream = io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig")
    for number, line in enumerate(stream, start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line.rstrip("\n")


def table_lines(path: Path, name: str, *, limit: str = "table_bytes") -> Iterator[tuple[int, str]]:
    """Lines of a table file, see `lines_of`; to be used inside `reading`."""
    return lines_of(read_bytes(path, limit, name=name))


def table_rows(path: Path, name: str, *, limit: str = "table_bytes") -> Iterator[tuple[int, list[str]]]:
    """Cells of each line of a table, without blanks around them, with the line's number; to be used inside `reading`.

    The heading tells: commas separate its cells, or semicolons or tabs where it has more of these. Numbers may then
    have decimal commas, which become points. A first line `sep=;`, which spreadsheets write, is passed over.
    """
    return cells_of(table_lines(path, name, limit=limit))


def cells_of(lines: Iterator[tuple[int, str]]) -> Iterator[tuple[int, list[str]]]:
    """Cells of numbered lines, see `table_rows`."""
    first = next(lines, None)
    if first is not None and SEPARATOR.fullmatch(first[1]):
        first = next(lines, None)
    heading = first[1] if first is not None else ""
    mark = max(",;\t", key=lambda mark: (heading.count(mark), mark == ","))
    for number, line in chain([first] if first is not None else [], lines):
        cells = [cell.strip() for cell in next(csv.reader([line], delimiter=mark, skipinitialspace=True, strict=True))]
        if mark != ",":
            cells = [cell.replace(",", ".") if DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells]
        yield number, cells


def number_of(cell: str) -> float:
    """Read a number; NaN where the cell holds none."""
    try:
        return float(cell)
    except ValueError:
        return math.nan


def expect_rows(count: int, limit: str, name: str, kind: str) -> None:
    """CaptureError (KIND-many) where a table has more rows or columns than its bound."""
    if count > bound(limit):
        expected, found = f"at most {bound(limit)} {limit.rpartition('_')[2]}", f"{count} or more"
        what = "table is larger than is read"
        refuse(f"{kind}-many", name, what, expected=expected, found=found, remedy=remedy(limit))


def label_problems(name: str, what: str, where: str) -> list[Problem]:
    """name-unusable where the name of a view, light or region cannot be part of a file name; '' is no name."""
    if not name or is_label(name):
        return []
    return [error("name-unusable", where, f"name of a {what}", found=repr(name[:60]), remedy=LABEL)]
