"""What a photograph says of itself, and the kinds of photographs that are read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from nishiki.formats.coding import Coding, coding_from, coding_used
from nishiki.formats.exif import NO_EXIF, Exif

Kind = Literal["png", "jpeg", "tiff", "exr", "raw"]
Sample = Literal["uint8", "uint16", "float32"]
RAW_SUFFIXES = frozenset(
    ".3fr .arw .cr2 .cr3 .crw .dcr .dng .erf .fff .iiq .kdc .mef .mos .mrw .nef .nrw .orf .pef .raf .raw .rw2 .rwl "
    ".sr2 .srf .srw .x3f".split()
)
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr"}) | RAW_SUFFIXES


@dataclass(frozen=True)
class ImageHeader:
    """What a photograph says of itself. channels: as decoded, alpha included; names: of channels without alpha, where
    the file names them.

    stored_bytes: of all samples before compression, 0 where not known; ratio: how many times smaller than these the
    file can be at most, 0 where there is no bound; bits: of a code, where they are fewer than the sample has; coding:
    None where the file states none; exif: facts of the camera.
    """

    kind: Kind
    rows: int
    columns: int
    channels: int
    sample: Sample
    alpha: bool = False
    names: tuple[str, ...] = ()
    stored_bytes: int = 0
    ratio: int = 0
    bits: int | None = None
    coding: Coding | None = None
    exif: Exif = NO_EXIF

    def coding_used(self, encoding: str) -> Coding:
        """The coding by which its codes become light; see `nishiki.formats.coding.coding_used`."""
        return coding_used(self.kind, self.coding, encoding)

    @property
    def decoded_bytes(self) -> int:
        return self.rows * self.columns * self.channels * {"uint8": 1, "uint16": 2, "float32": 4}[self.sample]


def header_from(values: dict[str, Any]) -> ImageHeader:
    """Rebuild a header from its plain values (`dataclasses.asdict`, after JSON)."""
    built = {"names": tuple(values["names"]), "coding": coding_from(values["coding"]), "exif": Exif(**values["exif"])}
    return ImageHeader(**{**values, **built})
