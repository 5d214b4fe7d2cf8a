"""The compressed form of polynomial texture maps: JPEG streams of one channel, one for each coefficient and colour.

Nine of PTM_FORMAT_JPEG_LRGB: six coefficients, then red, green and blue. 18 of PTM_FORMAT_JPEG_RGB: the six of red,
those of green, those of blue.

A stream may hold the difference from another one (its reference, or 255 minus that where its transform is 1), plus 128
and modulo 256; streams are made in the order that the heading states. Corrections follow each stream: five bytes a
pixel, the place (4 bytes, the highest first, rows as stored) and its value. Motion vectors, which shift the reference,
are not read; no known encoder writes them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nishiki.formats.files import Refused
from nishiki.formats.images import read_jpeg_bytes
from nishiki.formats.problems import CaptureError
from nishiki.formats.text_heading import REMEDY, TextHeading

NONE = -1  # the reference of a stream that is no difference


@dataclass(frozen=True)
class PtmStreams:
    """What the heading says of each stream. steps : the number of the stream that is made first, second ..."""

    inverted: tuple[bool, ...]
    steps: tuple[int, ...]
    references: tuple[int, ...]
    sizes: tuple[int, ...]
    corrections: tuple[int, ...]

    @classmethod
    def of(cls, heading: TextHeading, count: int) -> PtmStreams:
        """Read the lists of the heading, for so many streams. Refused where they cannot be followed."""
        heading.integers(1)  # the encoder's quality
        transforms, right, down, order, references, sizes, corrections = (heading.integers(count) for _ in range(7))
        faults = {
            "motion vectors, which are not read": any(right) or any(down),
            "transforms other than 0 and 1": not set(transforms) <= {0, 1},
            "an order that is none": sorted(order) != list(range(count)),
            "sizes that cannot be": min(sizes) < 1 or min(corrections) < 0 or any(n % 5 for n in corrections),
            "a reference that is not made before its stream": any(
                each != NONE and not (0 <= each < count and order[each] < order[stream])
                for stream, each in enumerate(references)
            ),
        }
        for what, present in faults.items():
            if present:
                raise Refused(heading.name, f"compressed streams with {what}", remedy=REMEDY)
        steps = tuple(order.index(step) for step in range(count))
        return cls(tuple(each == 1 for each in transforms), steps, tuple(references), tuple(sizes), tuple(corrections))

    @property
    def bytes(self) -> int:
        """Of all streams and their corrections."""
        return sum(self.sizes) + sum(self.corrections)

    def decoded(self, stored: np.ndarray, rows: int, columns: int, name: str) -> np.ndarray:
        """(streams, rows, columns) uint8 from the bytes that follow the heading. Refused where a stream is damaged."""
        planes = np.empty((len(self.sizes), rows, columns), np.uint8)
        lengths = [length for pair in zip(self.sizes, self.corrections, strict=True) for length in pair]
        starts = np.concatenate([[0], np.cumsum(lengths)])
        for stream in self.steps:
            begin, middle, end = starts[2 * stream : 2 * stream + 3]
            plane = planes[stream]
            plane[:] = _decoded(np.array(stored[begin:middle]), rows, columns, f"{name}, stream {stream + 1}")
            reference = self.references[stream]
            if reference != NONE:
                plane += (255 - planes[reference] if self.inverted[stream] else planes[reference]) - np.uint8(128)
            fixes = np.array(stored[middle:end]).reshape(-1, 5)
            places = np.ascontiguousarray(fixes[:, :4]).view(">u4")[:, 0]
            if (places >= plane.size).any():
                raise Refused(name, "corrections beyond the picture", found=f"pixel {places.max()}", remedy=REMEDY)
            plane.reshape(-1)[places] = fixes[:, 4]
        return planes


def _decoded(stream: np.ndarray, rows: int, columns: int, name: str) -> np.ndarray:
    """The samples of one JPEG stream."""
    try:
        samples = read_jpeg_bytes(stream.tobytes(), name)
    except CaptureError as e:
        raise Refused(name, "not a whole JPEG picture", found=str(e), remedy=REMEDY) from None
    if samples.shape != (rows, columns, 1):
        expected, found = f"{rows} x {columns} x 1", " x ".join(map(str, samples.shape))
        raise Refused(name, "a JPEG picture of another size", expected=expected, found=found, remedy=REMEDY)
    return samples[:, :, 0]
