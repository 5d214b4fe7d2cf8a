"""Reading files that may come from a stranger: bounded, regular files only, never outside their folder, never code."""

from __future__ import annotations

import json
import os
import stat
import unicodedata
from collections.abc import Collection, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from nishiki.errors import UNSEEN, UserError
from nishiki.formats.bounds import BOUNDS, bound, remedy

NAME_BYTES = 200  # file systems hold 255; what is made from a file gets a longer name


class Refused(UserError):
    """A file that is not read: file, what is wrong, expected, found and remedy apart, for readers that tell them so."""

    def __init__(self, file: str, what: str, *, expected: str = "", found: str = "", remedy: str = ""):
        self.file, self.what, self.expected, self.found, self.remedy = file, what, expected, found, remedy
        facts = [f"expected {expected}"] if expected else []
        facts += [f"found {found}"] if found else []
        text = f"{file}: {what}" + (f": {', '.join(facts)}" if facts else "")
        super().__init__(f"{text}. {remedy}" if remedy else text)


def expect_bound(size: int, name: str, file: str) -> None:
    """Refused where a size is above its bound."""
    if size > bound(name):
        unit = BOUNDS[name].unit
        expected, found = f"at most {bound(name)} {unit}", f"{size} {unit}"
        raise Refused(file, "larger than is read", expected=expected, found=found, remedy=remedy(name))


def expect_memory(size: int, file: str) -> None:
    """Refused where something would need more memory than there is."""
    if size > bound("memory_bytes"):
        expected, found = f"at most {bound('memory_bytes')} bytes", f"{size} bytes"
        what, advice = "more than this machine's memory can hold", "Read it on a machine with more memory"
        raise Refused(file, what, expected=expected, found=found, remedy=f"{advice}. {remedy('memory_bytes')}")


def read_bytes(path: Path | str, limit: str, *, name: str | None = None) -> bytes:
    """Content of a regular file of at most the bound `limit`.

    name: how to call it in messages. FileNotFoundError where there is none; Refused where it is a folder, a device or
    a pipe (which would be read for ever), larger, or may not be read.
    """
    file = name or Path(path).name
    handle = open_regular(path, file)
    try:
        expect_bound(os.fstat(handle).st_size, limit, file)
        with os.fdopen(handle, "rb", closefd=False) as stream:
            content = stream.read(bound(limit) + 1)
    except OSError as error:
        raise Refused(file, "cannot be read", found=str(error)) from None
    finally:
        os.close(handle)
    expect_bound(len(content), limit, file)  # files of /proc say that they hold nothing
    return content


def open_regular(path: Path | str, file: str) -> int:
    """A handle for reading a regular file. FileNotFoundError; Refused where it is none or may not be read."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe would wait for a writer
    except (FileNotFoundError, NotADirectoryError) as error:
        raise FileNotFoundError(str(error)) from None
    except (OSError, ValueError) as error:
        raise Refused(file, "cannot be read", found=str(error)) from None
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        advice = "Replace it by a file; folders, pipes and devices are not read"
        raise Refused(file, "not a regular file", remedy=advice)
    return handle


def read_text(path: Path | str, limit: str, *, name: str | None = None, errors: str = "strict") -> str:
    """Text of a UTF-8 file, without a byte-order mark; see `read_bytes`. UnicodeDecodeError where it is none."""
    return read_bytes(path, limit, name=name).decode("utf-8-sig", errors=errors)


def read_json(path: Path | str) -> dict[str, Any]:
    """A JSON object from a file of at most the bound json_bytes. UserError where it is missing or none."""
    try:
        value = json.loads(read_bytes(path, "json_bytes", name=str(path)))
    except FileNotFoundError:
        raise UserError(f"{path}: file not found") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not valid JSON ({_brief(error)}). Remedy: make it again") from None
    if not isinstance(value, dict):
        raise UserError(f"{path}: expected a JSON object, found {type(value).__name__}. Remedy: make it again")
    return value


def _brief(error: Exception) -> str:
    return "nested too deeply" if isinstance(error, RecursionError) else str(error)[:200]


def name_fault(name: str) -> str:
    """Why a relative file name is refused, or ''. Absolute names, '..', back slashes, drives, control characters and
    parts of more than 200 bytes are."""
    parts = PurePosixPath(name).parts
    if not name or name.startswith("/") or ".." in parts or "\\" in name or name[1:2] == ":":
        return "file name"
    if not is_plain(name):
        return "file name with control characters, or not UTF-8"
    if any(len(part.encode()) > NAME_BYTES for part in parts):
        return f"a part of the file name is longer than {NAME_BYTES} bytes"
    return ""


def is_plain(text: str) -> bool:
    """Whether a text has no control characters (line ends and changes of direction included) and is Unicode."""
    return not UNSEEN.search(text)


def is_label(text: str) -> bool:
    """Whether a name (of a light, view, region) can be part of a file name: plain, no slashes, at most 100 bytes."""
    return bool(text) and is_plain(text) and not set(text) & set("/\\") and len(text.encode()) <= NAME_BYTES // 2


def files_with(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Files of a folder with one of these suffixes (small letters) in any case, in the order of their names.

    Hidden files are left out: macOS writes a `._NAME` beside every file on a disk of another system.
    """
    return sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes and not path.name.startswith(".") and path.is_file()
    )


def same_name(name: str) -> str:
    """A file name for comparison: without capitals, letters with accents composed, which macOS takes apart."""
    return unicodedata.normalize("NFC", name).casefold()


def leads_out(path: Path, folder: Path) -> bool:
    """Whether a path, its links followed, lies outside a folder."""
    try:
        place, parts = str(folder), path.relative_to(folder).parts
        if ".." not in parts and not any(os.path.islink(place := os.path.join(place, part)) for part in parts):
            return False  # without links below the folder, which is quick to see
    except ValueError:
        pass
    try:
        return not path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # links in a circle
        return True


def walk(folder: Path, most: str = "folder_entries") -> Iterator[tuple[str, os.DirEntry]]:
    """Every entry below a folder that is no folder itself, as (name relative to it, entry), in the order of names.

    Links to folders are entries, never entered. Refused beyond the bounds `most` and folder_depth.
    """
    pending, seen = [(str(folder), "", 0)], 0
    while pending:
        place, prefix, depth = pending.pop()
        if depth > bound("folder_depth"):
            expect_bound(depth, "folder_depth", str(folder))
        with os.scandir(place) as entries:
            ordered = sorted(entries, key=lambda entry: entry.name)
        seen += len(ordered)
        expect_bound(seen, most, str(folder))
        for entry in ordered:
            if entry.is_dir(follow_symlinks=False):
                pending.append((entry.path, f"{prefix}{entry.name}/", depth + 1))
            else:
                yield f"{prefix}{entry.name}", entry


def put_file(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all; it is on the disk when this returns."""
    partial = path.with_name(f".{path.name}.part")
    partial.unlink(missing_ok=True)  # never written through: it may be a link that leads elsewhere
    with partial.open("xb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def flush_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk: files that were made in it, renamed or removed."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
