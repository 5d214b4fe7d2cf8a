"""What the stores of all three geometries share: counting photographs, judging their samples, the small arrays."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np

from nishiki.capture.frames import Frame
from nishiki.capture.seal import sha256_of
from nishiki.formats.files import Refused
from nishiki.formats.problems import CaptureError, Problem, error, group_problems, warning
from nishiki.formats.stored import BandedGroup
from nishiki.formats.text_tables import refusal
from nishiki.observations.frames import FrameReader

if TYPE_CHECKING:
    from nishiki.observations.corrections import Wishes

ALL_SATURATED = 0.99  # share of the object, of a photograph that cannot be used
MANY_SATURATED = 0.05  # share of the object
Tick = Callable[[str], None]


class Settings(Protocol):
    """What ingest reads of its settings (`nishiki.stages.ingest.IngestSettings`)."""

    channels: str
    white_block: int
    tile_mib: int
    compression: Literal["none", "zstd"]
    without: tuple[str, ...]
    correct: "Wishes"


class PhotographCounter:
    """Called with the file of each photograph done; calls progress(done, of, file)."""

    def __init__(self, progress: Callable[[int, int, str], None] | None, total: int):
        self.progress, self.total, self.done = progress, total, 0

    def __call__(self, file: str) -> None:
        self.done += 1
        if self.progress:
            self.progress(self.done, self.total, file)


def refuse_unusable(frame: Frame, *, bright: bool, black: bool, shown: str, leave_out: str) -> None:
    """CaptureError (all-saturated, all-dark) for a photograph that cannot be used; shown: what of it is black."""
    if bright:
        remedy = f"Expose less, or leave this {leave_out} out"
        raise CaptureError(error("all-saturated", frame.file, "the whole object is saturated", remedy=remedy))
    if black:
        remedy = f"Expose longer, or leave this {leave_out} out"
        raise CaptureError(error("all-dark", frame.file, f"the whole {shown} is black", remedy=remedy))


def sample_warnings(frame: Frame, broken: int, saturated: int, inside: int, *, shown: str = "object") -> list[Problem]:
    """Warnings of a photograph's counts: samples that are not finite, many saturated ones of the `inside` pixels."""
    problems = []
    if broken:
        what = "NaN or infinite samples are not used"
        problems.append(warning("not-finite", frame.file, what, found=f"{broken} pixels"))
    if saturated > MANY_SATURATED * inside:
        found = f"{100 * saturated / inside:.1f} % of the {shown}"
        problems.append(warning("many-saturated", frame.file, "many saturated samples", found=found))
    return problems


def attempt(work: Callable[[], Iterable[Problem]]) -> list[Problem]:
    """List the problems that some work finds, or those that end it."""
    try:
        return list(work())
    except CaptureError as e:
        return list(e.problems)
    except Refused as e:
        return [refusal(e, "file-refused")]


def describe_samples(
    reader: FrameReader, counts: np.ndarray, inside: np.ndarray | int, problems: Iterable[Problem]
) -> dict[str, Any]:
    """Describe the samples of frames by their counts (frames, ..): saturated, dark and not finite ones.

    The first two are given as shares of the pixels `inside`, (frames,) or one number; beside them channels, type, how
    codes became light, and warnings.
    """
    return {
        "channels": reader.names,
        "dtype": str(reader.dtype),
        "saturated": tuple((counts[:, 0] / inside).tolist()),
        "dark": tuple((counts[:, 1] / inside).tolist()),
        "not_finite": tuple(counts[:, 2].tolist()),
        "warnings": tuple(map(str, group_problems(problems))),
        "coding": reader.coding.name,
    }


def examine_frames(
    reader: FrameReader,
    frames: Sequence[Frame],
    look: Callable[[Frame, Callable[[], np.ndarray]], Iterable[Problem]],
    tick: Tick,
) -> list[Problem]:
    """Decode frames, the next one ahead, and list what `look`, given a frame and its codes, finds in each.

    Samples that are not finite are errors. A warning (image-repeated) names files that are the same as one before.
    """
    problems: list[Problem] = []
    known: dict[str, str] = {}
    for frame, codes in reader.read_ahead(frames):
        found = attempt(partial(look, frame, codes))
        problems += [replace(p, severity="error") if p.kind == "not-finite" else p for p in found]
        for part in frame.parts:
            first = known.setdefault(sha256_of(part.path), part.file)
            if first != part.file:
                what, remedy = f"is the same file as {first}", "Check the names of the photographs"
                problems.append(warning("image-repeated", part.file, what, remedy=remedy))
        tick(frame.file)
    return problems


def write_small_arrays(
    group: BandedGroup, reader: FrameReader, defect: np.ndarray, arrays: dict[str, np.ndarray]
) -> None:
    """Write these arrays, the linearisation `lut` of integer codes, and `defect` where a pixel has one."""
    if reader.dtype.kind == "u":
        arrays = {**arrays, "lut": reader.table}
    if defect.any():
        arrays = {**arrays, "defect": defect.astype(np.uint8)}
    for name, values in arrays.items():
        unknown = {"nan": "the white board cannot be used there: no sample counts"} if name == "gain" else None
        group.create_array(name, values.shape, values.shape, values.dtype, attributes=unknown)[...] = values
