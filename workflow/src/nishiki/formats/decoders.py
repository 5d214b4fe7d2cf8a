"""Decoders of TIFF, OpenEXR and camera raw, which are imported in the process that decodes pictures only.

TIFF: every layout that tifffile reads: bits, planes apart, tiles, compressions, predictors, byte orders, BigTIFF. Field
numbers: TIFF 6.0 (Adobe, 1992) and its technical notes. OpenEXR: the light channels of one layer, placed in the display
window; half or float. A channel is called LAYER.NAME (OpenEXR Technical Introduction); alpha, depth and identifiers are
no light. Camera raw through LibRaw: linear, the camera's own colours, no white balance, no gamma, 16 bits.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, BinaryIO

import numpy as np
import tifffile

from nishiki.formats.coding import D65, LINEAR, Coding, Matrix, primaries_xyz, transfer_function
from nishiki.formats.picture_files import (
    AS_RGB,
    MOST_RATIO,
    Exif,
    ImageHeader,
    Output,
    Picture,
    Sample,
    Wanted,
    exif_of,
    exif_of_page,
    match_channels,
    positive_number,
    quiet_tifffile,
    unsupported_error,
)
from nishiki.formats.problems import CaptureError, error
from nishiki.installation import install_command

MOST_PAGES = 256  # of a file
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
        raise unsupported_error(name, found, MODEL_REMEDY.get(found, AS_RGB))
    if model == WHITE_IS_ZERO and sample == "float32":
        raise unsupported_error(name, "WhiteIsZero in floating point", "Save it as BlackIsZero")
    shapes = {(page.imagelength, page.imagewidth, page.samplesperpixel, page.dtype) for page in pages}
    if len(shapes) > 1 or (len(pages) > 1 and first.samplesperpixel > 1):
        found = f"{len(pages)} pages of {' and '.join(sorted(str(shape[:3]) for shape in shapes))} samples"
        raise unsupported_error(name, found, "Keep the page of the photograph alone; bands are pages of one channel")
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
        ratio=1 if all(page.compression == NONE_PACKED for page in pages) else MOST_RATIO,
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
    return Picture(header, decode, first.iccprofile or b"").with_coding(coding)


def _full_pages(tiff: tifffile.TiffFile) -> list[tifffile.TiffPage]:
    """List pages that are no previews and no masks, of the file's chain or else of the pages below."""
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
    """Raise ValueError where a field describing the pixels is damaged: tifffile ignores such fields."""
    tiff, file = page.parent.tiff, page.parent.filehandle
    file.seek(page.offset)
    (count,) = struct.unpack(tiff.tagnoformat, file.read(tiff.tagnosize))
    entries = file.read(count * tiff.tagsize)
    codes = {struct.unpack_from(tiff.byteorder + "H", entries, place)[0] for place in range(0, len(entries) - 1,
                                                                                          tiff.tagsize)}  # fmt: skip
    if damaged := sorted(code for code in codes & _PIXEL_FIELDS if code not in page.tags):
        raise ValueError(f"TIFF field {damaged[0]} is damaged")


def _is_preview(page: tifffile.TiffPage) -> bool:
    """Check whether a page is one of reduced resolution or a transparency mask (NewSubfileType, SubfileType)."""
    return bool(page.subfiletype & 5) or page.tags.valueof(255) == 2 or page.imagelength * page.imagewidth == 0


def _sample(page: tifffile.TiffPage, name: str) -> tuple[Sample, int | None]:
    """Return the type of the decoded samples, and their significant bits where these are fewer."""
    bits, form = page.bitspersample, int(page.sampleformat)
    if form == 3 and bits in (16, 24, 32, 64):
        return "float32", None
    if form != 1 or not 1 <= bits <= 16:
        kind = {1: "unsigned", 2: "signed", 3: "floating-point"}.get(form, "complex")
        remedy = "Save it with unsigned 8 or 16 bits, or as 32-bit floating point"
        raise unsupported_error(name, f"{kind} samples of {bits} bits", remedy)
    return ("uint16", None if bits == 16 else bits) if bits > 8 else ("uint8", None)


def _stored_bytes(page: tifffile.TiffPage) -> int:
    """Compute the bytes of a page's samples before compression. ValueError where its pieces are out of proportion."""
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


_NO_LIGHT = frozenset("a alpha z zback zf depth depth.z id mask ar ag ab ra ga ba".split())
_BEAUTY = ("", "combined", "beauty", "rgba", "rgb", "composite", "default", "main")
"""Last word of the name of the layer with the whole light, in order of preference; '' has no layer."""
_RATIO = {"NO_COMPRESSION": 1, "RLE_COMPRESSION": 130, "ZIPS_COMPRESSION": 1040, "ZIP_COMPRESSION": 1040}
"""Largest possible compression ratio of a coded part; other compressions have no bound."""


@dataclass(frozen=True)
class _Channel:
    """A channel of light: number of its part, name in it, name of its layer, and its own name without that."""

    part: int
    stored: str
    layer: str
    base: str


def open_exr(file: BinaryIO, name: str) -> Picture:
    """Open the picture of an EXR: of the layer that holds all light, else of the only one, else every layer's channels.

    Channels of several layers, none of them the whole light, have the names of their layers; `match_channels` takes
    those that are wanted. ValueError or RuntimeError where the file is damaged.
    """
    import OpenEXR

    path = f"/dev/fd/{file.fileno()}"
    with OpenEXR.File(path, header_only=True) as opened:
        headers = [dict(part.header) for part in opened.parts]
    if any(header["type"] in (OpenEXR.deepscanline, OpenEXR.deeptile) for header in headers):
        raise ValueError("deep images (several samples a pixel) are not read")
    windows = [_window(header["dataWindow"]) for header in headers]
    present = [channel for part, header in enumerate(headers) for channel in _channels(header, part)]
    light = [channel for channel in present if channel.base.casefold() not in _NO_LIGHT]
    channels = _light(light or [channel for channel in present if channel.base == "A"])  # a mask may be alpha alone
    layers = {(channel.part, channel.layer) for channel in channels}
    alpha = [
        channel for channel in present if light and channel.base == "A" and layers == {(channel.part, channel.layer)}
    ]
    if not channels:
        raise unsupported_error(name, "chroma sub-sampled or no channels of light", "Save it with channels R, G and B")
    window = _window(headers[0]["displayWindow"] if "displayWindow" in headers[0] else headers[0]["dataWindow"])
    stored = [window[2] * window[3] * len(each["channels"]) for window, each in zip(windows, headers, strict=True)]
    if sum(stored[1:]) > 8 * max(stored[0], 1):
        raise ValueError("the file's further parts are much larger than its first")
    coding = Coding("linear, OpenEXR", LINEAR, _primaries(headers[0].get("chromaticities")))
    exposure, aperture, speed = (positive_number(headers[0].get(key)) for key in ("expTime", "aperture", "isoSpeed"))
    names = tuple(channel.base for channel in channels)
    if names not in (("R", "G", "B"), ("Y",)):
        names = tuple(".".join(filter(None, (channel.layer, channel.base))) for channel in channels)
    # half floats at least: a header tells no types of its channels
    header = ImageHeader(
        "exr", window[2], window[3], len(channels) + len(alpha), "float32", bool(alpha), names=names,
        stored_bytes=2 * sum(stored), ratio=_RATIO.get(headers[0]["compression"].name, 0), coding=coding,
        exif=Exif(exposure, aperture, speed),
    )  # fmt: skip

    def decode(wanted: Wanted, output: Output) -> np.ndarray:
        stored = {channel.stored.casefold(): channel for channel in channels}
        order = [stored[name.casefold()] for name in wanted.channels if name.casefold() in stored]
        if len(order) != len(wanted.channels):
            order = [channels[header.names.index(name)] for name in match_channels(header.names, wanted.channels)]
        out = output((header.rows, header.columns, len(order) + len(alpha)), "float32")
        out[...] = 0
        with OpenEXR.File(path, separate_channels=True) as opened:
            for place, channel in enumerate([*order, *alpha]):
                values = opened.channels(channel.part)[channel.stored].pixels
                data = windows[channel.part]
                top, left = data[0] - window[0], data[1] - window[1]
                rows = slice(max(top, 0), max(min(top + data[2], header.rows), 0))
                columns = slice(max(left, 0), max(min(left + data[3], header.columns), 0))
                part = values[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
                out[rows, columns, place] = part  # what lies in the display window
        return out

    return Picture(header, decode)


def _channels(header: dict[str, Any], part: int) -> list[_Channel]:
    """List a part's channels of full resolution, its own name before those of its layers where it has one."""
    found, name = [], str(header.get("name", ""))
    name = "" if name.casefold() in _BEAUTY else name
    for channel in header["channels"]:
        layer, _, base = channel.name.rpartition(".")
        full = channel.xSampling == channel.ySampling == 1
        if full and base.casefold() not in ("ry", "by"):
            found.append(_Channel(part, channel.name, ".".join(filter(None, (name, layer))), base))
    return found


def _light(found: list[_Channel]) -> list[_Channel]:
    """Select channels of the best layer, red, green and blue first; of all layers where none stands out."""
    layers: dict[str, list[_Channel]] = {}
    for channel in found:
        layers.setdefault(channel.layer, []).append(channel)

    def rank(layer: str) -> int:
        last = layer.rpartition(".")[2].casefold()
        return _BEAUTY.index(last) if last in _BEAUTY else len(_BEAUTY)

    best = sorted(layers, key=rank)[:1]
    first = [layer for layer in layers if rank(layer) == rank(best[0])] if best else []
    chosen = layers[best[0]] if len(first) == 1 else [channel for layer in first for channel in layers[layer]]
    order = {"R": 0, "G": 1, "B": 2}
    return sorted(chosen, key=lambda c: (c.layer, order.get(c.base, 3), c.base))


def _window(corners: tuple[np.ndarray, np.ndarray]) -> tuple[int, int, int, int]:
    """Compute row, column, rows, columns of a window between two corners (x, y), both inclusive."""
    (left, top), (right, bottom) = (tuple(int(n) for n in corner) for corner in corners)
    return top, left, bottom - top + 1, right - left + 1


def _primaries(corners: Any) -> Matrix | None:
    """Convert the attribute `chromaticities` (x, y of red, green, blue, white) to a matrix (3, 3) to XYZ."""
    if corners is None:
        return None
    try:
        xy = np.asarray(corners, float).reshape(4, 2)
    except (TypeError, ValueError, struct.error):
        return None
    pairs = tuple((float(x), float(y)) for x, y in xy)
    return primaries_xyz(pairs[:3], pairs[3] if pairs[3][1] > 0 else D65) if (xy[:, 1] != 0).all() else None


def open_raw(file: BinaryIO, name: str) -> Picture:
    """Open a camera's raw file: three channels, or one of a sensor without colour filters."""
    try:
        import rawpy
    except ImportError as e:
        remedy = f"Install it with {install_command(('rawpy',))}, or develop to 16-bit linear TIFF first"
        raise CaptureError(error("raw-support", name, "camera raw needs the package rawpy", remedy=remedy)) from e
    exif = exif_of(file)
    file.seek(0)
    try:
        with rawpy.imread(file) as raw:
            sizes, channels, other = raw.sizes, 1 if raw.num_colors == 1 else 3, raw.other
    except Exception as e:  # LibRaw's own errors, and what its binding makes of a file that is none
        remedy = "Copy the file again from the camera, or develop it to 16-bit linear TIFF with its own program"
        found = e.args[0].decode() if e.args and isinstance(e.args[0], bytes) else str(e)
        raise CaptureError(
            error("image-unreadable", name, "camera raw cannot be read", found=found, remedy=remedy)
        ) from e
    if exif.exposure_s is None and other is not None:  # raw files that are no TIFF
        exif = replace(exif, exposure_s=other.shutter_speed or None, f_number=other.aperture or None,
                       iso=other.iso_speed or None)  # fmt: skip
    stored = 2 * sizes.raw_height * sizes.raw_width
    header = ImageHeader(
        "raw", sizes.height, sizes.width, channels, "uint16", stored_bytes=stored,
        coding=Coding("linear, camera raw"), exif=exif,
    )  # fmt: skip
    return Picture(header, lambda wanted, output: _develop_raw(rawpy, file, wanted, output))


def _develop_raw(rawpy: Any, file: BinaryIO, wanted: Wanted, output: Output) -> np.ndarray:
    """Develop to (rows, columns, channels) uint16, 65535 at the sensor's white level, black level subtracted.

    Bilinear demosaicing: it is the same linear filter in every frame, so ratios between lights, on which photometric
    stereo rests, are not disturbed as they are by methods that follow edges. The white level is the camera's and not
    that of the brightest pixel (LibRaw's default), which would scale each frame differently.
    """
    file.seek(0)
    with rawpy.imread(file) as raw:
        developed = raw.postprocess(
            demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
            output_color=rawpy.ColorSpace.raw,
            output_bps=16,
            gamma=(1, 1),
            no_auto_bright=True,
            adjust_maximum_thr=0.0,
            use_camera_wb=False,
            use_auto_wb=False,
            user_wb=[1.0, 1.0, 1.0, 1.0],
            user_flip=0,
        )
    out = output(developed.shape, "uint16")
    out[...] = developed
    return out
