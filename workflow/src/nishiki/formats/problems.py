"""What can be wrong with a capture, said so that the person at the camera can mend it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from nishiki.errors import UserError, printable

WHERE_IS_IT = "Correct the path; ./nishiki convert makes a capture of photographs, ./nishiki demo makes one to try"


@dataclass(frozen=True)
class Problem:
    """One finding. `kind` is a stable identifier; `file` is relative to the capture (with a row or page if known)."""

    severity: Literal["error", "warning"]
    kind: str
    file: str
    what: str
    expected: str = ""
    found: str = ""
    remedy: str = ""

    def __str__(self) -> str:
        facts = [f"expected {self.expected}"] if self.expected else []
        facts += [f"found {self.found}"] if self.found else []
        text = f"{self.file}: {self.what}" if self.file else self.what
        text += f": {', '.join(facts)}" if facts else ""
        return printable(f"{text}. {self.remedy}" if self.remedy else text)


class CaptureError(UserError):
    """One or more errors in a capture; `problems` holds all that were found together."""

    def __init__(self, problems: Problem | Iterable[Problem]):
        self.problems = (problems,) if isinstance(problems, Problem) else tuple(problems)
        errors = [p for p in self.problems if p.severity == "error"] or list(self.problems)
        text = str(errors[0]) if errors else "capture cannot be used"
        if len(errors) > 1:
            text += "".join(f"\n  also: {p}" for p in errors[1:12])
            text += f"\n  and {len(errors) - 12} more" if len(errors) > 12 else ""
        super().__init__(text)


def error(kind: str, file: str, what: str, *, expected: str = "", found: str = "", remedy: str = "") -> Problem:
    """A finding with which the capture cannot be used."""
    return Problem("error", kind, file, what, expected, found, remedy)


def warning(kind: str, file: str, what: str, *, expected: str = "", found: str = "", remedy: str = "") -> Problem:
    """A finding that the user should know of; the capture remains usable."""
    return Problem("warning", kind, file, what, expected, found, remedy)


def raise_errors(problems: Iterable[Problem]) -> None:
    """Raise one CaptureError that holds every error among the problems; return where there is none."""
    errors = [p for p in problems if p.severity == "error"]
    if errors:
        raise CaptureError(errors)
