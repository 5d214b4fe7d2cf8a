"""One rule for which picture of a second folder (white boards, silhouettes) belongs to which photograph.

Pictures belong together by the part of their names that varies: what all names of a folder begin or end with is left
out of account (`painting_L1`, `painting_H1` and `board_L1`, `board_H1` give `L1` and `H1` in both folders), as are
capitals and leading zeros. Two running counts that never meet (`DSC0041 ...` and `DSC0101 ...`) hold no such part:
there the order is all that is known, and a warning lists the pairs. Anything else is refused.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nishiki.formats.problems import CaptureError, Problem, error, left_out, name_some, warning

Token = str | int


@dataclass(frozen=True)
class Pairing:
    """partners[i] belongs to photograph i; warnings: what was guessed, and what was left out."""

    partners: tuple[Path, ...]
    warnings: tuple[Problem, ...] = ()


def pair_by_name(photographs: Sequence[Path], others: Sequence[Path], *, what: str, folder: str) -> Pairing:
    """The picture of `others` that belongs to each photograph, each used once.

    what: how to call the others in messages ('white boards'); folder: where they are from. Names that are the same
    apart from the suffix come first, and others may then be left over; otherwise the counts must agree.
    Raises CaptureError (pairing-ambiguous, pairing-count, pairing-unmatched).
    """
    parts, present = [names_apart(paths, folder) for paths in (photographs, others)]
    by_stem = {tokens(p.stem): p for p in others}
    if all(tokens(p.stem) in by_stem for p in photographs):
        partners = tuple(by_stem[tokens(p.stem)] for p in photographs)
        left = [p.name for p in others if p not in set(partners)]
        return Pairing(partners, tuple(left_out(left, folder, f"{what} of no photograph")))
    if len(parts) != len(present):
        expected, found = f"{len(photographs)}, one a photograph", f"{len(others)}"
        remedy = f"Name the {what} as the photographs, or move the others away"
        raise CaptureError(error("pairing-count", folder, what, expected=expected, found=found, remedy=remedy))
    by_part = dict(zip(present, others, strict=True))
    if set(parts) == set(present):
        return Pairing(tuple(by_part[part] for part in parts))
    if counts_in_step(parts, present):
        partners = tuple(path for _, path in sorted(by_part.items()))
        order = sorted(range(len(parts)), key=lambda i: parts[i])
        placed = dict(zip(order, partners, strict=True))
        chosen = tuple(placed[i] for i in range(len(parts)))
        return Pairing(chosen, (_in_order(photographs, chosen, what, folder),))
    lacking = [p.name for p, part in zip(photographs, parts, strict=True) if part not in by_part]
    strange = [p.name for p, part in zip(others, present, strict=True) if part not in set(parts)]
    remedy = (
        f"Give the {what} the names of their photographs, with any prefix or suffix that all of them share; "
        "or list the pairs in frames.csv by hand"
    )
    found = f"no partner for {name_some(lacking)}; {name_some(strange)} fit no photograph"
    summary = f"{what} cannot be paired with the photographs by name"
    raise CaptureError(error("pairing-unmatched", folder, summary, found=found, remedy=remedy))


def names_apart(paths: Sequence[Path], folder: str) -> list[tuple[Token, ...]]:
    """The varying part of each name, see `varying_parts`. CaptureError (pairing-ambiguous) where two are the same."""
    names = [tokens(p.stem) for p in paths]
    first: dict[tuple, Path] = {}
    for path, name in zip(paths, names, strict=True):
        if name in first:
            remedy = "Rename one, or move it away; names must differ in more than suffix, capitals and leading zeros"
            found = f"{first[name].name}, {path.name}"
            what = "two pictures of the same name"
            raise CaptureError(error("pairing-ambiguous", folder, what, found=found, remedy=remedy))
        first[name] = path
    return varying_parts(names)


def tokens(stem: str) -> tuple[Token, ...]:
    """A name as characters without capitals, and whole numbers: 'Lamp_07' is l a m p _ 7."""
    return tuple(
        int(part) if part.isdecimal() else part for part in re.findall(r"[0-9]{1,18}|.", stem.casefold(), re.S)
    )


def varying_parts(names: Sequence[tuple[Token, ...]]) -> list[tuple[Token, ...]]:
    """The names without what they all begin and end with. One name alone has no part that varies: ()."""
    shortest = min(map(len, names), default=0)
    start = next((i for i in range(shortest) if len({name[i] for name in names}) > 1), shortest)
    room = shortest - start
    end = next((i for i in range(room) if len({name[-1 - i] for name in names}) > 1), room)
    return [name[start : len(name) - end] for name in names]


def counts_in_step(parts: Sequence[tuple], present: Sequence[tuple]) -> bool:
    """Whether both are running numbers of no common value, one set the other shifted."""
    if any(len(part) != 1 or not isinstance(part[0], int) for part in (*parts, *present)):
        return False
    ours, theirs = (sorted(part[0] for part in some) for some in (parts, present))
    return not set(ours) & set(theirs) and len({b - a for a, b in zip(ours, theirs, strict=True)}) == 1


def _in_order(photographs: Sequence[Path], chosen: Sequence[Path], what: str, folder: str) -> Problem:
    pairs = ", ".join(f"{p.name} - {q.name}" for p, q in zip(photographs, chosen, strict=True))
    summary = f"{what} have running numbers of their own: paired with the photographs in the order of the numbers"
    remedy = f"If a pair is wrong, name the {what} as the photographs and convert again"
    return warning("paired-in-order", folder, summary, found=pairs, remedy=remedy)
