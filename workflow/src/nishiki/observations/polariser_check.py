"""Polariser states against the photographs: light of a crossed state cannot exceed that of the parallel one."""

from __future__ import annotations

import numpy as np

from nishiki.capture.frames import Frame
from nishiki.errors import UserError
from nishiki.formats.problems import Problem, error
from nishiki.observations.frames import FrameReader
from nishiki.polarisation.polariser_states import sums_of

SIDE = 96
"""Pixels of the longer side to which photographs are averaged; noise counts little then."""
EXCHANGED = 1.02
"""Light of the crossed over that of the parallel state from which the states are exchanged. Off and on give 0.3 to 0.5,
angles 0.2 to 0.99, light never more than 1; a lamp that varies between photographs adds 1 %."""
LIT = 0.1
"""Share of the brightest hundredth from which a pixel shows the object."""


class PolariserLevels:
    """Small linear pictures of each polariser state of every view, and of the white boards."""

    def __init__(self, reader: FrameReader):
        self.reader, self.pictures = reader, {}
        self.compared = len(reader.capture.states) > 1

    def add(self, frame: Frame, codes: np.ndarray, inside: np.ndarray) -> None:
        """Add a photograph: codes (rows, columns, channels), its object (rows, columns) uint8."""
        if not self.compared or not frame.polariser:
            return
        import cv2

        step = max(1, max(codes.shape[:2]) // (4 * SIDE))
        some = codes[::step, ::step]
        linear = self.reader.table[some] if codes.dtype.kind == "u" else some
        linear = (linear.mean(axis=2) - self.reader.black) * inside[::step, ::step] / (frame.exposure_s or 1.0)
        factor = min(1.0, SIDE / max(linear.shape))
        size = tuple(max(1, round(n * factor)) for n in linear.shape[::-1])
        small = cv2.resize(np.nan_to_num(linear).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        self.pictures.setdefault((frame.role, frame.light, frame.view), {})[frame.polariser] = small

    def problems(self) -> list[Problem]:
        """One error that names the views, or the white boards, that are brighter in the crossed state."""
        ratios = {key: _crossed_over_parallel(pictures) for key, pictures in self.pictures.items()}
        odd = {key: ratio for key, ratio in ratios.items() if ratio is not None and ratio > EXCHANGED}
        if not odd:
            return []
        samples = [view for role, _, view in odd if role == "sample"]
        frames = ["white boards"] if len(samples) < len(odd) else []
        if samples:
            all_odd = len(samples) == sum(role == "sample" for role, _, _ in ratios)
            frames.insert(0, "object" if all_odd else "views " + ", ".join(dict.fromkeys(samples)))
        what = "the crossed polariser state is brighter than the parallel one, which light cannot be"
        found = f"{max(odd.values()):.2f} times as bright at most"
        remedy = "Exchange off and on (or parallel and crossed angles) in the column polariser of frames.csv for "
        remedy += f"the {' and the '.join(frames)}; or check exposure_s, where exposures differ between the states"
        return [error("polarisers-exchanged", "frames.csv", what, expected="never", found=found, remedy=remedy)]


def _crossed_over_parallel(pictures: dict[str, np.ndarray]) -> float | None:
    """Light of the crossed over that of the parallel states over the object; None for states of other kinds."""
    try:
        sums = sums_of(tuple(pictures))
    except UserError:
        return None
    if sums.method not in ("circular", "crossed", "pairs"):
        return None
    parallel, crossed = np.tensordot(sums.weights, np.stack(list(pictures.values())), axes=1)
    total = parallel + crossed
    lit = total > LIT * np.percentile(total, 99)
    bright = float(parallel[lit].sum())
    return float(crossed[lit].sum()) / bright if bright > 0 else None
