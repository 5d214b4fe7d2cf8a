"""States of the polarisers of one photograph, and whether the states of a capture can be separated."""

import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from nishiki.formats.images import read_coarse
from nishiki.formats.problems import Problem, error, refuse, warning
from nishiki.formats.text_tables import number_of
from nishiki.polarisation.series_order import fits_by_chance, series_design

Kind = Literal["none", "circular", "linear", "generator"]
FEWEST_ANGLES = 3  # a mean, a cosine and a sine are unknown
LEAST_ALIKE = 0.3  # median correlation of photographs of one view; those of the measured badges have 0.997
COARSE = 24  # blocks along the longer side
NO_SERIES = "Give the photographs other names if they are none, with --lights FILE or their cameras"
MEANS = {
    "none": "no polariser",
    "circular": "circular polarisers off or on",
    "linear": "analyser angle",
    "generator": "generator/analyser angles",
}


@dataclass(frozen=True)
class State:
    """name: canonical ('' | 'off' | 'on' | '45' | '0/90'); angles_deg: analyser, or generator and analyser."""

    name: str
    kind: Kind
    angles_deg: tuple[float, ...] = ()


def parse_state(text: str, where: str = "polariser") -> State:
    """State from a cell of frames.csv. CaptureError (polariser-unknown) where it is none."""
    text = text.strip()
    if not text:
        return State("", "none")
    if text in ("off", "on"):
        return State(text, "circular")
    angles = tuple(number_of(part) for part in text.split("/"))
    if len(angles) in (1, 2) and all(math.isfinite(a) and abs(a) <= 360 for a in angles):
        return State("/".join(f"{a + 0.0:g}" for a in angles), "linear" if len(angles) == 1 else "generator", angles)
    near = difflib.get_close_matches(text.casefold(), ("off", "on"), n=1, cutoff=0.6)
    remedy = f"Did you mean '{near[0]}'?" if near else "Angles are in degrees, at most 360"
    expected = "empty, off, on, an analyser angle (45), or generator/analyser angles (0/90)"
    refuse("polariser-unknown", where, "polariser state", expected=expected, found=repr(text), remedy=remedy)


def state_problems(states: tuple[str, ...], file: str) -> list[Problem]:
    """Whether these states belong together: all of one kind, circular ones both off and on, enough angles."""
    kinds = {parse_state(name).kind for name in states}
    if len(kinds) > 1:
        found = ", ".join(MEANS[kind] for kind in sorted(kinds))
        return [error("polariser-mixed", file, "polariser states of several kinds in one capture", found=found)]
    if kinds == {"circular"} and len(states) == 1:
        what = f"expected every view with the polariser off and on, or no states, found only '{states[0]}'"
        return [error("polariser-pair", file, what)]
    if kinds == {"linear"}:
        angles = {round(parse_state(name).angles_deg[0] % 180, 3) % 180 for name in states}
        if len(angles) < FEWEST_ANGLES:
            what = f"{len(angles)} analyser angles, half a turn apart counting once, are too few to separate reflection"
            return [warning("polariser-few", file, what, remedy="Photograph 0, 45, 90 and 135 degrees")]
    return []


def state_warnings(photographs: Sequence[Path], states: Sequence[str], source: str) -> list[Problem]:
    """Warn where photographs do not vary with the angles of generator and analyser as behind polarisers.

    CaptureError (states-contradicted) where the photographs do not show one view, or not in one size.
    """
    values = [read_coarse(path, COARSE, "linear") for path in photographs]
    if len({value.shape for value in values}) > 1:
        refuse("states-contradicted", source, "named as states of one view, but of different sizes", remedy=NO_SERIES)
    stack = np.array([value.ravel() for value in values])
    varied = stack[stack.std(axis=1) > 0]
    if len(varied) > 1 and (alike := float(np.median(np.corrcoef(varied)))) < LEAST_ALIKE:
        what, found = "named as states of one view, but they show different things", f"correlation {alike:.2f}"
        refuse("states-contradicted", source, what, found=found, remedy=NO_SERIES)
    if not fits_by_chance(stack, series_design(np.array([parse_state(state).angles_deg for state in states]))):
        return []
    what = "the photographs do not vary with these angles as light behind polarisers does"
    return [warning("states-unexplained", source, what, remedy="Check that the names are angles in degrees")]
