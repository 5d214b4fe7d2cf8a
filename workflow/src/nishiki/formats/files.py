"""Read files that may come from a stranger: bounded, regular files only, never outside their folder, never code.

How large what comes from outside may be stands in one table, BOUNDS. A bound is compared with what a file is or claims
before anything of that size is read, decoded or allocated. All are far above what captures hold.
NISHIKI_BOUNDS="name=value,name=value" raises (or lowers) some for one run."""

import json
import os
import shutil
import stat
import unicodedata
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any

from nishiki.errors import UNSEEN, UserError

VARIABLE = "NISHIKI_BOUNDS"


@dataclass(frozen=True)
class Bound:
    """value: the largest that is accepted, in `unit`; of: the measured property."""

    value: int
    unit: str
    of: str


BOUNDS = MappingProxyType(
    {
        "settings_bytes": Bound(1 << 20, "bytes", "a YAML file: capture.yaml, configuration, settings, calibration"),
        "settings_depth": Bound(32, "levels", "blocks and lists inside each other, in YAML"),
        "settings_values": Bound(100_000, "values", "everything in one YAML file"),
        "scenes_bytes": Bound(1 << 24, "bytes", "a scene table"),
        "manifest_bytes": Bound(1 << 26, "bytes", "the manifest of a sealed capture"),
        "table_bytes": Bound(1 << 24, "bytes", "a table: frames, lights, intensities, cameras, points, spectra"),
        "table_columns": Bound(4096, "columns", "a table"),
        "frames": Bound(20_000, "rows", "frames.csv"),
        "lights": Bound(4096, "lights", "a lights file"),
        "views": Bound(4096, "views", "the cameras of a turntable"),
        "reflectances_bytes": Bound(1 << 28, "bytes", "a table of reflectances"),
        "reflectances_values": Bound(1 << 26, "numbers", "a table of reflectances"),
        "matlab_bytes": Bound(1 << 26, "bytes", "a MATLAB file, and what is unpacked from it"),
        "image_pixels": Bound(1 << 29, "pixels", "a photograph; the largest multi-shot cameras have 400 megapixels"),
        "image_side": Bound(1 << 17, "pixels", "rows or columns of a photograph"),
        "image_bytes": Bound(1 << 32, "bytes", "a photograph as decoded"),
        "image_file_bytes": Bound(1 << 32, "bytes", "a photograph's file"),
        "mesh_bytes": Bound(1 << 32, "bytes", "a file of a mesh or a range scan"),
        "mesh_vertices": Bound(1 << 28, "vertices", "a mesh or a range scan"),
        "mesh_faces": Bound(1 << 29, "faces", "a mesh or a range scan"),
        "folder_entries": Bound(1_000_000, "files and folders", "a capture folder"),
        "folder_depth": Bound(64, "levels", "folders inside each other, in a capture folder"),
        "json_bytes": Bound(1 << 28, "bytes", "a JSON file of an artifact"),
        "store_arrays": Bound(4096, "arrays and groups", "a Zarr store"),
        "store_files": Bound(10_000_000, "files and folders", "a Zarr store"),
        "store_array_bytes": Bound(1 << 42, "bytes", "a Zarr array"),
        "store_chunk_bytes": Bound(1 << 32, "bytes", "a chunk of a Zarr array, unpacked"),
        "store_chunks": Bound(10_000_000, "chunks", "a Zarr array"),
        "arrays_bytes": Bound(1 << 35, "bytes", "the arrays of an .npz file, unpacked"),
        "memory_bytes": Bound(0, "bytes", "what is held at once; 0: three quarters of this machine's memory"),
    }
)


def bound(name: str) -> int:
    """Return the bound of this kind. UserError where NISHIKI_BOUNDS is invalid."""
    value = _read_limits(os.environ.get(VARIABLE, "")).get(name, BOUNDS[name].value)
    return value or machine_memory() * 3 // 4


@cache
def machine_memory() -> int:
    """Return the memory limit of this process in bytes: the machine's, or its control group's where that is less."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        with open("/sys/fs/cgroup/memory.max") as file:
            limit = file.read().strip()
    except OSError:
        limit = "max"
    return min(machine, int(limit)) if limit.isdecimal() else machine


@cache
def _read_limits(text: str) -> dict[str, int]:
    bounds = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = (word.strip() for word in part.partition("="))
        if name not in BOUNDS or not value.isdecimal() or not 0 < len(value) <= 18:
            raise UserError(
                f"{VARIABLE}: expected name=number, several apart by commas, found {part[:60]!r}. Names: "
                f"{', '.join(BOUNDS)}"
            )
        bounds[name] = int(value)
    return bounds


def remedy(name: str) -> str:
    """Return the remedy for a trustworthy file above a bound."""
    return f"If it is as it should be, raise the bound: {VARIABLE}={name}=..., now {bound(name)} {BOUNDS[name].unit}"


NAME_BYTES = 200  # file systems hold 255; what is made from a file gets a longer name


class Refused(UserError):
    """Error of a rejected file: file, fault, expected, found and remedy apart, for readers that report them apart."""

    def __init__(self, file: str, what: str, *, expected: str = "", found: str = "", remedy: str = ""):
        self.file, self.what, self.expected, self.found, self.remedy = file, what, expected, found, remedy
        facts = [f"expected {expected}"] if expected else []
        facts += [f"found {found}"] if found else []
        text = f"{file}: {what}" + (f": {', '.join(facts)}" if facts else "")
        super().__init__(f"{text}. {remedy}" if remedy else text)


def expect_bound(size: int, name: str, file: str) -> None:
    """Raise Refused where a size is above its bound."""
    if size > bound(name):
        unit = BOUNDS[name].unit
        expected, found = f"at most {bound(name)} {unit}", f"{size} {unit}"
        raise Refused(file, "larger than is read", expected=expected, found=found, remedy=remedy(name))


def expect_memory(size: int, file: str) -> None:
    """Raise Refused where more memory would be needed than there is."""
    if size > bound("memory_bytes"):
        expected, found = f"at most {bound('memory_bytes')} bytes", f"{size} bytes"
        what, advice = "more than this machine's memory can hold", "Read it on a machine with more memory"
        raise Refused(file, what, expected=expected, found=found, remedy=f"{advice}. {remedy('memory_bytes')}")


def read_bytes(path: Path | str, limit: str, *, name: str | None = None) -> bytes:
    """Read a regular file of at most the bound `limit`.

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
    """Open a regular file. FileNotFoundError; Refused where it is none or may not be read."""
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
    """Read a UTF-8 file, without a byte-order mark; see `read_bytes`. UnicodeDecodeError for other text."""
    return read_bytes(path, limit, name=name).decode("utf-8-sig", errors=errors)


def read_json(path: Path | str) -> dict[str, Any]:
    """Read a JSON object of at most the bound json_bytes. UserError where the file is missing or holds none."""
    try:
        return json_object(read_bytes(path, "json_bytes", name=str(path)))
    except FileNotFoundError:
        raise UserError(f"{path}: file not found") from None
    except ValueError as error:
        raise UserError(f"{path}: not valid JSON ({error}). Remedy: make it again") from None


def json_object(text: str | bytes) -> dict[str, Any]:
    """Parse a JSON object. ValueError describes other texts briefly."""
    try:
        value = json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except ValueError as error:
        raise ValueError(str(error)[:200]) from None
    if not isinstance(value, dict):
        raise ValueError(f"expected an object, found {type(value).__name__}")
    return value


def name_fault(name: str) -> str:
    """Return the fault of a name, or '': absolute, '..', back slash, drive, control character, part of > 200 bytes."""
    parts = PurePosixPath(name).parts
    if not name or name.startswith("/") or ".." in parts or "\\" in name or name[1:2] == ":":
        return "file name"
    if not is_plain(name):
        return "file name with control characters, or not UTF-8"
    if any(len(part.encode()) > NAME_BYTES for part in parts):
        return f"a part of the file name is longer than {NAME_BYTES} bytes"
    return ""


def is_plain(text: str) -> bool:
    """Check that a text has no control characters (line ends and changes of direction included) and is Unicode."""
    return not UNSEEN.search(text)


def is_label(text: str) -> bool:
    """Check that a name (of a light, view, region) can be part of a file name: plain, no slashes, at most 100 bytes."""
    return bool(text) and is_plain(text) and not set(text) & set("/\\") and len(text.encode()) <= NAME_BYTES // 2


def files_with(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """List files of a folder with one of these suffixes (given in lower case) in any case, by name.

    Hidden files are left out: macOS writes a `._NAME` beside every file on a disk of another system.
    """
    return sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in suffixes and not path.name.startswith(".") and path.is_file()
    )


def same_name(name: str) -> str:
    """Normalise a file name for comparison: lower case, and accents composed, which macOS decomposes."""
    return unicodedata.normalize("NFC", name).casefold()


def leads_out(path: Path, folder: Path) -> bool:
    """Check whether a path, its links followed, lies outside a folder."""
    with suppress(ValueError):
        place, parts = str(folder), path.relative_to(folder).parts
        if ".." not in parts and not any(os.path.islink(place := os.path.join(place, part)) for part in parts):
            return False  # without links below the folder, which is quick to see
    try:
        return not path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # links in a circle
        return True


def walk(folder: Path, most: str = "folder_entries") -> Iterator[tuple[str, os.DirEntry]]:
    """Yield every entry below a folder that is no folder itself, as (name relative to it, entry), sorted by name.

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
    """Write a file whole or not at all, and flush it to the disk."""
    partial = path.with_name(f".{path.name}.part")
    partial.unlink(missing_ok=True)  # never written through: it may be a link that leads elsewhere
    with partial.open("xb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


@contextmanager
def whole_folder(target: Path) -> Iterator[Path]:
    """Yield the path of a folder to make and fill, which becomes the target when nothing went wrong."""
    partial = target.with_name(f".{target.name}.partial")
    if partial.exists():
        shutil.rmtree(partial)
    try:
        yield partial
        os.rename(partial, target)
    finally:
        if partial.exists():
            shutil.rmtree(partial)


def flush(path: Path) -> None:
    """Wait until a file's content, or the names in a folder (made, renamed or removed), are on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
