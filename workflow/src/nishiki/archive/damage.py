"""What can be wrong with an archive, and how it is told."""

from dataclasses import dataclass
from pathlib import Path

KINDS = {
    "damaged": "the content is not what was written",
    "missing": "a file, or an artifact that another was made from, is not there",
    "foreign": "a file that nobody listed, or that is no regular file",
    "swapped": "the content of another file of the same artifact",
    "link": "a symbolic link where there may be none, or one that leads out of its scene",
    "unreadable": "the system does not let it be read",
    "wrong-key": "the name is not what settings and upstream artifacts give",
    "misplaced": "an artifact in the folder of another stage or scene",
    "stale": "made from another version of an upstream artifact than the present one",
    "incomplete": "a packed scene lacks a part of the way from the photographs to the result",
}


@dataclass(frozen=True)
class Damage:
    """One thing that is not as it should be. artifact: folder of the artifact that is no longer sound, if any is."""

    path: Path
    kind: str
    detail: str
    artifact: Path | None = None

    def __str__(self) -> str:
        return f"{self.kind}: {shown(self.path)} ({shown(self.detail)})"


def shown(text: object) -> str:
    """Text for a terminal: a name of a stranger's file can neither break the line nor control the terminal."""
    plain = str(text).encode("utf-8", "backslashreplace").decode("utf-8")
    return "".join(character if character.isprintable() else ascii(character)[1:-1] for character in plain)
