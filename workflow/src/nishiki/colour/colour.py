"""Convert spectra to colours for an eye and a display: CIE 1931 XYZ, CIELAB, CIEDE2000, sRGB.

Colour-matching functions: CIE 1931 2 degree standard observer (CIE 018:2019, table 6). Illuminants D50, D65, FL2, FL7,
FL11, LED-B1, LED-B3 and LED-B5: CIE 015:2018. Taken once from colour-science 0.4.7, against which the tests compare
them. CIE data are facts published by the Commission Internationale de l'Eclairage.

Small own forms, because importing a colour library costs seconds in every process; the tests compare each of them with
colour-science.

The transfer curve of sRGB (IEC 61966-2-1):

    code = 12.92 L                      L <= 0.0031308
    code = 1.055 L^(1 / 2.4) - 0.055    above

In the capture's encoding pictures are compared and residuals are coded.
"""

import functools
from pathlib import Path

import numpy as np

from nishiki.colour.sampling import WAVELENGTHS_NM, checked_spectra, normalise_curves
from nishiki.errors import UserError
from nishiki.formats.coding import BRADFORD, BT709_XY, D65
from nishiki.threads import strips

TABLES = Path(__file__).with_name("cie.csv")
"""Columns by wavelength: colour-matching functions x, y, z, then relative powers of the illuminants."""
WHITE = np.array([D65[0] / D65[1], 1.0, (1.0 - D65[0] - D65[1]) / D65[1]])
"""XYZ of the white of sRGB."""


@functools.cache
def _tables() -> dict[str, np.ndarray]:
    names = TABLES.read_text(encoding="ascii").partition("\n")[0].split(",")
    return dict(zip(names, np.loadtxt(TABLES, delimiter=",", skiprows=1).T, strict=True))


LEAST_CONE = 0.01  # response of a lamp's white, relative to that of the white that it is brought to


def cie_1931_cmfs() -> np.ndarray:
    """Return the colour-matching functions (3, 61) x, y, z of the CIE 1931 2 degree observer on the working grid."""
    return np.array([_tables()[name] for name in "xyz"])


ILLUMINANTS = ("A", "D50", "D65", "E", "F2", "F7", "F11", "FL2", "FL7", "FL11", "LED-B1", "LED-B3", "LED-B5")
"""Names of CIE illuminants whose spectra are known."""


def illuminant(name: str) -> np.ndarray:
    """Return the spectral power (61,) of a CIE illuminant on the working grid, relative: 100 at 560 nm if tabulated so.

    Known: A (Planck's law with c2 = 1.435e7 nm K at 2848 K, CIE 015:2018 eq. 1), D50, D65 (tables), E (equal energy),
    FL2, FL7, FL11 (also written F2, F7, F11), LED-B1, LED-B3, LED-B5 (blue LEDs with phosphor: warm,
    neutral, cold; CIE 015:2018). Raises UserError for another name.
    """
    key = name.strip().upper()
    if key == "A":
        c2_over_t = 1.435e7 / 2848.0
        planck = np.expm1(c2_over_t / 560.0) / np.expm1(c2_over_t / WAVELENGTHS_NM)
        return 100.0 * (560.0 / WAVELENGTHS_NM) ** 5 * planck
    if key == "E":
        return np.full(WAVELENGTHS_NM.size, 100.0)
    if key not in ILLUMINANTS:
        raise UserError(
            f"illuminant: expected one of {', '.join(ILLUMINANTS)}, found {name!r}; "
            "for another lamp give its measured spectrum as a table"
        )
    return _tables()[f"FL{key[1:]}" if key[1:].isdigit() and key[0] == "F" else key].copy()


def xyz_matrix(illuminant: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Compute A (3, K) with XYZ = A @ sigma for S = sigma @ basis; Y = 1 for the perfect white S = 1.

    illuminant : (61,); basis : (K, 61). Sums over the 61 bands as CIE 015:2018 eq. 7 tabulates them. For XYZ of spectra
    themselves use `xyz_from_spectra`. Source: Tominaga and Tanaka (2004), eq. 19, exact because the diffuse term is
    linear in sigma.
    """
    lamp = normalise_curves(checked_spectra(illuminant, "illuminant")[0])
    weights = cie_1931_cmfs() * lamp
    total = weights[1].sum()
    if not total > 0:
        raise UserError("illuminant: expected visible power, found none; correct the table")
    return (weights / total) @ checked_spectra(basis, "basis").T


def xyz_from_spectra(illuminant: np.ndarray, spectra: np.ndarray) -> np.ndarray:
    """Compute XYZ (..., 3) of reflectances (..., 61), Y = 1 for the perfect white."""
    return np.asarray(spectra) @ xyz_matrix(illuminant, np.eye(WAVELENGTHS_NM.size)).T


def white_xyz(illuminant: np.ndarray) -> np.ndarray:
    """Compute XYZ (3,) of the perfect white under the illuminant, Y = 1."""
    return xyz_from_spectra(illuminant, np.ones(WAVELENGTHS_NM.size))


def srgb_matrix() -> np.ndarray:
    """Return the matrix (3, 3) from XYZ (relative to D65, white Y = 1) to linear sRGB, IEC 61966-2-1 primaries."""
    xyz = np.column_stack([BT709_XY, 1.0 - np.sum(BT709_XY, axis=1)]).T
    return np.linalg.inv(xyz * np.linalg.solve(xyz, WHITE))


def adaptation_matrix(white_from: np.ndarray, white_to: np.ndarray) -> np.ndarray:
    """Return the linear Bradford adaptation (3, 3): XYZ under `white_from` (3,) to the match under `white_to` (3,).

    Under a lamp so narrow that a cone response of its white is negative or almost none, nothing is white to an eye and
    Bradford's quotients have no meaning: only the luminance is then brought to that of `white_to`.
    """
    white_from, white_to = np.asarray(white_from, float), np.asarray(white_to, float)
    source, target = BRADFORD @ white_from, BRADFORD @ white_to
    if not (source * white_to[1] > LEAST_CONE * target * white_from[1]).all():
        return np.eye(3) * (white_to[1] / white_from[1])
    return np.linalg.solve(BRADFORD, (target / source)[:, None] * BRADFORD)


def xyz_to_srgb_linear(xyz: np.ndarray, *, white: np.ndarray | None = None) -> np.ndarray:
    """Convert XYZ (..., 3) with white Y = 1 to linear sRGB (..., 3), unclipped.

    white : XYZ (3,) of the scene's white; if given, Bradford adaptation brings it to RGB (1, 1, 1). None: XYZ is
    relative to D65 already.
    """
    matrix = srgb_matrix()
    if white is not None:
        matrix = matrix @ adaptation_matrix(white, WHITE)
    return np.asarray(xyz) @ matrix.T.astype(np.result_type(np.asarray(xyz).dtype, np.float32))


def srgb_encode(linear: np.ndarray) -> np.ndarray:
    """Encode linear sRGB as display values in [0, 1], IEC 61966-2-1; clip values outside, NaN becomes 0."""
    values = np.clip(np.nan_to_num(np.asarray(linear), nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    return encode(values, "srgb")


def xyz_to_lab(xyz: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Convert XYZ (..., 3) and the white's XYZ (3,), same scale, to CIELAB (..., 3). CIE 015:2018 eq. 8.3-8.10.

    Below (6/29)^3 the function is linear, so zero and negative XYZ have finite Lab.
    """
    ratio = np.asarray(xyz) / np.asarray(white)
    limit = 6.0 / 29.0
    f = np.where(ratio > limit**3, np.cbrt(ratio), ratio / (3.0 * limit**2) + 4.0 / 29.0)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def delta_e_2000(lab1: np.ndarray, lab2: np.ndarray) -> np.ndarray:
    """Compute the CIEDE2000 colour difference (...) of Lab arrays (..., 3), kL = kC = kH = 1.

    Source: Sharma, Wu, Dalal, Color Res. Appl. 30 (2005) 21-30, eq. 2-22; tested on 14 of their pairs.
    """
    lab1, lab2 = np.asarray(lab1, dtype=float), np.asarray(lab2, dtype=float)
    l1, l2 = lab1[..., 0], lab2[..., 0]
    chroma7 = (0.5 * (np.hypot(lab1[..., 1], lab1[..., 2]) + np.hypot(lab2[..., 1], lab2[..., 2]))) ** 7
    stretch = 1.5 - 0.5 * np.sqrt(chroma7 / (chroma7 + 25.0**7))
    a1, a2 = lab1[..., 1] * stretch, lab2[..., 1] * stretch
    c1, c2 = np.hypot(a1, lab1[..., 2]), np.hypot(a2, lab2[..., 2])
    h1 = np.degrees(np.arctan2(lab1[..., 2], a1)) % 360.0
    h2 = np.degrees(np.arctan2(lab2[..., 2], a2)) % 360.0
    grey = c1 * c2 == 0.0
    apart = h2 - h1
    turn = np.where(apart > 180.0, apart - 360.0, np.where(apart < -180.0, apart + 360.0, apart))
    turn = np.where(grey, 0.0, turn)
    hue_term = 2.0 * np.sqrt(c1 * c2) * np.sin(np.radians(0.5 * turn))
    total = h1 + h2
    mean_hue = np.where(np.abs(apart) <= 180.0, 0.5 * total, 0.5 * (total + np.where(total < 360.0, 360.0, -360.0)))
    mean_hue = np.where(grey, total, mean_hue)
    lightness, chroma = 0.5 * (l1 + l2), 0.5 * (c1 + c2)
    hue = np.radians(mean_hue)
    t = (
        1.0
        - 0.17 * np.cos(hue - np.radians(30.0))
        + 0.24 * np.cos(2.0 * hue)
        + 0.32 * np.cos(3.0 * hue + np.radians(6.0))
        - 0.20 * np.cos(4.0 * hue - np.radians(63.0))
    )
    offset = (lightness - 50.0) ** 2
    s_l = 1.0 + 0.015 * offset / np.sqrt(20.0 + offset)
    s_c = 1.0 + 0.045 * chroma
    s_h = 1.0 + 0.015 * chroma * t
    chroma7 = chroma**7
    rotation = -2.0 * np.sqrt(chroma7 / (chroma7 + 25.0**7))
    rotation = rotation * np.sin(np.radians(60.0 * np.exp(-(((mean_hue - 275.0) / 25.0) ** 2))))
    d_l, d_c, d_h = (l2 - l1) / s_l, (c2 - c1) / s_c, hue_term / s_h
    # The quadratic form is positive definite in exact arithmetic; rounding may leave -1e-17 for equal colours.
    return np.sqrt(np.maximum(d_l**2 + d_c**2 + d_h**2 + rotation * d_c * d_h, 0.0))


BLOCK = 1 << 16  # values at a time: temporaries stay in the cache
KNEE, CODED_KNEE = 0.0031308, 0.04045
"""Linear value, and code, at which the straight part ends."""
SLOPE, SCALE, OFFSET, POWER = 12.92, 1.055, 0.055, 1 / 2.4


def encode(linear: np.ndarray, encoding: str) -> np.ndarray:
    """Convert linear values to code values, full scale 1, of any shape; float32 stays float32, all else is float64.

    srgb: the transfer curve of IEC 61966-2-1, continued below 0 by its straight part and above 1 by its power; linear:
    the values themselves (not a copy). Nothing is clipped; NaN stays NaN. ValueError for another encoding.
    """

    def curve(values: np.ndarray, out: np.ndarray) -> None:
        np.maximum(values, KNEE, out=out)
        np.power(out, POWER, out=out)
        out *= SCALE
        out -= OFFSET
        np.multiply(values, SLOPE, out=out, where=values <= KNEE)

    return _through(linear, encoding, curve)


def decode(values: np.ndarray, encoding: str) -> np.ndarray:
    """Convert code values to linear ones: the inverse of `encode`."""

    def curve(values: np.ndarray, out: np.ndarray) -> None:
        np.maximum(values, CODED_KNEE, out=out)
        out += OFFSET
        out *= 1 / SCALE
        np.power(out, 1 / POWER, out=out)
        np.multiply(values, 1 / SLOPE, out=out, where=values <= CODED_KNEE)

    return _through(values, encoding, curve)


def encoding_slope(linear: np.ndarray, encoding: str) -> np.ndarray:
    """Differentiate the encoding at linear values, of their type; that of the straight part up to its end."""
    if encoding == "linear":
        return np.ones_like(linear)
    high = np.maximum(linear, KNEE).astype(linear.dtype)
    return np.where(linear <= KNEE, linear.dtype.type(SLOPE), (SCALE * POWER) * high ** (POWER - 1))


def _through(values: np.ndarray, encoding: str, curve) -> np.ndarray:
    values = np.asarray(values)
    values = values if values.dtype in (np.float32, np.float64) else values.astype(np.float64)
    if encoding == "linear":
        return values
    if encoding != "srgb":
        raise ValueError(f"encoding {encoding!r}: linear or srgb")
    flat = np.ascontiguousarray(values).reshape(-1)
    out = np.empty_like(flat)
    for part in strips(len(flat), BLOCK):
        curve(flat[part], out[part])
    return out.reshape(values.shape)
