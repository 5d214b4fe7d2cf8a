"""Read relightable images as folders: `info.json` and pictures of coefficients, of relight and for OpenLIME.

Three coefficients a picture: value = (code / 255 - bias) scale, for values 0 to 1. In the colour space rgb the red,
green and blue of each term follow each other; in lrgb the first picture is a colour (code / 255), and the terms are
those of a brightness that multiplies it; in mrgb the planes weigh principal components, whose values in each direction
of a table are in info.json (in `materials.bin` in older folders); mycc is the same for brightness, R - B and
G - (R + B) / 2, of which the planes are taken in turn as long as there are all three, then those of brightness.

Terms: polynomials (ptm; Malzbender and others, 2001), hemispherical harmonics (hsh; Gautron and others, 2004), real
spherical harmonics (sh). Weights of tabulated directions: Gaussians between the captured lights (rbf), and bilinear
interpolation on a grid over the hemisphere (Ponchio, Corsini and Scopigno, 2018).
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.formats.files import Refused, expect_bound, expect_memory, json_object, read_bytes, read_text
from nishiki.formats.legacy_rti import LARGEST_ORDER, hemispherical_harmonics
from nishiki.formats.relight_planes import ALL_PLANES, REMEDY, read_plane, within
from nishiki.threads import strips

INFO = "info.json"
BASIS = "materials.bin"
LAYERS = re.compile(r"plane_\d+|materials|normals|albedo|height|depth|means?|medians?|error|thumbnail", re.IGNORECASE)
"""Pictures of relight and viewers in such a folder that are no photographs, without suffix."""
TABULATED = ("rbf", "bilinear")
LEAST_WIDTH = 0.001  # of Gaussians and of the spans of components
OFF_UNIT = 0.01  # of a light's length


@dataclass(frozen=True)
class RelightFolder:
    """A relightable image of a folder.

    kind : ptm, hsh, sh, rbf or bilinear; colour_space : rgb, lrgb, mrgb or mycc; codes : (rows, columns, planes) uint8,
    rows from the top; scale, bias : (planes,); components : (planes + 1, n, 3) of red, green and blue with their mean
    first, of rbf and bilinear; lights : (n, 3), width : of the Gaussians, both of rbf only; files : names that were
    read, relative to the folder; pitch_mm : width of a pixel on the object, 0 if it is not stated.
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
    pitch_mm: float = 0.0

    @property
    def layout(self) -> str:
        """Description of the folder for messages."""
        return f"relight folder ({self.kind}, {self.colour_space}, {len(self.scale)} planes)"

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.codes.shape[0], self.codes.shape[1]

    def relight(self, light: np.ndarray) -> np.ndarray:
        """Render (rows, columns, 3) float32 from the top for a unit lamp vector; full brightness is 1, not clipped."""
        light = np.asarray(light, float)
        picture = np.empty((*self.shape, 3), np.float32)
        offset, weights = self._transfer(light)
        steps = (weights * self.scale[:, None] / 255).astype(np.float32)
        offset = (offset - (self.bias * self.scale) @ weights).astype(np.float32)
        for band in strips(len(picture)):
            codes = self.codes[band].astype(np.float32)
            picture[band] = codes @ steps + offset
            if self.colour_space == "lrgb":
                picture[band] *= codes[..., :3] / np.float32(255)
        return picture

    def _transfer(self, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute o (3,) and T (planes, 3): values are o + coefficients T; of lrgb those of the brightness."""
        if self.kind in TABULATED:
            directions = self.components.shape[1]
            gaussian = self.kind == "rbf"
            weights = (
                gaussian_weights(self.lights, light, self.width)
                if gaussian
                else bilinear_weights(math.isqrt(directions), light)
            )
            mean, *components = np.einsum("l,plk->pk", weights, self.components)
            return mean, np.array(components)
        terms = terms_of(self.kind, _terms(self.colour_space, len(self.scale)))
        if terms is None:
            raise ValueError(f"{self.layout}: no such terms")
        weights = terms(light[None])[0]
        if self.colour_space == "rgb":
            return np.zeros(3), np.kron(weights[:, None], np.eye(3))
        return np.zeros(3), np.concatenate([np.zeros((3, 3)), np.repeat(weights[:, None], 3, axis=1)])


def _terms(space: str, planes: int) -> int:
    """Compute the terms of rgb or lrgb in this many planes; 0 where they are no whole number."""
    return planes - 3 if space == "lrgb" else planes // 3 * (planes % 3 == 0)


def is_relight_folder(folder: Path) -> bool:
    """Check whether a folder holds a relightable image: `info.json` and its first plane."""
    first = [f"plane_0{end}" for end in (".jpg", ".dzi", ".tzi")]
    return (folder / INFO).is_file() and any((folder / name).is_file() for name in (*first, ALL_PLANES))


def open_relight(folder: Path) -> RelightFolder:
    """Read info.json and the planes.

    Refused where the kind is not read, or info.json contradicts itself; CaptureError where a picture cannot be decoded.
    """
    name = f"{folder.name}/{INFO}"
    try:
        info = json_object(read_text(within(folder, INFO), "table_bytes", name=name))
    except ValueError as e:
        raise Refused(name, "not JSON", found=str(e)[:80], remedy=REMEDY) from None
    kind, space = str(info.get("type")), str(info.get("colorspace"))
    rows, columns = (_whole(info, key, name) for key in ("height", "width"))
    triples = _triples(info, name) if space == "mycc" else None
    count = triples[0] if triples else _whole(info, "nplanes", name)
    fitted = space in ("rgb", "lrgb") and terms_of(kind, _terms(space, count)) is not None
    if not fitted and not (kind in TABULATED and space in ("mrgb", "mycc")):
        expected = "ptm, hsh or sh in rgb or lrgb with its number of planes, or rbf or bilinear in mrgb or mycc"
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
    lights, components, width, files = np.empty((0, 3)), np.empty((0, 0, 3)), 0.0, [INFO]
    if kind == "rbf":
        lights = _numbers(info, "lights", None, name).reshape(-1, 3)
        (width,) = _numbers(info, "sigma", 1, name)
        lengths = np.linalg.norm(lights, axis=1)
        if len(lights) == 0 or np.abs(lengths - 1).max() > OFF_UNIT:
            found = f"length {lengths[np.abs(lengths - 1).argmax()]:.3g}" if len(lights) else "none"
            raise _unusable(name, "lights", "vectors of length 1", found)
        _expect_at_least(LEAST_WIDTH, "sigma", width, name)
    if kind in TABULATED:
        directions = len(lights)
        if kind == "bilinear":
            side = _whole(info, "resolution", name)  # nodes of the grid, each way
            if not 2 <= side <= 256:
                raise _unusable(name, "resolution", "2 to 256", str(side))
            directions = side**2
        basis, more = _basis(folder, info, (count + 1, directions, 3), name)
        components = _components(basis, _numbers(material, "range", count, name), triples, name)
        files += more
    codes = np.empty((rows, columns, 3 * pictures), np.uint8)
    for number in range(pictures):
        files += read_plane(folder, number, codes[..., 3 * number : 3 * number + 3])
    pitch: Any = info.get("pixelSizeInMM")
    pitch = float(pitch) if type(pitch) in (int, float) and 0 < pitch < 1e9 else 0.0
    codes = codes[..., :count]
    return RelightFolder(kind, space, codes, scale, bias, lights, components, width, tuple(files), pitch)


def _triples(info: dict[str, Any], name: str) -> tuple[int, int]:
    """Return the planes of mycc, and the number of each of the two differences among them."""
    planes = _numbers(info, "yccplanes", 3, name)
    brightness, first, second = planes.astype(int)
    if (planes != planes.astype(int)).any() or first != second or not 0 <= first <= brightness < 1 << 10:
        expected = "brightness and two differences, as many of each"
        raise _unusable(name, "yccplanes", expected, repr(info["yccplanes"])[:40])
    if brightness == 0:
        raise _unusable(name, "yccplanes", "planes", "none")
    return int(planes.sum()), int(first)


def _basis(folder: Path, info: dict[str, Any], shape: tuple[int, ...], name: str) -> tuple[np.ndarray, list[str]]:
    """Read the codes of mean and components, and the name of the file if they lie in one of their own."""
    if "basis" in info or not (folder / BASIS).is_file():
        return _numbers(info, "basis", math.prod(shape), name).reshape(shape), []
    content = read_bytes(within(folder, BASIS), "table_bytes", name=f"{folder.name}/{BASIS}")
    if len(content) != math.prod(shape):
        expected, found = f"{math.prod(shape)} bytes", str(len(content))
        raise Refused(f"{folder.name}/{BASIS}", "another size than info.json says", expected=expected, found=found)
    return np.frombuffer(content, np.uint8).astype(float).reshape(shape), [BASIS]


def _components(basis: np.ndarray, spans: np.ndarray, triples: tuple[int, int] | None, name: str) -> np.ndarray:
    """Compute mean and components as red, green and blue. Refused where a span is close to 0."""
    _expect_at_least(LEAST_WIDTH, "range", np.abs(spans).min(), name)
    values = np.concatenate([basis[:1] / 255, (basis[1:] - 127) / spans[:, None, None]])
    if triples is None:
        return values
    planes, alternating = triples
    channel = np.where(np.arange(planes) < 3 * alternating, np.arange(planes) % 3, 0)
    values[1:] *= np.eye(3)[channel][:, None]
    return values @ FROM_YCOCG.T


def _expect_at_least(least: float, key: str, value: float, name: str) -> None:
    if value < least:
        raise _unusable(name, key, f"at least {least}", f"{value:.3g}")


def _unusable(name: str, key: str, expected: str, found: str) -> Refused:
    return Refused(name, f"'{key}' cannot be used", expected=expected, found=found, remedy=REMEDY)


def _whole(info: dict[str, Any], key: str, name: str) -> int:
    value = info.get(key)
    if type(value) is not int or not 0 < value < 1 << 20:
        raise Refused(name, f"'{key}' is no whole number above 0", found=repr(value)[:40], remedy=REMEDY)
    return value


def _numbers(content: dict[str, Any], key: str, count: int | None, name: str) -> np.ndarray:
    """Parse finite numbers of a list, or a single one; as many as expected, or multiples of three."""
    values = content.get(key)
    values = values if isinstance(values, list) else [values]
    sound = all(type(v) in (int, float) and abs(v) < 1e9 for v in values)  # neither NaN nor true
    if not sound or (len(values) % 3 if count is None else len(values) != count):
        raise _unusable(name, key, f"{count or 'threes of'} numbers", f"{len(values)}, {repr(values)[:40]}")
    return np.array(values, np.float64)


LEAST_WEIGHT = 0.001  # of a captured light, below which viewers leave it out
FROM_YCOCG = np.array([[1.0, 0.5, -0.5], [1.0, 0.0, 0.5], [1.0, -0.5, -0.5]])
"""Matrix to red, green and blue from brightness, R - B, and G - (R + B) / 2."""


def ptm_weights(lights: np.ndarray) -> np.ndarray:
    """Compute (n, 6) of unit vectors (n, 3): 1, x, y, x^2, x y, y^2."""
    x, y = lights[:, 0], lights[:, 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def spherical_harmonics(lights: np.ndarray) -> np.ndarray:
    """Compute (n, 9) of unit vectors (n, 3), by degree, then order -l to l, without Condon's and Shortley's sign.

    That is the order in which relight fits them. OpenLIME 1.2 shows them with x and y exchanged.
    """
    x, y, z = lights.T
    first, second = 0.5 * math.sqrt(3 / math.pi), 0.5 * math.sqrt(15 / math.pi)
    linear = [np.full_like(x, 0.5 / math.sqrt(math.pi)), first * y, first * z, first * x]
    square = 0.25 * math.sqrt(5 / math.pi) * (3 * z * z - 1)
    mixed = [second * x * y, second * y * z, square, second * x * z, 0.5 * second * (x * x - y * y)]
    return np.stack([*linear, *mixed], axis=1)


def terms_of(kind: str, count: int) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return the basis function of ptm, hsh or sh with this many terms, of unit vectors (n, 3); None for others."""
    if kind == "hsh" and count in [order**2 for order in range(1, LARGEST_ORDER + 1)]:
        return lambda lights: hemispherical_harmonics(lights, math.isqrt(count))
    if kind == "ptm" and count in (3, 6):
        return lambda lights: ptm_weights(lights)[:, :count]
    return spherical_harmonics if (kind, count) == ("sh", 9) else None


def gaussian_weights(lights: np.ndarray, light: np.ndarray, width: float) -> np.ndarray:
    """Compute weights (lights,) of captured unit vectors (lights, 3) for one light, sum 1."""
    squares = np.sum((lights - light) ** 2, axis=1)
    weights = np.exp(-(squares - squares.min()) / width**2)
    weights /= weights.sum()
    weights[weights <= LEAST_WEIGHT] = 0
    return weights / weights.sum()


def bilinear_weights(side: int, light: np.ndarray) -> np.ndarray:
    """Compute weights (side^2,) of a hemispherical grid for a unit vector with z >= 0, sum 1; at most four are not 0.

    The octahedral map, turned by 45 degrees: s = |x| + |y| + |z|; columns from (x + y) / s = -1 to 1, rows from
    (y - x) / s = -1 to 1, nodes at both ends.
    """
    x, y, _ = light
    total = np.abs(light).sum()
    across, down = ((np.array([x + y, y - x]) / total + 1) / 2 * (side - 1)).clip(0, side - 1)
    column, row = min(int(across), side - 2), min(int(down), side - 2)
    weights = np.zeros((side, side))
    right, below = across - column, down - row
    weights[row : row + 2, column : column + 2] = np.outer([1 - below, below], [1 - right, right])
    return weights.ravel()


def grid_directions(side: int) -> np.ndarray:
    """Compute unit vectors (side^2, 3) of the nodes, in the order of `bilinear_weights`; outermost ones have z = 0."""
    down, across = np.mgrid[:side, :side] * 2 / (side - 1) - 1
    x, y = ((across - down) / 2).ravel(), ((across + down) / 2).ravel()
    vectors = np.stack([x, y, np.maximum(1 - np.abs(x) - np.abs(y), 0)], axis=1)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
