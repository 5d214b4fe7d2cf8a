"""Pictures in every layout that programs write: photometric interpretation, bits, planes, tiles, compression,
predictor, byte order, alpha, pages. Each is decoded to its very codes, or refused by the name of what it is."""

import tempfile
from collections import Counter
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import tifffile

from nishiki.formats.images import read_codes, read_header
from nishiki.formats.problems import CaptureError

ROWS, COLUMNS = 37, 50
TOP = {1: 1, 2: 3, 4: 15, 8: 255, 10: 1023, 12: 4095, 14: 16383, 16: 65535}


@dataclass
class Layout:
    """A picture as tifffile writes it, and what is right: `codes`, or a word of the refusal."""

    name: str
    values: np.ndarray
    codes: np.ndarray | None
    options: dict = field(default_factory=dict)
    byteorder: str = "<"
    big: bool = False
    exact: int = 0
    refusal: str = ""
    pages: tuple = ()

    def write(self, path):
        with tifffile.TiffWriter(path, byteorder=self.byteorder, bigtiff=self.big) as tiff:
            for values, options in self.pages or ((self.values, self.options),):
                tiff.write(values, **{"metadata": None, **options})


def smooth(channels, top, seed=0):
    """Codes (rows, columns, channels) of gentle slopes with some noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:ROWS, 0:COLUMNS]
    planes = [(x * (3 + k) + y * (5 - k)) / (3 * COLUMNS + 5 * ROWS + k * COLUMNS) for k in range(channels)]
    return np.clip(np.stack(planes, 2) * top + rng.integers(0, 2, (ROWS, COLUMNS, channels)), 0, top)


def typed(channels, bits):
    values = smooth(channels, TOP.get(bits, 1))
    return values.astype(np.uint8 if bits <= 8 else np.uint16)


def layouts():
    """Every layout of the matrix."""
    found = []
    photometric = {1: "minisblack", 3: "rgb"}
    packings = [(None, False), ("lzw", False), ("lzw", True), ("zlib", False), ("zlib", True), ("zstd", False),
                ("zstd", True), ("lzma", False), ("packbits", False)]  # fmt: skip
    for channels, bits, (packing, predicted) in product((1, 3), (8, 16), packings):
        values = typed(channels, bits)
        for planar, tiled, order in (("contig", False, "<"), ("contig", False, ">"), ("contig", True, "<"),
                                     ("separate", False, "<"), ("separate", True, ">")):  # fmt: skip
            if planar == "separate" and channels == 1:
                continue
            stored = np.moveaxis(values, 2, 0) if planar == "separate" else values if channels == 3 else values[..., 0]
            options = {"photometric": photometric[channels], "compression": packing, "predictor": predicted}
            options |= {"planarconfig": planar} if channels == 3 else {}
            options |= {"tile": (16, 32)} if tiled else {"rowsperstrip": 11}
            name = f"{channels}x{bits} {packing}{'+predictor' * predicted} {planar} {'tiles' * tiled} {order}"
            found.append(Layout(name, stored, values, options, order))
    for bits, big, packing in product((16, 32, 64), (False, True), (None, "zlib", "lzw", "zstd")):
        values = (smooth(3, 1) * 0.9).astype(f"f{bits // 8}")
        right = values.astype(np.float32)
        for predicted in (False, True) if packing else (False,):
            options = {"photometric": "rgb", "compression": packing, "predictor": predicted}
            found.append(Layout(f"float{bits} {packing} {predicted} big {big}", values, right, options, big=big))
    for bits, packing in (*((bits, None) for bits in (1, 2, 4, 10, 12, 14)), (1, "zlib"), (1, "packbits")):
        values = typed(1, bits)
        right = (values * (255 // TOP[bits])).astype(np.uint8) if bits < 8 else values
        stored = values[..., 0].astype(bool) if bits == 1 else values[..., 0]
        options = {"photometric": "minisblack", "compression": packing}
        options |= {} if bits == 1 else {"bitspersample": bits}
        found.append(Layout(f"{bits} bits {packing}", stored, right, options))
    for bits, packing, order in product((1, 8, 16), (None, "zlib"), ("<", ">")):
        values = typed(1, bits)
        right = ((1 - values) * 255).astype(np.uint8) if bits == 1 else (TOP[bits] - values).astype(values.dtype)
        stored = values[..., 0].astype(bool) if bits == 1 else values[..., 0]
        options = {"photometric": "miniswhite", "compression": packing}
        found.append(Layout(f"WhiteIsZero {bits} {packing} {order}", stored, right, options, order))
    for bits, channels, kind, planar in product((8, 16), (1, 3), ("unassalpha", "assocalpha"), ("contig", "separate")):
        values = typed(channels, bits)
        alpha = np.full((ROWS, COLUMNS, 1), TOP[bits], values.dtype)
        alpha[:10] = TOP[bits] // 2 + 1
        light = values.copy()
        if kind == "assocalpha":
            light = np.rint(light * (alpha / TOP[bits])).astype(values.dtype)
        stored = np.concatenate([light, alpha], axis=2)
        stored = np.moveaxis(stored, 2, 0) if planar == "separate" else stored
        options = {"photometric": photometric[channels], "extrasamples": [kind], "planarconfig": planar}
        found.append(Layout(f"{kind} {channels}x{bits} {planar}", stored, values, options, exact=1))
    for bits in (8, 16):
        palette = np.random.default_rng(1).integers(0, 256, (3, 1 << 8), dtype=np.uint16) * 257
        values = typed(1, 8)[..., 0]
        right = np.moveaxis(palette[:, values] >> 8, 0, 2).astype(np.uint8)
        if bits == 8:
            found.append(Layout("palette", values, right, {"photometric": "palette", "colormap": palette}))
        bands = np.stack([typed(1, bits)[..., 0] // (k + 1) for k in range(6)], 2)
        for planar in ("contig", "separate"):
            stored = np.moveaxis(bands, 2, 0) if planar == "separate" else bands
            options = {"photometric": "minisblack", "planarconfig": planar, "compression": "lzw"}
            options |= {"extrasamples": ["unspecified"] * 5}
            found.append(Layout(f"six bands {bits} {planar}", stored, bands, options))
        pages = tuple((bands[:, :, k], {"photometric": "minisblack", "compression": "zlib"}) for k in range(6))
        found.append(Layout(f"six pages {bits}", bands, bands, pages=pages))
    for bits in (8, 16):
        four = typed(4, bits)
        for kind in ([], ["unspecified"]):  # saved selections of image editors
            options = {"photometric": "rgb", "extrasamples": kind} if kind else {"photometric": "rgb"}
            found.append(Layout(f"RGB and {kind or 'no word'} {bits}", four, four[..., :3], options))
    rgb = typed(3, 16)
    small = rgb[::4, ::4]
    for flag, order in product((0, 1), ("first", "last")):
        picture, preview = (rgb, {"photometric": "rgb"}), (small, {"photometric": "rgb", "subfiletype": flag})
        pages = (preview, picture) if order == "first" else (picture, preview)
        found.append(Layout(f"preview {flag} {order}", rgb, rgb, pages=pages))
    found.append(Layout("two colour pages", rgb, None, refusal="2 pages", pages=((rgb, {"photometric": "rgb"}),) * 2))
    eight = typed(3, 8)
    for space in ("rgb", "ycbcr"):  # tifffile takes what it is given for luma and chroma
        options = {"photometric": space, "compression": "jpeg", "compressionargs": {"level": 98}}
        right = eight if space == "rgb" else cv2.cvtColor(eight[..., [0, 2, 1]], cv2.COLOR_YCrCb2RGB)
        found.append(Layout(f"JPEG {space}", eight, right, options, exact=32))
    tiles = {"photometric": "rgb", "compression": "jpeg", "compressionargs": {"level": 98}, "tile": (32, 32)}
    found.append(Layout("JPEG tiles", eight, eight, tiles, exact=32))
    found.append(
        Layout(
            "JPEG grey",
            eight[..., 0],
            eight[..., :1],
            {"photometric": "minisblack", "compression": "jpeg", "compressionargs": {"level": 98}},
            exact=8,
        )
    )
    found.append(Layout("JPEG 2000", rgb, rgb, {"photometric": "rgb", "compression": "jpeg2000"}, exact=0))
    for bits, packing in product((8, 16), (None, "zlib")):
        four = typed(4, bits)
        found.append(
            Layout(
                f"CMYK {bits} {packing}",
                four,
                None,
                {"photometric": "separated", "compression": packing},
                refusal="CMYK",
            )
        )
        three = typed(3, bits)
        for model, word in (("cielab", "CIELab"), ("icclab", "ICCLab"), ("itulab", "ITULab")):
            found.append(
                Layout(
                    f"{model} {bits} {packing}",
                    three,
                    None,
                    {"photometric": model, "compression": packing},
                    refusal=word,
                )
            )
    found.append(Layout("YCbCr", eight, None, {"photometric": "ycbcr"}, refusal="YCbCr"))
    found.append(Layout("mosaic", typed(1, 16)[..., 0], None, {"photometric": "cfa"}, refusal="mosaic"))
    for dtype, word in (("i1", "signed"), ("i2", "signed"), ("u4", "32 bits"), ("i4", "signed"), ("c8", "complex")):
        values = np.abs(smooth(1, 100)[..., 0]).astype(dtype)
        found.append(Layout(f"samples {dtype}", values, None, {"photometric": "minisblack"}, refusal=word))
    found.append(Layout("WhiteIsZero float", smooth(1, 1)[..., 0].astype("f4"), None, {"photometric": "miniswhite"},
                        refusal="WhiteIsZero"))  # fmt: skip
    return found


def outcome(layout, path):
    """'right', 'wrong', 'refused by name' or 'refused', of one layout."""
    layout.write(path)
    try:
        header = read_header(path)
        names = tuple(f"c{i}" for i in range(header.channels - header.alpha))
        codes = read_codes(path, names, header=header)
    except CaptureError as caught:
        problem = caught.problems[0]
        named = layout.refusal and layout.refusal in f"{problem.what} {problem.found}"
        return "refused by name" if named and problem.kind == "image-unsupported" else "refused"
    if layout.codes is None or codes.shape != layout.codes.shape or codes.dtype != layout.codes.dtype:
        return "wrong"
    if codes.dtype.kind == "f":
        return "right" if np.array_equal(codes, layout.codes) else "wrong"
    return "right" if np.abs(codes.astype(int) - layout.codes).max() <= layout.exact else "wrong"


def test_a_layout_gives_its_codes_or_is_refused_by_its_name(tmp_path):
    outcomes = {layout.name: outcome(layout, tmp_path / f"{i}.tif") for i, layout in enumerate(layouts())}
    expected = {layout.name: "refused by name" if layout.codes is None else "right" for layout in layouts()}
    assert {name: found for name, found in outcomes.items() if found != expected[name]} == {}
    assert len(outcomes) > 250


if __name__ == "__main__":  # the table of outcomes, for another version of the package too
    with tempfile.TemporaryDirectory() as folder:
        counted = Counter(
            ("sound" if layout.codes is not None else "other", outcome(layout, Path(folder) / f"{i}.tif"))
            for i, layout in enumerate(layouts())
        )
    print(sum(counted.values()), dict(counted))
