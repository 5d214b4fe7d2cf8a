"""TIFF in every layout that tifffile reads: bits, planes apart, tiles, compressions, predictors, byte orders, BigTIFF.

Field numbers: TIFF 6.0 (Adobe, 1992) and its technical notes.
"""

import struct
from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np
import tifffile

from nishiki.formats.coding import transfer_function
from nishiki.formats.exif import exif_of_page, quiet_tifffile
from nishiki.formats.picture_files import AS_RGB, ImageHeader, Output, Picture, Sample, Wanted, unsupported

MOST_PAGES = 256  # of a file
PACKED_RATIO = 4000  # LZW: codes of 12 bits for at most 4096 bytes, deflate 1032
NONE_PACKED, WHITE_IS_ZERO, GREY, RGB, PALETTE, YCBCR, LINEAR_RAW = 1, 0, 1, 2, 3, 6, 34892
BY_JPEG = (6, 7, 34892, 33007)  # compressions that turn YCbCr into RGB themselves
OTHER_MODELS = {5: "CMYK", 8: "CIELab", 9: "ICCLab", 10: "ITULab", 32803: "a sensor's mosaic (CFA)", 32844: "LogL",
                32845: "LogLuv"}  # fmt: skip
MODEL_REMEDY = {"CMYK": "Save it as RGB: CMYK is for printing", "YCbCr": AS_RGB}
ASSOCIATED, UNASSOCIATED = 1, 2
_PIXEL_FIELDS = {*range(254, 260), 262, 266, 273, 277, 278, 279, 284, 317, 320, *range(322, 326), 338, 339, 347}


def open_tiff(file: BinaryIO, name: str) -> Picture:
    """Open the picture of a TIFF: its one page, or pages of one channel and equal size as channels.

    Previews are passed over: pages that say so, and pages smaller than half of the largest one.
    """
    quiet_tifffile()
    file.seek(0)
    tiff = tifffile.TiffFile(file, name="picture")
    pages = _full_pages(tiff)
    for page in pages:
        _expect_fields(page)
    first = pages[0]
    sample, bits = _sample(first, name)
    model = int(first.photometric)
    if model in OTHER_MODELS or (model == YCBCR and int(first.compression) not in BY_JPEG):
        found = OTHER_MODELS.get(model, "YCbCr")
        raise unsupported(name, found, MODEL_REMEDY.get(found, AS_RGB))
    if model == WHITE_IS_ZERO and sample == "float32":
        raise unsupported(name, "WhiteIsZero in floating point", "Save it as BlackIsZero")
    shapes = {(page.imagelength, page.imagewidth, page.samplesperpixel, page.dtype) for page in pages}
    if len(shapes) > 1 or (len(pages) > 1 and first.samplesperpixel > 1):
        found = f"{len(pages)} pages of {' and '.join(sorted(str(shape[:3]) for shape in shapes))} samples"
        raise unsupported(name, found, "Keep the page of the photograph alone; bands are pages of one channel")
    samples = 3 if model == PALETTE else first.samplesperpixel
    extra = tuple(int(kind) for kind in first.extrasamples)
    alpha = bool(extra) and samples in (2, 4) and extra[-1] in (ASSOCIATED, UNASSOCIATED)
    alpha |= model == RGB and samples == 4  # a fourth sample of RGB is no colour, whatever it is
    end = file.seek(0, 2)
    for page in pages:
        if any(place + size > end for place, size in zip(page.dataoffsets, page.databytecounts, strict=True)):
            raise EOFError(f"image data beyond the end of the file ({end} bytes)")
    header = ImageHeader(
        "tiff", first.imagelength, first.imagewidth, samples * len(pages), sample, alpha,
        stored_bytes=sum(_stored_bytes(page) for page in pages),
        ratio=1 if all(page.compression == NONE_PACKED for page in pages) else PACKED_RATIO,
        bits=bits, exif=exif_of_page(first),
    )  # fmt: skip

    def decode(wanted: Wanted, output: Output) -> np.ndarray:
        out = output((header.rows, header.columns, header.channels), sample)
        for i, page in enumerate(pages):
            _decode_page(page, out[:, :, i * samples : (i + 1) * samples])
        if extra[-1:] == (ASSOCIATED,):
            # undo the multiplication of colour by alpha, the last channel, where it is neither 0 nor full
            top = np.float32(1.0) if out.dtype.kind == "f" else np.float32(np.iinfo(out.dtype).max)
            partial = (out[:, :, -1] > 0) & (out[:, :, -1] < top)
            if partial.any():
                chosen = out[partial].astype(np.float32)
                chosen[:, :-1] *= top / chosen[:, -1:]
                out[partial] = chosen if out.dtype.kind == "f" else np.rint(np.minimum(chosen, top))
        return out

    table, depth = first.tags.valueof(301), first.bitspersample  # TransferFunction
    stated = isinstance(table, (tuple, np.ndarray)) and depth <= 16
    coding = transfer_function(tuple(table), depth) if stated else None
    return Picture(header, decode, first.iccprofile or b"").coded(coding)


def _full_pages(tiff: tifffile.TiffFile) -> list[tifffile.TiffPage]:
    """Pages that are no previews and no masks, of the file's chain or else of the pages below."""
    chain: list[tifffile.TiffPage] = []
    for number in range(MOST_PAGES + 1):
        try:
            chain.append(tiff.pages[number].aspage())
        except IndexError:
            break
    if len(chain) > MOST_PAGES:
        raise ValueError(f"TIFF of more than {MOST_PAGES} pages")
    full = [page for page in chain if not _is_preview(page)]
    if not full:
        below = [sub.aspage() for page in chain for sub in (page.pages or ())]
        full = [page for page in below[:MOST_PAGES] if not _is_preview(page)]
    if not full:
        raise ValueError("TIFF without an image")
    largest = max(page.imagelength * page.imagewidth for page in full)
    return [page for page in full if 2 * page.imagelength * page.imagewidth > largest]


def _expect_fields(page: tifffile.TiffPage) -> None:
    """ValueError where a field of the directory that describes the pixels is damaged: tifffile passes over those."""
    tiff, file = page.parent.tiff, page.parent.filehandle
    file.seek(page.offset)
    (count,) = struct.unpack(tiff.tagnoformat, file.read(tiff.tagnosize))
    entries = file.read(count * tiff.tagsize)
    codes = {struct.unpack_from(tiff.byteorder + "H", entries, place)[0] for place in range(0, len(entries) - 1,
                                                                                          tiff.tagsize)}  # fmt: skip
    if damaged := sorted(code for code in codes & _PIXEL_FIELDS if code not in page.tags):
        raise ValueError(f"TIFF field {damaged[0]} is damaged")


def _is_preview(page: tifffile.TiffPage) -> bool:
    """Whether a page is one of reduced resolution or a transparency mask (NewSubfileType, SubfileType)."""
    return bool(page.subfiletype & 5) or page.tags.valueof(255) == 2 or page.imagelength * page.imagewidth == 0


def _sample(page: tifffile.TiffPage, name: str) -> tuple[Sample, int | None]:
    """Type of the decoded samples, and their significant bits where these are fewer."""
    bits, form = page.bitspersample, int(page.sampleformat)
    if form == 3 and bits in (16, 24, 32, 64):
        return "float32", None
    if form != 1 or not 1 <= bits <= 16:
        kind = {1: "unsigned", 2: "signed", 3: "floating-point"}.get(form, "complex")
        remedy = "Save it with unsigned 8 or 16 bits, or as 32-bit floating point"
        raise unsupported(name, f"{kind} samples of {bits} bits", remedy)
    return ("uint16", None if bits == 16 else bits) if bits > 8 else ("uint8", None)


def _stored_bytes(page: tifffile.TiffPage) -> int:
    """Bytes of a page's samples before compression. ValueError where its pieces are out of proportion to it."""
    rows, columns = page.imagelength, page.imagewidth
    if page.is_tiled and not (0 < page.tilewidth <= columns + 65536 and 0 < page.tilelength <= rows + 65536):
        raise ValueError(f"TIFF tiles of {page.tilelength} x {page.tilewidth} samples")
    if not page.is_tiled and page.rowsperstrip < 1:
        raise ValueError("TIFF strips without rows")
    if page.imagedepth > 1:
        raise ValueError(f"TIFF volume of {page.imagedepth} layers")
    return rows * (columns * page.samplesperpixel * page.bitspersample // 8)


def _decode_page(page: tifffile.TiffPage, out: np.ndarray) -> None:
    """Fill (rows, columns, channels) from the strips or tiles of a page. ValueError where one is missing or short."""
    planes, _, rows, columns, depth = page.shaped
    down = -(-rows // (page.tilelength if page.is_tiled else page.rowsperstrip))
    pieces = planes * down * (-(-columns // page.tilewidth) if page.is_tiled else 1)
    if len(page.dataoffsets) < pieces:
        raise ValueError(f"TIFF with {len(page.dataoffsets)} pieces where {pieces} are needed")
    codes = out if page.photometric != PALETTE else np.empty((rows, columns, 1), page.dtype)
    tables = {"jpegtables": page.jpegtables, "jpegheader": page.jpegheader} if page.compression in BY_JPEG else {}
    decoder: Callable[..., Any] = page.decode
    file = page.parent.filehandle
    for index, (place, size) in enumerate(zip(page.dataoffsets[:pieces], page.databytecounts[:pieces], strict=True)):
        file.seek(place)
        content = file.read(size)
        if not content:
            raise ValueError("TIFF image data are missing")
        values, (plane, _, top, left, _), shape = decoder(content, index, **tables)
        target = codes[top : top + shape[1], left : left + shape[2], plane : plane + depth]
        target[...] = values[0, : target.shape[0], : target.shape[1]]
    if page.photometric == PALETTE:
        colours = np.asarray(page.colormap)
        out[...] = (colours >> 8 if colours.max() > 255 else colours)[:, codes[:, :, 0]].transpose(1, 2, 0)
        return
    if out.dtype.kind == "u":
        top_code = (1 << page.bitspersample) - 1
        if page.bitspersample < 8:
            out[...] = (np.arange(top_code + 1) * 255 // top_code).astype(np.uint8)[out]
        if page.photometric == WHITE_IS_ZERO:
            light = out[:, :, : out.shape[2] - len(page.extrasamples)]
            np.subtract(255 if page.bitspersample < 8 else top_code, light, out=light)
