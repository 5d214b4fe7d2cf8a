"""Text that people write, bounded: tables, line by line, and YAML as plain data; failures are told as problems.

YAML has no tags and no anchors here. An alias stands for its anchor's whole content: nine lists of nine aliases each
unfold to 387 million values wherever the result is printed or checked ("billion laughs").
"""

import csv
import io
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import yaml

from nishiki.formats.files import Refused, bound, is_label, read_bytes, remedy
from nishiki.formats.problems import CaptureError, Problem, error, refuse

SEPARATOR = re.compile(r"\s*sep=.\s*", re.IGNORECASE)
DECIMAL_COMMA = re.compile(r"[-+]?[0-9]*,[0-9]+([eE][-+]?[0-9]+)?")
LABEL = "Use a name of at most 100 characters without slashes, line ends and control characters"


MISSING_FRAMES = "Write it, a row a photograph with its file and role, or make a capture folder with ./nishiki convert"


@contextmanager
def reading(name: str, kind: str) -> Iterator[None]:
    """Convert errors of reading the file `name` to CaptureErrors KIND-missing and KIND-unreadable."""
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
    """Convert the error of a rejected file to a problem."""
    return error(kind, e.file, e.what, expected=e.expected, found=e.found, remedy=e.remedy)


def lines_of(content: bytes) -> Iterator[tuple[int, str]]:
    """Yield lines that are neither empty nor comments (#), with their numbers from 1, without their ends."""
    stream = io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig")
    for number, line in enumerate(stream, start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line.rstrip("\n")


def table_lines(path: Path, name: str, *, limit: str = "table_bytes") -> Iterator[tuple[int, str]]:
    """Yield lines of a table file, see `lines_of`; to be used inside `reading`."""
    return lines_of(read_bytes(path, limit, name=name))


def table_rows(path: Path, name: str, *, limit: str = "table_bytes") -> Iterator[tuple[int, list[str]]]:
    """Yield cells of each line of a table, stripped, with the line's number; to be used inside `reading`.

    The heading tells: commas separate its cells, or semicolons or tabs where it has more of these. Numbers may then
    have decimal commas, which become points. A first line `sep=;`, which spreadsheets write, is passed over.
    """
    return cells_of(table_lines(path, name, limit=limit))


def cells_of(lines: Iterator[tuple[int, str]]) -> Iterator[tuple[int, list[str]]]:
    """Yield cells of numbered lines, see `table_rows`."""
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
    """Parse a number; NaN where the cell holds none."""
    try:
        return float(cell)
    except ValueError:
        return math.nan


def expect_rows(count: int, limit: str, name: str, kind: str) -> None:
    """Raise CaptureError (KIND-many) where a table has more rows or columns than its bound."""
    if count > bound(limit):
        expected, found = f"at most {bound(limit)} {limit.rpartition('_')[2]}", f"{count} or more"
        what = "table is larger than is read"
        refuse(f"{kind}-many", name, what, expected=expected, found=found, remedy=remedy(limit))


def label_problems(name: str, what: str, where: str) -> list[Problem]:
    """List name-unusable where the name of a view, light or region cannot be part of a file name; '' is no name."""
    if not name or is_label(name):
        return []
    return [error("name-unusable", where, f"name of a {what}", found=repr(name[:60]), remedy=LABEL)]


LONG_NUMBER = re.compile(r"[-+]?[0-9][xb]?[0-9a-f_:]{256,}", re.IGNORECASE)
"""Integers in notations that Python parses at any length, but refuses to print."""
SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class NotPlain(yaml.MarkedYAMLError):
    """YAML that is not plain data, or too large."""


def load_plain(text: str, loader: type = SafeLoader) -> Any:
    """Parse a YAML text. yaml.YAMLError where it is not plain YAML: `problem` is the reason, `problem_mark` the place.

    loader: a safe loader of the YAML library, or one derived from it.
    """
    try:
        # every event of the parser is checked before anything is built from them
        depth = values = 0
        for event in yaml.parse(text, Loader=SafeLoader):
            values += 1
            problem = ""
            if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
                problem = "anchors (&) and aliases (*) are not used"
            elif getattr(event, "tag", None) not in (None, "!"):
                problem = "tags (!) are not used"
            elif isinstance(event, yaml.CollectionStartEvent):
                depth += 1
            elif isinstance(event, yaml.CollectionEndEvent):
                depth -= 1
            elif isinstance(event, yaml.ScalarEvent):
                event.value.encode()  # a lone half of a surrogate pair is no text
                problem = f"a number of about {4 * len(event.value)} bits" if LONG_NUMBER.fullmatch(event.value) else ""
            if depth > bound("settings_depth"):
                problem = f"nested more than {bound('settings_depth')} levels deep"
            if values > 2 * bound("settings_values"):
                problem = f"more than {bound('settings_values')} values"
            if problem:
                raise NotPlain(None, None, problem, event.start_mark)
        return yaml.load(text, Loader=loader)
    except (ValueError, OverflowError, RecursionError, TypeError) as error:
        # dates and numbers that do not exist (2024-13-45, an integer of 5000 digits), texts that are not Unicode
        raise NotPlain(None, None, str(error)[:200] or type(error).__name__, None) from None
