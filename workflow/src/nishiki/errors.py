"""Errors that a user can mend, as distinct from bugs."""

import errno
import os
import re
from collections.abc import Iterable
from typing import TypeVar

UNSEEN = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
T = TypeVar("T")


class UserError(Exception):
    """Bad input: the message says what was expected, what was found, where, and what to do.

    The command line prints it on one line without a traceback and exits with status 2.
    """

    def __str__(self) -> str:
        return "\n".join(printable(line) for line in super().__str__().split("\n"))


class NotFinite(Exception):
    """A stage wrote a NaN or an infinity: a defect of the program, not of the input."""


def require(value: T | None) -> T:
    """Return a value that earlier checks promise; ValueError, which is a bug, where it is missing."""
    if value is None:
        raise ValueError("a value is missing that earlier checks promise")
    return value


def unknown_scene(name: str, scenes: Iterable[str]) -> str:
    """Return the message for a name that is no scene, with the scenes that are like it."""
    from difflib import get_close_matches

    scenes = list(scenes)
    alike = get_close_matches(name, scenes, cutoff=0.5)
    text = f"Did you mean {' or '.join(alike)}?" if alike else f"Scenes: {', '.join(scenes[:20]) or 'none yet'}"
    return f"no scene {name!r} in the scene table. {text}"


def printable(text: str) -> str:
    """Escape control characters, changes of direction and halves of surrogates.

    Names of files come from strangers: a terminal would obey some of them, and UTF-8 has no place for others.
    """
    return UNSEEN.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


OF_THE_MACHINE = {
    errno.ENOSPC: "Remedy: free space there and run again",
    errno.EDQUOT: "Remedy: free space within the quota and run again",
    errno.EROFS: "Remedy: make it writable, or name another folder with the key results, and run again",
    errno.EACCES: "Remedy: check its permissions and run again",
    errno.EPERM: "Remedy: check its permissions and run again",
    errno.ENOTDIR: "Remedy: name a folder; part of this path is a file",
    errno.EIO: "Remedy: check the disk, then ./nishiki verify, and run again",
    errno.EMFILE: "Remedy: raise the limit of open files (ulimit -n) and run again",
} | dict.fromkeys(
    (
        *(errno.ESTALE, errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ENETDOWN, errno.ETIMEDOUT),
        *(errno.ENOTCONN, errno.ECONNABORTED, errno.ECONNRESET, errno.EREMOTEIO, errno.ENODEV, errno.ENXIO),
    ),
    "Remedy: connect the disk or the network share again, then run again; what is finished is kept",
)
"""Remedy for each error number with which a machine refuses an operation."""


def describe_machine_error(error: OSError | MemoryError) -> str | None:
    """Describe a machine's lack of space, permission or memory; None for other errors, which are bugs."""
    if isinstance(error, MemoryError):
        return f"not enough memory ({error or 'the limit is reached'}). Remedy: more memory, or smaller tiles"
    remedy = OF_THE_MACHINE.get(error.errno or 0)
    where = f" ({printable(str(error.filename))})" if error.filename else ""
    return f"{os.strerror(error.errno or 0)}{where}. {remedy}" if remedy else None
