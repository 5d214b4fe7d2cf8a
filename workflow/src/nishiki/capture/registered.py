"""A photograph whose camera another program found, and the lens that its photographs share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nishiki.capture.turntable_schema import Intrinsics
from nishiki.formats.problems import CaptureError, error

SHARED = (
    "The photographs are of several cameras, which share only the distortion: fx, fy, cx and cy in "
    "turntable.intrinsics are those of the first, and turntable.cameras has those of each."
)


@dataclass(frozen=True)
class RegisteredView:
    """Name below the folder of photographs, size in pixels, projection matrix (3, 4) float64 without distortion, lens.

    The matrix and the lens count pixels from the centre of the first one.
    """

    name: str
    rows: int
    columns: int
    matrix: np.ndarray
    lens: Intrinsics

    @classmethod
    def of(cls, name: str, size: tuple[int, int], lens: Intrinsics, pose: np.ndarray) -> RegisteredView:
        """size: rows, columns; pose: (3, 4) from world to camera."""
        matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]]) @ pose
        return cls(name, *size, matrix, lens)


def distorted_lens(views: Sequence[RegisteredView], file: str) -> Intrinsics | None:
    """The lens of all photographs where it is distorted, None where none is.

    CaptureError (cameras-distorted) where their distortions differ.
    """
    distortions = {view.lens.distortion for view in views}
    if len(distortions) > 1:
        what, found = "several lenses whose distortions differ", f"{len(distortions)}"
        remedy = "Photograph with one camera and lens, and have all photographs treated as of one"
        raise CaptureError(error("cameras-distorted", file, what, found=found, remedy=remedy))
    return views[0].lens if any(map(any, distortions)) else None
