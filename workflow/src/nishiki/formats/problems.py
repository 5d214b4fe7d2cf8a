"""Describe problems of a capture, with remedies for the person at the camera."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NoReturn

from nishiki.errors import UserError, printable

MOST_LISTED = 100
"""Problems of one kind in one file that are listed; those that follow hardly tell more."""
MOST_NAMED = 5
"""Maximum number of further files named in a line."""
FEW, SEVERAL = 3, 8
"""Limits up to which problems of one kind with different facts, or also different remedies, are listed apart."""
WHERE_IS_IT = "Correct the path; ./nishiki convert makes a capture of photographs, ./nishiki demo makes one to try"


@dataclass(frozen=True)
class Problem:
    """One problem. `kind` is a stable identifier; `file` is relative to the capture (with a row or page if known)."""

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
        first, *others = [str(problem) for problem in group_problems(errors)] or ["capture cannot be used"]
        text = first + "".join(f"\n  also: {other}" for other in others[:11])
        text += f"\n  and {len(others) - 11} more" if len(others) > 11 else ""
        super().__init__(text)


def error(kind: str, file: str, what: str, *, expected: str = "", found: str = "", remedy: str = "") -> Problem:
    """Make a problem that makes the capture unusable."""
    return Problem("error", kind, file, what, expected, found, remedy)


def warning(kind: str, file: str, what: str, *, expected: str = "", found: str = "", remedy: str = "") -> Problem:
    """Make a problem to report to the user; the capture remains usable."""
    return Problem("warning", kind, file, what, expected, found, remedy)


def refuse(kind: str, file: str, what: str, *, expected: str = "", found: str = "", remedy: str = "") -> NoReturn:
    """Raise the CaptureError of one problem that makes the capture unusable."""
    raise CaptureError(error(kind, file, what, expected=expected, found=found, remedy=remedy))


def raise_errors(problems: Iterable[Problem]) -> None:
    """Raise one CaptureError that holds every error among the problems; return where there is none."""
    errors = [p for p in problems if p.severity == "error"]
    if errors:
        raise CaptureError(errors)


def name_some(names: Iterable[object]) -> str:
    """List the first names, and the number of the others."""
    texts = [str(name) for name in names]
    more = f" and {len(texts) - MOST_NAMED} more" if len(texts) > MOST_NAMED else ""
    return ", ".join(texts[:MOST_NAMED]) + more


def error_text(sigma: float, decimals: int) -> str:
    """Write a standard error as `± 0.3`; below the last digit as `± < 0.1`, never as 0."""
    least = 10.0**-decimals
    return f"± < {least:.{decimals}f}" if sigma < least / 2 else f"± {sigma:.{decimals}f}"


def left_out(names: Sequence[object], file: str, what: str) -> list[Problem]:
    """Make photograph-unlisted for omitted pictures; what: their description. Empty without names."""
    return [warning("photograph-unlisted", file, f"{what} were left out", found=name_some(names))] if names else []


def expect_one(files: Sequence[Path], place: Path, what: str, remedy: str) -> Path | None:
    """Return the only file; None without. CaptureError (layout-unknown) where there are several."""
    if len(files) > 1:
        refuse("layout-unknown", str(place), what, found=name_some(path.name for path in files), remedy=remedy)
    return files[0] if files else None


def group_problems(problems: Iterable[Problem]) -> list[Problem]:
    """Join problems that are equal but for their files, and many of one kind, into one with their number.

    The first of them stands for all, in its place. Problems of one kind that differ in their facts are joined from four
    on, those whose remedies differ from nine on.
    """
    groups: dict[tuple[str, str], list[Problem]] = {}
    for problem in dict.fromkeys(problems):
        groups.setdefault((problem.severity, problem.kind), []).append(problem)
    joined: list[Problem] = []
    for group in groups.values():
        remedies = {p.remedy for p in group}
        alike = {replace(p, file="") for p in group}
        apart = 1 if len(alike) == 1 else FEW if len(remedies) == 1 else SEVERAL
        joined += group if len(group) <= apart else [_join_problems(group)]
    return joined


def _join_problems(group: list[Problem]) -> Problem:
    """Join several problems into one, with their number and the differences: their files, or their facts."""
    places = [p.file for p in group]
    if len(set(places)) < len(places):
        places = [p.what for p in group] if len({p.what for p in group}) == len(group) else [p.found for p in group]
    named = ", ".join(dict.fromkeys(places[1 : MOST_NAMED + 1]))
    more = f" and {len(group) - MOST_NAMED - 1} more" if len(group) > MOST_NAMED + 1 else ""
    return replace(group[0], what=f"{group[0].what} (the first of {len(group)}; also {named}{more})")
