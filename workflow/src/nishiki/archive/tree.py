"""List and read files below a folder, or inside a ZIP file, without following any link."""

import hashlib
import os
import stat
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import FileIO
from pathlib import Path
from typing import IO

LARGEST_TEXT = 256 * 2**20
"""Bytes of the largest manifest that is read; one of a million files has about 150 MB."""
BLOCK = 2**18


@dataclass
class Listing:
    """Contents of a folder: sizes of regular files, targets of links, other entries, unreadable entries."""

    files: dict[str, int] = field(default_factory=dict)
    links: dict[str, str] = field(default_factory=dict)
    others: dict[str, str] = field(default_factory=dict)
    unreadable: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class FolderTree:
    """Files below a folder. Links are listed, never followed; only the folder itself may be reached through one."""

    root: Path

    def listing(self, below: str = "") -> Listing:
        """List everything below a folder of the tree, names relative to that folder, in a fixed order."""
        listing = Listing()
        folders = [""]
        start = os.path.join(self.root, below) if below else str(self.root)
        while folders:
            folder = folders.pop()
            try:
                with os.scandir(os.path.join(start, folder) if folder else start) as entries:
                    inner = sorted(entries, key=lambda entry: entry.name)
            except OSError as error:
                listing.unreadable[folder or "."] = str(error.strerror)
                continue
            names = [(f"{folder}/{entry.name}" if folder else entry.name, entry) for entry in inner]
            folders += [name for name, entry in reversed(names) if _sort_in(listing, name, entry)]
        return listing

    def read(self, name: str) -> bytes:
        """Read a small file. Raises OSError; ValueError for one that is larger than LARGEST_TEXT."""
        with _open(os.path.join(self.root, name)) as handle:
            return _read(handle, os.fstat(handle.fileno()).st_size)

    def digest(self, name: str) -> str:
        """Compute the SHA-256 of a file, read in blocks. Raises OSError."""
        with _open(os.path.join(self.root, name)) as handle:
            return hashlib.file_digest(handle, "sha256").hexdigest()


def _sort_in(listing: Listing, name: str, entry: os.DirEntry) -> bool:
    """Note one entry of a folder; True where it is a folder to look into."""
    if entry.is_symlink():
        listing.links[name] = os.readlink(entry.path)
    elif entry.is_dir(follow_symlinks=False):
        return True
    elif entry.is_file(follow_symlinks=False):
        listing.files[name] = entry.stat(follow_symlinks=False).st_size
    else:
        listing.others[name] = stat.filemode(entry.stat(follow_symlinks=False).st_mode)
    return False


def _open(path: str) -> FileIO:
    """Open a regular file for reading; a link or a pipe in its place is an OSError."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(22, "not a regular file", path)
    return FileIO(descriptor)


def _read(handle: IO[bytes] | FileIO, size: int) -> bytes:
    if size > LARGEST_TEXT:
        raise ValueError(f"{size} bytes, larger than any manifest")
    data = bytearray()
    while block := handle.read(BLOCK):
        data += block
        if len(data) > LARGEST_TEXT:
            raise ValueError("larger than any manifest")
    return bytes(data)


@contextmanager
def _broken_as_oserror(name: str) -> Iterator[None]:
    """Turn the exceptions of a broken ZIP file into the OSError of an unreadable file."""
    try:
        yield
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, struct.error) as error:
        raise OSError(5, str(error), name) from None


class ZipTree:
    """Files inside a ZIP file, read where they are: nothing is unpacked."""

    def __init__(self, root: Path):
        self.root = root
        self.archive = zipfile.ZipFile(root)
        self.members = {}
        self.repeated: list[str] = []
        for member in self.archive.infolist():
            if member.filename in self.members:
                self.repeated.append(member.filename)
            self.members[member.filename] = member

    def listing(self, below: str = "") -> Listing:
        """List everything below a folder of the tree, names relative to that folder, in a fixed order."""
        listing = Listing()
        prefix = f"{below}/" if below else ""
        for name, member in sorted(self.members.items()):
            if not name.startswith(prefix) or member.is_dir():
                continue
            mode = member.external_attr >> 16
            if stat.S_ISLNK(mode):
                listing.links[name[len(prefix) :]] = "(inside a ZIP file)"
            elif member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:
                listing.others[name[len(prefix) :]] = "compressed or encrypted"
            else:
                listing.files[name[len(prefix) :]] = member.file_size
        return listing

    def read(self, name: str) -> bytes:
        """Read a small file. Raises OSError; ValueError for one that is larger than LARGEST_TEXT."""
        member = self._member(name)
        with _broken_as_oserror(name), self.archive.open(member) as handle:
            return _read(handle, member.file_size)

    def digest(self, name: str) -> str:
        """Compute the SHA-256 of a file, read in blocks. Raises OSError."""
        with _broken_as_oserror(name), self.archive.open(self._member(name)) as handle:
            return hashlib.file_digest(handle, "sha256").hexdigest()  # type: ignore[arg-type]  # a ZipExtFile can

    def _member(self, name: str) -> zipfile.ZipInfo:
        member = self.members.get(name)
        if member is None or member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:
            raise OSError(2, "no such file stored in the ZIP file", name)
        return member


Tree = FolderTree | ZipTree
"""Files under relative names with `/`."""
