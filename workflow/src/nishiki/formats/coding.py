"""Convert a picture's codes to light: curves and primaries that a file states, and profiles that state them.

Sources, the first that a file has: PNG chunk cICP, embedded ICC profile, PNG chunks sRGB and gAMA, TIFF transfer
function, Exif colour space. Curves are those of ICC.1:2022, 10.18: with code x and linear light y, both 0 to 1,
y = (a x + b)^g + e from x = d on, y = c x + f below; or a table over equal steps of x. Profiles that are written are
matrix profiles with one power law.
"""

import struct
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

RGB = ("red", "green", "blue")
LUMA_WEIGHTS = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601, the weights of a JPEG's luma plane
D50 = (0.9642, 1.0, 0.8249)
"""White of the profile connection space, ICC.1:2022, 6.3.4.3."""


@dataclass(frozen=True)
class RgbSpace:
    """An RGB space whose white is D50: name, x and y of red, green and blue, exponent of its power law."""

    name: str
    primaries: tuple[tuple[float, float], ...]
    gamma: float

    def to_xyz(self) -> np.ndarray:
        """Compute the matrix (3, 3) from linear RGB to XYZ relative to D50, white Y = 1."""
        columns = np.array([[x / y, 1.0, (1.0 - x - y) / y] for x, y in self.primaries]).T
        return columns * np.linalg.solve(columns, np.array(D50))


ROMM = RgbSpace("ROMM RGB (ProPhoto)", ((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001)), 1.8)
"""ISO 22028-2, with a pure power law. It contains every colour of real surfaces."""


def icc_profile(space: RgbSpace) -> bytes:
    """Encode the profile; the same space gives the same bytes."""
    curve = b"para" + bytes(4) + struct.pack(">HH", 0, 0) + _encode_fixed(space.gamma)
    matrix = space.to_xyz()
    tags = {}
    for tag, text in ((b"desc", space.name), (b"cprt", "No copyright, use freely")):
        coded = text.encode("utf-16-be")  # multiLocalizedUnicodeType, one record in English
        tags[tag] = b"mluc" + bytes(4) + struct.pack(">II2s2sII", 1, 12, b"en", b"US", len(coded), 28) + coded
    tags[b"wtpt"] = _xyz(D50)
    for column, letter in enumerate(b"rgb"):
        tags[bytes([letter]) + b"XYZ"] = _xyz(matrix[:, column])
        tags[bytes([letter]) + b"TRC"] = curve
    start = 128 + 4 + 12 * len(tags)
    table, data = [struct.pack(">I", len(tags))], b""
    for tag, content in tags.items():
        table.append(tag + struct.pack(">II", start + len(data), len(content)))
        data += content + bytes(-len(content) % 4)
    size = start + len(data)
    header = struct.pack(">I4sI4s4s4s", size, bytes(4), 0x04300000, b"mntr", b"RGB ", b"XYZ ")
    header += struct.pack(">6H", 2026, 1, 1, 0, 0, 0) + b"acsp" + bytes(28) + _numbers(D50) + bytes(48)
    return header + b"".join(table) + data


def _encode_fixed(value: float) -> bytes:
    """Encode an s15Fixed16Number."""
    return struct.pack(">i", round(value * 65536))


def _numbers(values: tuple[float, ...] | np.ndarray) -> bytes:
    return b"".join(_encode_fixed(float(value)) for value in values)


def _xyz(values: tuple[float, ...] | np.ndarray) -> bytes:
    return b"XYZ " + bytes(4) + _numbers(values)


MOST_STEPS = 4096  # of a table; longer ones are resampled
SAME = 2e-3  # of full scale: curves nearer than that are the same (sRGB as a formula and as 1024 points)
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
"""Cone responses of the adaptation that ICC profiles use (ICC.1:2022, annex E)."""
D65 = (0.3127, 0.3290)


@dataclass(frozen=True)
class TransferCurve:
    """Transfer curve of codes: `formula` (g, a, b, c, d, e, f), or `table` over equal steps where it has values."""

    formula: tuple[float, ...] = (1.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    table: tuple[float, ...] = ()

    def decode(self, codes: np.ndarray) -> np.ndarray:
        """Convert codes of any shape to linear values, float64, full scale 1."""
        codes = np.asarray(codes, np.float64)
        if self.table:
            return np.interp(codes, np.linspace(0, 1, len(self.table)), self.table)
        g, a, b, c, d, e, f = self.formula
        return np.where(codes >= d, np.maximum(a * codes + b, 0) ** g + e, c * codes + f)

    def differs_from(self, other: "TransferCurve") -> bool:
        """Check whether two curves give light that differs by more than `SAME`."""
        steps = np.linspace(0, 1, 257)
        return bool(np.abs(self.decode(steps) - other.decode(steps)).max() > SAME)


LINEAR = TransferCurve()
SRGB = TransferCurve((2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045, 0.0, 0.0))
BT709 = TransferCurve((1 / 0.45, 1 / 1.099, 0.099 / 1.099, 1 / 4.5, 0.081, 0.0, 0.0))
Matrix = tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class Coding:
    """A file's statements about its codes."""

    name: str  # for the user, with its source
    curve: TransferCurve = LINEAR  # of every channel
    # (3, 3) from linear red, green, blue to XYZ relative to D50, None where no primaries are stated
    to_xyz: Matrix | None = None
    fault: str = ""  # why the statement cannot be used, or ''
    # the reader has applied the statement itself (channels of different curves, or a table of colours), codes are
    # linear
    developed: bool = False

    @property
    def linear(self) -> bool:
        """Return whether codes are proportional to light."""
        return not self.curve.differs_from(LINEAR)

    @property
    def encoding(self) -> Literal["linear", "srgb"]:
        """Encoding for comparing pictures of this coding: equal steps of any curve look about alike."""
        return "linear" if self.linear else "srgb"

    @property
    def to_srgb(self) -> np.ndarray | None:
        """(3, 3) from linear values in the file's primaries to linear sRGB; None where they are the same or unknown."""
        if self.to_xyz is None:
            return None
        matrix = np.linalg.solve(np.array(SRGB_XYZ), np.array(self.to_xyz))
        return None if np.allclose(matrix, np.eye(3), atol=SAME) else matrix

    def differs_from(self, other: "Coding") -> bool:
        """Check whether two codings give different light: another curve or other primaries."""
        if self.curve.differs_from(other.curve):
            return True
        mine, its = (SRGB_XYZ if each.to_xyz is None else each.to_xyz for each in (self, other))
        return not np.allclose(mine, its, atol=5 * SAME)


def choose_coding(kind: str, stated: Coding | None, encoding: str) -> Coding:
    """Choose the coding by which a picture is decoded.

    kind: of the file; stated: what the file states; encoding: `file`, or `linear` or `srgb` in place of its curve.
    Without a statement JPEG is sRGB and all else linear. What the reader has applied already stays applied.
    """
    if stated is not None and (stated.developed or encoding == "file"):
        return stated
    if encoding == "srgb" or (encoding == "file" and kind == "jpeg"):
        return Coding("sRGB, not stated by the files", SRGB, stated.to_xyz if stated else None)
    return Coding("linear, not stated by the files", LINEAR, stated.to_xyz if stated else None)


def coding_from(values: dict[str, Any] | None) -> Coding | None:
    """Rebuild a coding from its plain values (`dataclasses.asdict`, after JSON)."""
    if values is None:
        return None
    curve = TransferCurve(*(tuple(values["curve"][key]) for key in ("formula", "table")))
    matrix = values["to_xyz"] and tuple((row[0], row[1], row[2]) for row in values["to_xyz"])
    return Coding(values["name"], curve, matrix, values["fault"], values["developed"])


def primaries_xyz(primaries: tuple[tuple[float, float], ...], white: tuple[float, float] = D65) -> Matrix:
    """Compute the matrix (3, 3) to XYZ relative to D50 from x, y of red, green, blue and white, adapted by Bradford."""
    columns = np.array([[x / y, 1.0, (1.0 - x - y) / y] for x, y in primaries]).T
    light = np.array([white[0] / white[1], 1.0, (1.0 - white[0] - white[1]) / white[1]])
    scale = (BRADFORD @ np.array(D50)) / (BRADFORD @ light)
    return as_matrix(np.linalg.solve(BRADFORD, scale[:, None] * BRADFORD) @ (columns * np.linalg.solve(columns, light)))


def as_matrix(values: np.ndarray) -> Matrix:
    return tuple((float(row[0]), float(row[1]), float(row[2])) for row in values)


BT709_XY = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
ADOBE_XY = ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06))
SRGB_XYZ = primaries_xyz(BT709_XY)
_XY = {
    1: BT709_XY,
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
}
_SPACES = {1: "BT.709", 9: "BT.2020", 12: "Display P3"}
_TRANSFERS = {
    **dict.fromkeys((1, 6, 14, 15), ("curve of BT.709", BT709)),
    4: ("gamma 2.2", TransferCurve((2.2, *LINEAR.formula[1:]))),
    5: ("gamma 2.8", TransferCurve((2.8, *LINEAR.formula[1:]))),
    8: ("linear", LINEAR),
    13: ("curve of sRGB", SRGB),
}
"""Curves by the codes of ITU-T H.273, tables 2 and 3."""


def exif_coding(colour_space: str) -> Coding | None:
    """Return the coding that a camera names in its Exif block: 'srgb' or 'adobe' (DCF 2.0)."""
    if colour_space == "adobe":
        return Coding("Adobe RGB (Exif)", TransferCurve((563 / 256, *LINEAR.formula[1:])), primaries_xyz(ADOBE_XY))
    return Coding("sRGB (Exif)", SRGB, SRGB_XYZ) if colour_space == "srgb" else None


def png_coding(chunks: dict[bytes, bytes], exif: Coding | None) -> Coding | None:
    """Read the coding of a PNG from the content of its chunks before the pixels (PNG, third edition, 4.3)."""
    if len(code := chunks.get(b"cICP", b"")) == 4:
        primaries, transfer = code[0], code[1]
        name = f"{_SPACES.get(primaries, f'primaries {primaries}')}, cICP"
        if transfer not in _TRANSFERS:
            return Coding(name, fault=f"transfer function {transfer} of H.273")
        words, curve = _TRANSFERS[transfer]
        return Coding(f"{name}, {words}", curve, primaries_xyz(_XY[primaries]) if primaries in _XY else None)
    if b"iCCP" in chunks:
        import zlib

        _, _, packed = chunks[b"iCCP"].partition(b"\0")
        try:
            return icc_coding(zlib.decompressobj().decompress(packed[1:], 1 << 24))
        except zlib.error:
            return Coding("embedded ICC profile", fault="damaged ICC profile")
    if b"sRGB" in chunks:
        return Coding("sRGB, PNG chunk", SRGB, SRGB_XYZ)
    if len(gamma := chunks.get(b"gAMA", b"")) == 4 and (value := int.from_bytes(gamma, "big")):
        curve = TransferCurve((100_000 / value, *LINEAR.formula[1:]))
        corners = np.frombuffer(chunks.get(b"cHRM", b""), ">u4").reshape(-1, 2) / 1e5
        sound = len(corners) == 4 and (corners > 0).all()
        xy = tuple((float(x), float(y)) for x, y in corners)
        matrix = primaries_xyz(xy[1:], xy[0]) if sound else None
        return Coding(f"gamma {100_000 / value:.3g}, PNG chunk gAMA", curve, matrix)
    return exif


def transfer_function(values: tuple[int, ...], bits: int) -> Coding | None:
    """Read the coding of a TIFF from its TransferFunction: one table of 2^bits values, or one a channel of three."""
    table = np.array(values, float) / 65535
    if len(table) == 3 << bits:
        table = table.reshape(3, -1)
        if np.abs(table - table[0]).max() > SAME:
            return Coding("TIFF transfer function", fault="different tables of the three channels")
        table = table[0]
    return Coding("TIFF transfer function", TransferCurve(table=_resample(table))) if len(table) == 1 << bits else None


def _resample(table: np.ndarray) -> tuple[float, ...]:
    steps = np.linspace(0, 1, min(len(table), MOST_STEPS))
    return tuple(float(value) for value in np.interp(steps, np.linspace(0, 1, len(table)), table))


def icc_coding(profile: bytes) -> Coding:
    """Read the coding that an ICC profile describes: a matrix with curves, a grey curve, or tables (`developed`)."""
    try:
        return _icc_coding(profile)
    except (struct.error, IndexError, ValueError, OverflowError) as error:
        return Coding("embedded ICC profile", fault=f"damaged ICC profile ({error})")


def _icc_coding(profile: bytes) -> Coding:
    tags, space = icc_tags(profile)
    name = f"{_description(tags.get(b'desc', b''))}, embedded ICC profile"
    if space == b"GRAY" and b"kTRC" in tags:
        return Coding(name, _curve(tags[b"kTRC"]))
    if space != b"RGB ":
        return Coding(name, fault=f"ICC profile of {space.decode('latin-1').strip()}, not of RGB")
    if all(tag in tags for tag in (b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC")):
        curves = [_curve(tags[tag]) for tag in (b"rTRC", b"gTRC", b"bTRC")]
        columns = [np.array(struct.unpack(">3i", tags[tag][8:20])) / 65536 for tag in (b"rXYZ", b"gXYZ", b"bXYZ")]
        matrix = as_matrix(np.stack(columns, axis=1))
        if not any(curve.differs_from(curves[0]) for curve in curves[1:]):
            return Coding(name, curves[0], matrix)
    elif b"A2B0" not in tags:
        return Coding(name, fault="ICC profile without curves and tables")
    return Coding(name, LINEAR, as_matrix(ROMM.to_xyz()), developed=True)


def icc_tags(profile: bytes) -> tuple[dict[bytes, bytes], bytes]:
    """Read the tagged elements of an ICC profile and the signature of its colour space. ValueError where it is none."""
    if profile[36:40] != b"acsp":
        raise ValueError("no ICC signature")
    (count,) = struct.unpack(">I", profile[128:132])
    if count > 200:
        raise ValueError(f"{count} tags")
    tags = {}
    for place in range(132, 132 + 12 * count, 12):
        tag, start, length = struct.unpack(">4sII", profile[place : place + 12])
        tags[tag] = profile[start : start + length]
    return tags, profile[16:20]


def _curve(element: bytes) -> TransferCurve:
    kind = element[:4]
    if kind == b"para":
        (form,) = struct.unpack(">H", element[8:10])
        count = (1, 3, 4, 5, 7)[form]
        values = [v / 65536 for v in struct.unpack(f">{count}i", element[12 : 12 + 4 * count])]
        g, a, b, c, d, e, f = (*values, *LINEAR.formula[count:])[:7]
        if form in (1, 2):  # the power from x = -b / a on, a constant (c, or 0) below
            e = f = c if form == 2 else 0.0
            c, d = 0.0, -b / a if a else 0.0
        return TransferCurve((g, a, b, c, d, e, f))
    if kind != b"curv":
        raise ValueError(f"curve of type {kind!r}")
    (count,) = struct.unpack(">I", element[8:12])
    if count == 0:
        return LINEAR
    steps = np.frombuffer(element[12 : 12 + 2 * count], ">u2")
    if len(steps) != count:
        raise ValueError("curve cut off")
    return (
        TransferCurve((float(steps[0]) / 256, *LINEAR.formula[1:]))
        if count == 1
        else TransferCurve(table=_resample(steps / 65535))
    )


def _description(element: bytes) -> str:
    if element[:4] == b"mluc" and len(element) >= 28:
        length, start = struct.unpack(">II", element[20:28])
        text = element[start : start + length].decode("utf-16-be", "replace")
    else:
        (length,) = struct.unpack(">I", element[8:12]) if len(element) >= 12 else (0,)
        text = element[12 : 12 + length].decode("latin-1")
    return "".join(c for c in text if c.isprintable()).strip()[:80] or "profile without a name"
