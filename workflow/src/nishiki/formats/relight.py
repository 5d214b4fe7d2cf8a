"""Relightable images as folders: `info.json` and pictures of coefficients, as relight writes and OpenLIME reads them.

Three coefficients a picture, `plane_N.jpg` or the tiles of a deep zoom (`plane_N.dzi`): value = (code / 255 - bias)
scale, for values 0 to 1. In the colour space rgb the red, green and blue of each term follow each other; in lrgb the
first picture is a colour, and the terms are those of a brightness that multiplies it; in mrgb the planes weigh
principal components, whose values at the captured lights are in info.json. Terms: polynomials (ptm; Malzbender and
others, 2001), hemispherical (hsh; Gautron and others, 2004) and spherical harmonics (sh), Gaussians between lights
(rbf; Ponchio, Corsini and Scopigno, 2018).
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.formats.files import Refused, expect_bound, expect_memory, leads_out, read_text
from nishiki.formats.hsh import LARGEST_ORDER, hemispherical_harmonics
from nishiki.formats.images import read_codes

INFO = "info.json"
CHANNELS = ("red", "green", "blue")
LAYERS = re.compile(r"plane_\d+|normals|albedo|height|depth|mean|thumbnail", re.IGNORECASE)
"""Pictures that lie in such a folder and are no photographs, without suffix."""
LEAST_WEIGHT = 0.001  # of a captured light, below which viewers leave it out
LEAST_WIDTH = 0.001  # of Gaussians and of the spans of components
OFF_UNIT = 0.01  # of a light's length
ROWS_AT_A_TIME = 256
REMEDY = "Fit it again with relight as ptm, hsh, sh (rgb or lrgb) or rbf (mrgb), or convert the photographs"


def ptm_weights(lights: np.ndarray) -> np.ndarray:
    """(n, 6) of unit vectors (n, 3): 1, x, y, x^2, x y, y^2."""
    x, y = lights[:, 0], lights[:, 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def spherical_harmonics(lights: np.ndarray) -> np.ndarray:
    """(n, 9) of unit vectors (n, 3), in the order and with the factors of OpenLIME."""
    x, y, z = lights.T
    first, second = 0.5 * math.sqrt(3 / math.pi), 0.5 * math.sqrt(15 / math.pi)
    linear = [np.full_like(x, 0.5 / math.sqrt(math.pi)), first * x, first * z, first * y]
    square = 0.5 * math.sqrt(5 / math.pi) * (3 * z * z - 1)
    mixed = [second * x * y, second * x * z, square, second * y * z, 0.5 * second * (y * y - x * x)]
    return np.stack([*linear, *mixed], axis=1)


def gaussian_weights(lights: np.ndarray, light: np.ndarray, width: float) -> np.ndarray:
    """(lights,) of captured unit vectors (lights, 3) for one light, sum 1."""
    squares = np.sum((lights - light) ** 2, axis=1)
    weights = np.exp(-(squares - squares.min()) / width**2)
    weights /= weights.sum()
    weights[weights <= LEAST_WEIGHT] = 0
    return weights / weights.sum()


@dataclass(frozen=True)
class RelightFolder:
    """A relightable image of a folder.

    kind : ptm, hsh, sh or rbf; colour_space : rgb, lrgb or mrgb; codes : (rows, columns, planes) uint8, rows from the
    top; scale, bias : (planes,); lights : (n, 3), components : (planes + 1, n, 3) with their mean first, width : of the
    Gaussians, all three of rbf only; files : names that were read, relative to the folder.
    """

    kind: str
    colour_space: str
    codes: np.ndarray
    scale: np.ndarray
    bias: np.ndarray
    lights: np.ndarray
    components: np.ndarray
    width: float
    files: tuple[str, ...]

    @property
    def layout(self) -> str:
        """What the folder is, for messages."""
        return f"relight folder ({self.kind}, {self.colour_space}, {len(self.scale)} planes)"

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.codes.shape[0], self.codes.shape[1]

    def shown(self, light: np.ndarray) -> np.ndarray:
        """(rows, columns, 3) float32 from the top, for a unit vector to the lamp; full brightness is 1, not clipped."""
        light = np.asarray(light, float)
        picture = np.empty((*self.shape, 3), np.float32)
        offset, weights = self._transfer(light)
        steps = (weights * self.scale[:, None] / 255).astype(np.float32)
        offset = (offset - (self.bias * self.scale) @ weights).astype(np.float32)
        for start in range(0, len(picture), ROWS_AT_A_TIME):
            band = slice(start, start + ROWS_AT_A_TIME)
            codes = self.codes[band].astype(np.float32)
            picture[band] = codes @ steps + offset
            if self.colour_space == "lrgb":
                picture[band] *= (codes[..., :3] / np.float32(255) - self.bias[:3]) * self.scale[:3]
        return picture

    def _transfer(self, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """o (3,) and T (planes, 3): values are o + coefficients T; of lrgb those of the brightness."""
        if self.kind == "rbf":
            weights = gaussian_weights(self.lights, light, self.width)
            mean, *components = np.einsum("l,plk->pk", weights, self.components)
            return mean, np.array(components)
        terms = _terms(self.kind, len(self.scale) // 3 if self.colour_space == "rgb" else len(self.scale) - 3)
        weights = terms(light[None])[0]
        if self.colour_space == "rgb":
            return np.zeros(3), np.kron(weights[:, None], np.eye(3))
        return np.zeros(3), np.concatenate([np.zeros((3, 3)), np.repeat(weights[:, None], 3, axis=1)])


def _terms(kind: str, count: int) -> Any:
    """The function of a kind with this many terms; None where it has another number of them."""
    if kind == "hsh" and count in [order**2 for order in range(1, LARGEST_ORDER + 1)]:
        return lambda lights: hemispherical_harmonics(lights, math.isqrt(count))
    return {("ptm", 6): ptm_weights, ("sh", 9): spherical_harmonics}.get((kind, count))


def is_relight_folder(folder: Path) -> bool:
    """Whether a folder holds a relightable image: `info.json` and its first plane."""
    return (folder / INFO).is_file() and any((folder / f"plane_0{end}").is_file() for end in (".jpg", ".dzi"))


def open_relight(folder: Path) -> RelightFolder:
    """Read info.json and the planes.

    Refused where the kind is not read, or info.json contradicts itself; CaptureError where a picture cannot be decoded.
    """
    name = f"{folder.name}/{INFO}"
    info = _info(folder, name)
    kind, space = str(info.get("type")), str(info.get("colorspace"))
    rows, columns, count = (_whole(info, key, name) for key in ("height", "width", "nplanes"))
    terms = count - 3 if space == "lrgb" else count / 3
    harmonic = space in ("rgb", "lrgb") and terms == int(terms) and kind != "rbf" and _terms(kind, int(terms))
    if not harmonic and (kind, space) != ("rbf", "mrgb"):
        expected = "ptm, hsh or sh in rgb or lrgb with its number of planes, or rbf in mrgb"
        found = f"{kind} in {space} with {count} planes"
        raise Refused(
            name, "a kind of relightable image that is not read", expected=expected, found=found, remedy=REMEDY
        )
    expect_bound(max(rows, columns), "image_side", name)
    expect_bound(rows * columns, "image_pixels", name)
    pictures = -(-count // 3)
    expect_memory(rows * columns * (3 * pictures + 12), name)
    materials = info.get("materials")
    material = materials[0] if isinstance(materials, list) and materials and isinstance(materials[0], dict) else {}
    scale, bias = (_numbers(material, key, count, name) for key in ("scale", "bias"))
    lights, components, width = np.empty((0, 3)), np.empty((0, 0, 3)), 0.0
    if kind == "rbf":
        lights = _numbers(info, "lights", None, name).reshape(-1, 3)
        basis = _numbers(info, "basis", (count + 1) * len(lights) * 3, name).reshape(count + 1, -1, 3)
        spans, (width,) = _numbers(material, "range", count, name), _numbers(info, "sigma", 1, name)
        _expect_gaussians(lights, width, spans, name)
        components = np.concatenate([basis[:1] / 255, (basis[1:] - 127) / spans[:, None, None]])
    codes, files = np.empty((rows, columns, 3 * pictures), np.uint8), [INFO]
    for number in range(pictures):
        part = codes[..., 3 * number : 3 * number + 3]
        files += _read_plane(folder, f"plane_{number}", part)
    return RelightFolder(kind, space, codes[..., :count], scale, bias, lights, components, width, tuple(files))


def _expect_gaussians(lights: np.ndarray, width: float, spans: np.ndarray, name: str) -> None:
    """Refused unless lights are unit vectors, and what is divided by is not close to 0."""
    lengths = np.linalg.norm(lights, axis=1)
    if len(lights) == 0 or np.abs(lengths - 1).max() > OFF_UNIT:
        found = f"length {lengths[np.abs(lengths - 1).argmax()]:.3g}" if len(lights) else "none"
        raise Refused(name, "'lights' cannot be used", expected="vectors of length 1", found=found, remedy=REMEDY)
    for key, least in (("sigma", width), ("range", np.abs(spans).min())):
        if least < LEAST_WIDTH:
            expected, found = f"at least {LEAST_WIDTH}", f"{least:.3g}"
            raise Refused(name, f"'{key}' cannot be used", expected=expected, found=found, remedy=REMEDY)


def _read_plane(folder: Path, name: str, out: np.ndarray) -> list[str]:
    """Fill (rows, columns, 3) from a picture or from the tiles of its full resolution; names of the files read."""
    if (folder / f"{name}.jpg").is_file():
        _fill(folder, f"{name}.jpg", out)
        return [f"{name}.jpg"]
    (rows, columns), with_tiles = out.shape[:2], f"{name}.dzi"
    about = f"{folder.name}/{with_tiles}"
    try:
        text = read_text(_within(folder, with_tiles), "settings_bytes", name=about)
    except FileNotFoundError:
        raise Refused(about, "neither this nor a .jpg is there", remedy=REMEDY) from None
    except UnicodeDecodeError:
        raise Refused(about, "not UTF-8 text", remedy=REMEDY) from None
    found = dict(re.findall(r'\b(TileSize|Overlap|Format)="(\w{1,9})"', text, re.ASCII))
    sides = dict(re.findall(r'\b(Width|Height)="(\d{1,9})"', "".join(re.findall(r"<Size\b[^>]*>", text)), re.ASCII))
    levels = [path.name for path in (folder / f"{name}_files").glob("*") if re.fullmatch("[0-9]+", path.name)]
    if len(found) < 3 or len(sides) < 2 or not levels:
        raise Refused(about, "no deep zoom with tiles", remedy=REMEDY)
    if (int(sides["Height"]), int(sides["Width"])) != (rows, columns):
        raise _other_size(about, (rows, columns), f"{int(sides['Width'])} x {int(sides['Height'])}")
    size, overlap = (int(found[key]) if found[key].isdecimal() else 0 for key in ("TileSize", "Overlap"))
    if size < 16:
        raise Refused(about, "tiles too small", found=f"{size} pixels", remedy=REMEDY)
    files, level = [with_tiles], max(levels, key=int)
    for row in range(-(-rows // size)):
        for column in range(-(-columns // size)):
            tile = f"{name}_files/{level}/{column}_{row}.{found['Format']}"
            margin = (min(row, 1) * overlap, min(column, 1) * overlap)
            _fill(folder, tile, out[row * size : (row + 1) * size, column * size : (column + 1) * size], margin)
            files.append(tile)
    return files


def _fill(folder: Path, name: str, out: np.ndarray, margin: tuple[int, int] | None = None) -> None:
    """Copy a picture into a window. margin : rows and columns before those of a tile; it may have more after them."""
    about = f"{folder.name}/{name}"
    codes = read_codes(_within(folder, name), CHANNELS, name=about)
    if margin is not None:
        codes = codes[margin[0] :, margin[1] :][: out.shape[0], : out.shape[1]]
    if codes.shape != out.shape or codes.dtype != np.uint8:
        raise _other_size(about, out.shape, f"{codes.shape[1]} x {codes.shape[0]} of {codes.dtype}")
    out[:] = codes


def _other_size(about: str, shape: tuple[int, ...], found: str) -> Refused:
    expected, what = f"{shape[1]} x {shape[0]} of 8 bits", f"a plane of another size than {INFO} says"
    return Refused(about, what, expected=expected, found=found, remedy=REMEDY)


def _within(folder: Path, name: str) -> Path:
    """The path of a file of the folder. Refused where it is a link elsewhere."""
    if leads_out(folder / name, folder):
        raise Refused(f"{folder.name}/{name}", "a link that leads out of the folder", remedy="Copy the file into it")
    return folder / name


def _info(folder: Path, name: str) -> dict[str, Any]:
    try:
        content = json.loads(read_text(_within(folder, INFO), "table_bytes", name=name))
    except (ValueError, RecursionError) as e:
        raise Refused(name, "not JSON", found=str(e)[:80], remedy=REMEDY) from None
    if not isinstance(content, dict):
        raise Refused(name, "not a JSON object", found=type(content).__name__, remedy=REMEDY)
    return content


def _whole(info: dict[str, Any], key: str, name: str) -> int:
    value = info.get(key)
    if type(value) is not int or not 0 < value < 1 << 20:
        raise Refused(name, f"'{key}' is no number of pixels or planes", found=repr(value)[:40], remedy=REMEDY)
    return value


def _numbers(content: dict[str, Any], key: str, count: int | None, name: str) -> np.ndarray:
    """Finite numbers of a list, or a single one; as many as expected, or threes of them."""
    values = content.get(key)
    values = values if isinstance(values, list) else [values]
    sound = all(type(v) in (int, float) and abs(v) < 1e9 for v in values)  # neither NaN nor true
    if not sound or (len(values) % 3 if count is None else len(values) != count):
        expected, found = f"{count or 'threes of'} numbers", f"{len(values)}, {repr(values)[:40]}"
        raise Refused(name, f"'{key}' cannot be used", expected=expected, found=found, remedy=REMEDY)
    return np.array(values, np.float64)
