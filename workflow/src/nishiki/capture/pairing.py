"""Match files: photographs with their masks or boards by name, files of one band each by lamp.

Pictures belong together by the part of their names that varies: what all names of a folder begin or end with is left
out of account (`painting_L1`, `painting_H1` and `board_L1`, `board_H1` give `L1` and `H1` in both folders), as are
capitals and leading zeros. Two running counts that never meet (`DSC0041 ...` and `DSC0101 ...`) hold no such part:
there the order is all that is known, and a warning lists the pairs. Anything else is refused.

A band is told by a wavelength (`lamp03_450nm.tif`, `450/lamp03.tif`), a colour (`L3_blue.png`) or a number of a filter
(`L3_band2.tif`). What is left of the name is the lamp's.
"""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from nishiki.capture.lights import SAME_DEG, Lights, lights_from_vectors
from nishiki.formats.coding import RGB
from nishiki.formats.files import same_name
from nishiki.formats.images import read_header
from nishiki.formats.problems import Problem, error, left_out, name_some, raise_errors, refuse, warning

Token = str | int


class Pairing(NamedTuple):
    """partners[i] belongs to photograph i; warnings: guesses and omitted files."""

    partners: tuple[Path, ...]
    warnings: tuple[Problem, ...] = ()


def pair_by_name(photographs: Sequence[Path], others: Sequence[Path], *, what: str, folder: str) -> Pairing:
    """Find the picture of `others` that belongs to each photograph, each used once.

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
        found = f"expected {len(photographs)} {what}, one a photograph, found {len(others)}"
        refuse("pairing-count", folder, found, remedy="Name them as the photographs, or move the others away")
    by_part = dict(zip(present, others, strict=True))
    if set(parts) == set(present):
        return Pairing(tuple(by_part[part] for part in parts))
    counts = [
        sorted(each[0] for each in some if len(each) == 1 and isinstance(each[0], int)) for some in (parts, present)
    ]
    steps = {
        b - a for a, b in zip(*counts, strict=False)
    }  # running numbers of no common value, one set the other shifted
    if [len(some) for some in counts] == 2 * [len(parts)] and not set(counts[0]) & set(counts[1]) and len(steps) == 1:
        placed = dict(zip(sorted(parts), (path for _, path in sorted(by_part.items())), strict=True))
        chosen = tuple(placed[part] for part in parts)
        pairs = ", ".join(f"{p.name} - {q.name}" for p, q in zip(photographs, chosen, strict=True))
        summary = f"{what} have running numbers of their own: paired with the photographs in the order of the numbers"
        remedy = f"If a pair is wrong, name the {what} as the photographs and convert again"
        return Pairing(chosen, (warning("paired-in-order", folder, summary, found=pairs, remedy=remedy),))
    lacking = [p.name for p, part in zip(photographs, parts, strict=True) if part not in by_part]
    strange = [p.name for p, part in zip(others, present, strict=True) if part not in set(parts)]
    remedy = (
        f"Give the {what} the names of their photographs, with any prefix or suffix that all of them share; "
        "or list the pairs in frames.csv by hand"
    )
    found = f"no partner for {name_some(lacking)}; {name_some(strange)} fit no photograph"
    summary = f"{what} cannot be paired with the photographs by name"
    refuse("pairing-unmatched", folder, summary, found=found, remedy=remedy)


def names_apart(paths: Sequence[Path], folder: str) -> list[tuple[Token, ...]]:
    """Strip the common start and end from names; one name alone has no part that varies: ().

    CaptureError (pairing-ambiguous) where two agree.
    """
    names = [tokens(p.stem) for p in paths]
    first: dict[tuple, Path] = {}
    for path, name in zip(paths, names, strict=True):
        if name in first:
            remedy = "Rename one, or move it away; names must differ in more than suffix, capitals and leading zeros"
            found = f"{first[name].name}, {path.name}"
            refuse("pairing-ambiguous", folder, "two pictures of the same name", found=found, remedy=remedy)
        first[name] = path
    shortest = min(map(len, names), default=0)
    start = next((i for i in range(shortest) if len({name[i] for name in names}) > 1), shortest)
    room = shortest - start
    end = next((i for i in range(room) if len({name[-1 - i] for name in names}) > 1), room)
    return [name[start : len(name) - end] for name in names]


def tokens(stem: str) -> tuple[Token, ...]:
    """Split a name into characters without capitals and whole numbers: 'Lamp_07' is l a m p _ 7."""
    return tuple(
        int(part) if part.isdecimal() else part for part in re.findall(r"[0-9]{1,18}|.", stem.casefold(), re.S)
    )


COLOURS = "uv ultraviolet violet royalblue blue cyan green lime yellow amber orange red".split()
COLOURS += "deepred farred nir ir infrared".split()
"""Names of bands, from short to long wavelengths."""
LETTERS = {"b": "blue", "g": "green", "r": "red"}
SHORTEST_NM, LONGEST_NM = 200, 2500
LEAST_SHARE = 0.5  # of the files of all lamps in all bands that must be there before any are called missing
PREFIX = r"(?:(?<![a-z])(?:f|wl?|led|lambda|filter|band)[ _-]?)?"
PATTERNS = (
    PREFIX + r"(?<![0-9])(?P<nm>[0-9]{3,4})[ _-]?nm(?![a-z])",
    r"(?<![a-z])(?P<colour>(?:royal|deep|far)[ _-]?(?:blue|red)|" + "|".join(COLOURS) + r")(?![a-z])",
    r"(?<![a-z])(?P<filter>(?:band|filter|ch|channel)[ _-]?[0-9]{1,2})(?![0-9])",
    r"(?<![0-9a-z])(?P<letter>[rgb])(?![0-9a-z])",
    PREFIX + r"(?<![0-9])(?P<nm>[2-9][0-9]{2}|1[0-9]{3})(?![0-9])",
)


class BandFiles(NamedTuple):
    """channels: names of the bands in order; files: by lamp, in natural order, the file of each available channel."""

    channels: tuple[str, ...]
    files: dict[str, dict[str, Path]]


class BandedPhotographs(NamedTuple):
    """files[i][k] is channel k under lights.names[i]; warnings: assumptions and omitted files."""

    lights: Lights
    channels: tuple[str, ...]
    files: tuple[tuple[Path, ...], ...]
    warnings: tuple[Problem, ...]


def sort_bands(folder: Path, pictures: Callable[[Path], list[Path]]) -> list[BandFiles]:
    """Sort the pictures of a folder, or of the folders in it, by lamp and band; one result for each way to read them.

    pictures: function that lists the pictures of a folder in natural order.
    """
    named = {path: path.relative_to(folder).with_suffix("").as_posix() for path in _all_pictures(folder, pictures)}
    readings = []
    for pattern, place in product(PATTERNS, (-1, 0)):
        files: dict[str, dict[str, Path]] = {}
        for path, name in named.items():
            lamp, band = _split_name(name, pattern, place)
            if band:
                files.setdefault(lamp, {}).setdefault(band, path)
        named_bands = {band for bands in files.values() for band in bands}
        numbers = {band: re.search(r"[0-9]+", band) for band in named_bands}
        places = {band: COLOURS.index(band) if band in COLOURS else 0 for band in named_bands}
        # wavelengths and filters by their number, then colours from short to long wavelengths
        channels = sorted(named_bands, key=lambda b: (0, int(n[0]), b) if (n := numbers[b]) else (1, places[b], b))
        if set(channels) == set(RGB):
            channels.reverse()
        if len(channels) > 1:
            readings.append(BandFiles(tuple(channels), files))
    return readings


def find_bands(
    source: Path, lights: Lights, pictures: Callable[[Path], list[Path]], *, kind: str = "direction"
) -> BandedPhotographs | None:
    """Find the bands of each lamp's photograph; None where the folder holds one photograph a lamp.

    pictures: function that lists the pictures of a folder in natural order; kind: of the lights' vectors.
    Raises CaptureError (band-missing, band-channels) where a lamp lacks a band, or files differ in their channels.
    """
    for sorted_files in sort_bands(source, pictures):
        lamps = _match_lamps(sorted_files, lights, kind)
        if lamps is None:
            continue
        chosen, kept = lamps
        table = [sorted_files.files.get(lamp, {}) for lamp in kept]
        share = sum(map(len, table)) / (len(table) * len(sorted_files.channels))
        if share >= LEAST_SHARE:
            files = complete_bands(sorted_files.channels, dict(zip(kept, table, strict=True)), str(source))
            channels, named = sorted_files.channels, {path for bands in files for path in bands}
            example = ", ".join(path.relative_to(source).as_posix() for path in files[0][:3])
            remedy = "If that is wrong, list the files in frames.csv by hand"
            what = f"the photographs are taken for {len(channels)} bands of {len(files)} lamps: {', '.join(channels)}"
            notes = [warning("bands-assumed", source.name, what, found=f"{example} of one lamp", remedy=remedy)]
            left = [path.name for path in _all_pictures(source, pictures) if path not in named]
            notes += left_out(left, str(source), "pictures of no lamp and band")
            return BandedPhotographs(chosen, channels, files, (*chosen.warnings, *notes))
    return None


def complete_bands(
    channels: Sequence[str], files: dict[str, dict[str, Path]], folder: str
) -> tuple[tuple[Path, ...], ...]:
    """List the files (lamps, channels). CaptureError: band-missing for each lamp without one, band-channels."""
    lacking = {lamp: ", ".join(name for name in channels if name not in bands) for lamp, bands in files.items()}
    problems = [
        error("band-missing", folder, f"lamp '{lamp}' has no photograph in {names}")
        for lamp, names in lacking.items()
        if names
    ]
    headers = {path: read_header(path) for bands in files.values() for path in bands.values()}
    counts = {path: header.channels - header.alpha for path, header in headers.items()}
    usual = Counter(counts.values()).most_common(1)[0][0]
    for path, count in counts.items():
        if count != usual:
            what = f"a file of one band with {count} channels, where most have {usual}"
            remedy = "Save all as grey pictures, or all in colour, without changing their values"
            problems.append(error("band-channels", path.name, what, remedy=remedy))
    raise_errors(problems)
    return tuple(tuple(bands[channel] for channel in channels) for bands in files.values())


def _all_pictures(source: Path, pictures: Callable[[Path], list[Path]]) -> list[Path]:
    """List pictures of a folder or, where it has none, of the folders in it."""
    inner = sorted(path for path in source.iterdir() if path.is_dir())
    return pictures(source) or [path for folder in inner for path in pictures(folder)]


def _split_name(name: str, pattern: str, place: int = -1) -> tuple[str, str]:
    """Split a name into the lamp's and the band's part, the band last or (place 0) first; '' where there is none."""
    found = list(re.finditer(pattern, name, re.IGNORECASE))
    if not found:
        return _strip_separators(name), ""
    match = found[place]
    groups = match.groupdict()
    band = re.sub(r"[ _-]", "", match[0]).lower()
    if groups.get("nm"):
        number = int(groups["nm"])
        band = f"{number}nm" if SHORTEST_NM <= number <= LONGEST_NM else ""
    band = LETTERS.get(band, band)
    return _strip_separators(name[: match.start()] + "/" + name[match.end() :]), band


def _strip_separators(name: str) -> str:
    """Strip a name of the separators that a band leaves behind."""
    parts = [part.strip("_-. ") for part in re.split(r"[/\\]", name)]
    return "_".join(part for part in parts if part)


def _match_lamps(sorted_files: BandFiles, lights: Lights, kind: str) -> tuple[Lights, list[str]] | None:
    """Match each light to a lamp of `sorted_files`; None where they do not belong together.

    Lights that name each file of a lamp are one light, where their directions agree.
    """
    count = sum(map(len, sorted_files.files.values()))
    lamps = list(sorted_files.files)
    if all(file is None for file in lights.files):
        if len(lamps) != len(lights.names) or count == len(lamps):
            return None
        named = lights_from_vectors(lamps, lights.vectors, file="lights", kind=kind, frontal=False)
        return named, lamps
    by_name = {same_name(lamp): lamp for lamp in lamps}
    matched = []
    for light in lights.names:  # called as the lamp, or as one of its files
        names = [_strip_separators(light), *(_split_name(light, pattern)[0] for pattern in PATTERNS)]
        matched.append(next((by_name[same_name(name)] for name in names if same_name(name) in by_name), None))
    if max(Counter(filter(None, matched)).values(), default=2) == 1:  # a lamp without any file is called missing
        kept = [lamp or light for lamp, light in zip(matched, lights.names, strict=True)]
        return (lights, kept) if count > len(lamps) else None
    known = [lamp for lamp in matched if lamp is not None]
    if len(known) < len(matched):
        return None
    first = {lamp: known.index(lamp) for lamp in known}
    same = [lights.directions[i] @ lights.directions[first[lamp]] for i, lamp in enumerate(known)]
    if min(same) < np.cos(np.radians(SAME_DEG)) or len(first) < 2:
        return None
    vectors = lights.vectors[list(first.values())]
    return lights_from_vectors(list(first), vectors, file="lights", kind=kind, frontal=False), list(first)
