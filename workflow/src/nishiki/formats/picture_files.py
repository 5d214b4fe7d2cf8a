"""Read a camera's facts on a photograph: exposure, orientation, colour space, model (Exif 2.32, CIPA DC-008)."""

import io
import logging
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, BinaryIO, Literal

import numpy as np

from nishiki.formats.coding import (
    ROMM,
    Coding,
    RgbSpace,
    choose_coding,
    exif_coding,
    icc_coding,
    icc_profile,
    png_coding,
)
from nishiki.formats.problems import CaptureError, error

MOST_BYTES = 1 << 16  # of the Exif block of a JPEG or PNG: a JPEG segment holds no more
_FACTS = (272, 274, 33434, 33437, 34665, 34855)  # model, orientation, exposure, aperture, Exif directory, sensitivity
_ADOBE_RGB = b"R03"  # interoperability index of Adobe RGB (DCF 2.0)


@dataclass(frozen=True)
class Exif:
    """Facts that a camera recorded; None or '' where the file does not state them."""

    exposure_s: float | None = None  # exposure time in seconds
    f_number: float | None = None  # focal length over aperture
    iso: float | None = None  # sensitivity
    orientation: int = 1  # 1 to 8, how a viewer would turn the picture (1: not at all)
    colour_space: str = ""  # 'srgb', 'adobe' or ''
    model: str = ""  # of the camera
    # date and time of the exposure as 'YYYY:MM:DD HH:MM:SS' with a fraction of a second where it is stated
    taken: str = ""
    focal_35mm: float | None = None  # focal length in mm of a lens with the same field on 36 x 24 mm


NO_EXIF = Exif()


def exif_of(file: BinaryIO) -> Exif:
    """Read the camera's facts of an open JPEG, PNG, TIFF or TIFF-like raw file; none where they are damaged."""
    try:
        block = _exif_block(file)
        if block is None:
            return NO_EXIF
        import tifffile

        quiet_tifffile()
        with tifffile.TiffFile(block, name="picture") as tiff:
            return exif_of_page(tiff.pages.first)
    except (struct.error, ValueError, OSError, RuntimeError, KeyError, IndexError, TypeError, OverflowError):
        return NO_EXIF


def exif_of_page(page: Any) -> Exif:
    """Read the facts in the directory of a TIFF page of tifffile, and in its Exif directory."""
    tags = {tag.name: tag.value for tag in page.tags if tag.code in _FACTS}
    inner = tags.get("ExifTag")
    values = {**tags, **inner} if isinstance(inner, dict) else tags
    index, place = b"", values.get("InteroperabilityTag")
    if isinstance(place, int):  # a directory whose first field, of 12 bytes after the count, ends in the index
        page.parent.filehandle.seek(place + 10)
        index = page.parent.filehandle.read(3)
    orientation = positive_number(values.get("Orientation"))
    space = "srgb" if values.get("ColorSpace") == 1 else "adobe" if index == _ADOBE_RGB else ""
    taken, fraction = (str(values.get(key) or "").strip() for key in ("DateTimeOriginal", "SubsecTimeOriginal"))
    return Exif(
        exposure_s=positive_number(values.get("ExposureTime")),
        f_number=positive_number(values.get("FNumber")),
        iso=positive_number(values.get("ISOSpeedRatings")),
        focal_35mm=positive_number(values.get("FocalLengthIn35mmFilm")),
        orientation=int(orientation) if orientation and orientation <= 8 else 1,
        colour_space=space,
        model=str(values.get("Model") or "").strip()[:100],
        taken=f"{taken}.{fraction}" if taken and fraction.isdecimal() else taken,
    )


def quiet_tifffile() -> None:
    """Stop tifffile from logging details of damaged files, and that an Exif block has no pixels."""
    logging.getLogger("tifffile").setLevel(logging.CRITICAL + 1)


def positive_number(value: Any) -> float | None:
    """Read a positive finite number from a whole number, a rational (numerator, denominator) or a list of one."""
    if isinstance(value, tuple) and len(value) == 2 and value[1]:
        value = value[0] / value[1]
    elif isinstance(value, tuple) and value:
        value = value[0]
    return float(value) if isinstance(value, (int, float)) and 0 < value < float("inf") else None


def _exif_block(file: BinaryIO) -> BinaryIO | None:
    """Open the TIFF stream that holds the facts: the file itself, or the block inside a JPEG or PNG."""
    file.seek(0)
    start = file.read(12)
    if start[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        file.seek(0)
        return file
    segments = jpeg_segments(file) if start[:2] == b"\xff\xd8" else png_chunks(file) if start[1:4] == b"PNG" else ()
    for mark, place, length in segments:
        file.seek(place)
        content = file.read(min(length, MOST_BYTES)) if mark in (b"\xff\xe1", b"eXIf") else b""
        if mark == b"eXIf" or content.startswith(b"Exif\0\0"):
            return io.BytesIO(content.removeprefix(b"Exif\0\0"))
    return None


def jpeg_segments(file: BinaryIO) -> Iterator[tuple[bytes, int, int]]:
    """Yield (marker of two bytes, place, length) of each segment of a JPEG before its first scan."""
    place = 2
    while True:
        file.seek(place)
        marker = file.read(2)
        while marker == b"\xff\xff":
            place += 1
            marker = b"\xff" + file.read(1)
        if len(marker) < 2 or marker[0] != 0xFF:
            return
        if marker[1] == 0x01 or 0xD0 <= marker[1] < 0xD8:
            place += 2
            continue
        (length,) = struct.unpack(">H", file.read(2))
        yield marker, place + 4, length - 2
        if marker[1] == 0xDA or length < 2:
            return
        place += 2 + length


def png_chunks(file: BinaryIO) -> Iterator[tuple[bytes, int, int]]:
    """Yield (type of four bytes, place, length) of each chunk of a PNG before its pixels."""
    place = 8
    while True:
        file.seek(place)
        heading = file.read(8)
        if len(heading) < 8 or heading[4:] == b"IDAT":
            return
        (length,) = struct.unpack(">I", heading[:4])
        yield heading[4:], place + 8, length
        place += 12 + length


Kind = Literal["png", "jpeg", "tiff", "exr", "raw"]
Sample = Literal["uint8", "uint16", "float32"]
RAW_SUFFIXES = frozenset(
    ".3fr .arw .cr2 .cr3 .crw .dcr .dng .erf .fff .iiq .kdc .mef .mos .mrw .nef .nrw .orf .pef .raf .raw .rw2 .rwl "
    ".sr2 .srf .srw .x3f".split()
)
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr"}) | RAW_SUFFIXES


@dataclass(frozen=True)
class ImageHeader:
    """Facts from a photograph's header."""

    kind: Kind
    rows: int
    columns: int
    channels: int  # as decoded, alpha included
    sample: Sample
    alpha: bool = False
    names: tuple[str, ...] = ()  # of channels without alpha, where the file names them
    stored_bytes: int = 0  # of all samples before compression, 0 where not known
    ratio: int = 0  # how many times smaller than these the file can be at most, 0 where there is no bound
    bits: int | None = None  # of a code, where they are fewer than the sample has
    coding: Coding | None = None  # None where the file states none
    exif: Exif = NO_EXIF  # facts of the camera

    def choose_coding(self, encoding: str) -> Coding:
        """Choose the coding that converts its codes to light; see `nishiki.formats.coding.choose_coding`."""
        return choose_coding(self.kind, self.coding, encoding)

    @property
    def decoded_bytes(self) -> int:
        return self.rows * self.columns * self.channels * {"uint8": 1, "uint16": 2, "float32": 4}[self.sample]


Output = Callable[[tuple[int, ...], str], np.ndarray]  # makes an array of this shape and type, of any content
MOST_RATIO = (
    4000  # of samples over a file: LZW packs 4096 bytes into 12 bits, JPEG 768 samples into one bit, deflate 1032 to 1
)
MOST_SCANS = 200  # of a JPEG; progressive ones have about ten
MOST_PROFILE = 1 << 24  # bytes of an embedded profile and of a PNG chunk that describes the picture
TAIL, BLOCK = 1 << 12, 1 << 20  # bytes in which the end of a picture is looked for first, and in turn
AS_RGB = "Save it as RGB or grey in the program that wrote it"


@dataclass(frozen=True)
class Wanted:
    """channels: requested names in order, for formats that name theirs; luma: read only the luma plane of a JPEG."""

    channels: tuple[str, ...]
    luma: bool = False


@dataclass(frozen=True)
class Picture:
    """Open picture: its header, and a function that decodes it into an array that `Output` makes.

    The array has (rows, columns, channels), an alpha channel last. profile: embedded ICC profile, or empty.
    """

    header: ImageHeader
    decode: Callable[[Wanted, Output], np.ndarray]
    profile: bytes = b""

    def with_coding(self, coding: Coding | None = None) -> "Picture":
        """Return this picture with the coding of its profile, else the given one, else that of its Exif block."""
        coding = icc_coding(self.profile) if self.profile else coding or exif_coding(self.header.exif.colour_space)
        if coding is None or not coding.developed:
            return replace(self, header=replace(self.header, coding=coding))
        if self.header.channels - self.header.alpha != 3:
            fault = f"profile of three channels in a picture of {self.header.channels - self.header.alpha}"
            return replace(self, header=replace(self.header, coding=replace(coding, developed=False, fault=fault)))
        header = replace(self.header, coding=coding, sample="uint16", bits=None)
        return Picture(header, lambda wanted, output: _develop(self, wanted, output), self.profile)


def unsupported_error(name: str, found: str, remedy: str = AS_RGB) -> CaptureError:
    """Make the error for a valid picture of an unsupported kind."""
    what = "a kind of picture that is not read"
    return CaptureError(error("image-unsupported", name, what, found=found, remedy=remedy))


def open_png(file: BinaryIO) -> Picture:
    """Open a PNG and find its last chunk; libpng verifies the checksums of its chunks when it is decoded."""
    chunks: dict[bytes, bytes] = {}
    for kind, place, length in png_chunks(file):
        if length <= MOST_PROFILE:
            file.seek(place)
            chunks.setdefault(kind, file.read(length))
    columns, rows, depth, colour = struct.unpack(">IIBB", chunks[b"IHDR"][:10])
    samples = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    if depth not in (1, 2, 4, 8, 16):
        raise ValueError(f"samples of {depth} bits")
    expect_end(file, 8, b"\0\0\0\0IEND\xaeB`\x82", "PNG")
    alpha, exif = colour in (4, 6) or b"tRNS" in chunks, exif_of(file)
    header = ImageHeader(
        "png", rows, columns, (3 if colour in (2, 3, 6) else 1) + alpha, "uint16" if depth == 16 else "uint8", alpha,
        stored_bytes=rows * (columns * samples * depth // 8), ratio=MOST_RATIO, exif=exif,
    )  # fmt: skip

    def decode(wanted: Wanted, output: Output) -> np.ndarray:
        import imagecodecs

        file.seek(0)
        out = output((rows, columns, header.channels), header.sample)
        imagecodecs.png_decode(file.read(), out=out if header.channels > 1 else out[:, :, 0])
        return out

    return Picture(header, decode).with_coding(png_coding(chunks, exif_coding(exif.colour_space)))


def open_jpeg(file: BinaryIO, name: str) -> Picture:
    """Open a JPEG of 8 bits, grey or colour; its profile may lie in several segments."""
    size, end = (0, 0, 0, 0), 0
    parts: dict[int, bytes] = {}
    for marker, place, length in jpeg_segments(file):
        file.seek(place)
        if 0xC0 <= marker[1] <= 0xCF and marker[1] not in (0xC4, 0xC8, 0xCC) and not size[3]:
            size = struct.unpack(">BHHB", file.read(6))
        elif marker[1] == 0xE2 and file.read(12) == b"ICC_PROFILE\0":
            (number, _), content = file.read(2), file.read(length - 14)
            parts[number] = content
        elif marker[1] == 0xDA:
            end = place
    depth, rows, columns, channels = size
    if not channels or not end:
        raise EOFError("JPEG without a scan" if channels else "no start of frame")
    if channels == 4:
        raise unsupported_error(name, "CMYK", "Save it as RGB: CMYK is for printing")
    if depth != 8 or channels not in (1, 3):
        raise unsupported_error(
            name, f"JPEG of {depth} bits and {channels} channels", "Save it as 8-bit RGB or as TIFF"
        )
    expect_end(file, end, b"\xff\xd9", "JPEG")
    header = ImageHeader(
        "jpeg", rows, columns, channels, "uint8", stored_bytes=rows * columns * channels, ratio=MOST_RATIO,
        exif=exif_of(file),
    )  # fmt: skip

    def decode(wanted: Wanted, output: Output) -> np.ndarray:
        import imagecodecs

        file.seek(0)
        content = file.read()
        if content.count(b"\xff\xda", end) > MOST_SCANS:
            raise ValueError(f"JPEG of more than {MOST_SCANS} scans")
        single = channels == 1 or wanted.luma
        out = output((rows, columns, 1 if single else 3), "uint8")
        imagecodecs.jpeg8_decode(
            content, outcolorspace="GRAYSCALE" if single else "RGB", out=out[:, :, 0] if single else out
        )
        return out

    return Picture(header, decode, b"".join(parts[i] for i in sorted(parts))).with_coding()


def expect_end(file: BinaryIO, start: int, mark: bytes, form: str) -> None:
    """Raise EOFError unless a mark stands between `start` and the end of the file.

    It is nearly always in the last bytes: some programs append data of their own. Nothing but the end of the picture
    may have the bytes of the mark: within the coded scan of a JPEG 0xFF is never followed by 0xD9.
    """
    end = file.seek(0, 2)
    for place in (max(start, end - TAIL), *range(start, end, BLOCK)):
        file.seek(place)
        if mark in file.read(BLOCK + len(mark)):
            return
    raise EOFError(f"{form} ends after {end} bytes, without its end marker")


def _develop(picture: Picture, wanted: Wanted, output: Output) -> np.ndarray:
    """Convert to linear light (rows, columns, channels) uint16 in ROMM primaries, by the profile, through LittleCMS.

    A pixel that is at full scale in any channel becomes white, so that it still counts as saturated.
    """
    import imagecodecs

    codes = picture.decode(wanted, np.empty)
    top = np.iinfo(codes.dtype).max
    out = output(codes.shape, "uint16")
    target = icc_profile(RgbSpace(ROMM.name, ROMM.primaries, 1.0))
    for place in range(0, len(codes), 256):
        band = np.ascontiguousarray(codes[place : place + 256, :, :3])
        linear = imagecodecs.cms_transform(
            band, picture.profile, target, colorspace="rgb", outcolorspace="rgb", outdtype="float32"
        )
        out[place : place + 256, :, :3] = np.rint(np.clip(linear, 0, 1) * 65534)
        out[place : place + 256, :, :3][(band == top).any(axis=2)] = 65535
    out[:, :, 3:] = codes[:, :, 3:].astype(np.uint16) * np.uint16(65535 // top)
    return out


_COLOURS = {"red": ("R", "red"), "green": ("G", "green"), "blue": ("B", "blue"), "grey": ("Y", "L"), "gray": ("Y", "L")}


def match_channels(present: tuple[str, ...], names: tuple[str, ...]) -> list[str]:
    """Match the requested channels of light with those of a file, in the requested order.

    A wanted name matches a channel of the same name (capitals apart), or R, G, B for red, green, blue; where they do
    not match, all channels are taken in the file's order. ValueError where the counts differ.
    """
    folded = {name.casefold(): name for name in present}
    matched = []
    for name in names:
        aliases = (name, *_COLOURS.get(name.casefold(), ()))
        matched += [folded[alias.casefold()] for alias in aliases if alias.casefold() in folded][:1]
    if len(matched) == len(names):
        return matched
    if len(present) != len(names) or several_layers(present):
        raise ValueError(f"channels {', '.join(present)} do not give {len(names)} ({', '.join(names)})")
    return list(present)


def several_layers(names: tuple[str, ...]) -> bool:
    """Check whether channels belong to different layers, so that the user has to choose."""
    return len({name.rpartition(".")[0] for name in names}) > 1
