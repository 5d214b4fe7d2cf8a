"""Convert spectra to what an eye and a display see: CIE 1931 XYZ, CIELAB, CIEDE2000, sRGB.

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

from typing import Literal

import numpy as np

from nishiki.colour.sampling import WAVELENGTHS_NM, checked_spectra, normalised
from nishiki.errors import UserError

# fmt: off
CMF_X = (
    0.01431, 0.02319, 0.04351, 0.07763, 0.13438, 0.21477, 0.2839, 0.3285, 0.34828, 0.34806, 0.3362, 0.3187, 0.2908,
    0.2511, 0.19536, 0.1421, 0.09564, 0.05795001, 0.03201, 0.0147, 0.0049, 0.0024, 0.0093, 0.0291, 0.06327, 0.1096,
    0.1655, 0.2257499, 0.2904, 0.3597, 0.4334499, 0.5120501, 0.5945, 0.6784, 0.7621, 0.8425, 0.9163, 0.9786, 1.0263,
    1.0567, 1.0622, 1.0456, 1.0026, 0.9384, 0.8544499, 0.7514, 0.6424, 0.5419, 0.4479, 0.3608, 0.2835, 0.2187, 0.1649,
    0.1212, 0.0874, 0.0636, 0.04677, 0.0329, 0.0227, 0.01584, 0.01135916,
)
CMF_Y = (
    0.000396, 0.00064, 0.00121, 0.00218, 0.004, 0.0073, 0.0116, 0.01684, 0.023, 0.0298, 0.038, 0.048, 0.06, 0.0739,
    0.09098, 0.1126, 0.13902, 0.1693, 0.20802, 0.2586, 0.323, 0.4073, 0.503, 0.6082, 0.71, 0.7932, 0.862, 0.9148501,
    0.954, 0.9803, 0.9949501, 1.0, 0.995, 0.9786, 0.952, 0.9154, 0.87, 0.8163, 0.757, 0.6949, 0.631, 0.5668, 0.503,
    0.4412, 0.381, 0.321, 0.265, 0.217, 0.175, 0.1382, 0.107, 0.0816, 0.061, 0.04458, 0.032, 0.0232, 0.017, 0.01192,
    0.00821, 0.005723, 0.004102,
)
CMF_Z = (
    0.06785001, 0.1102, 0.2074, 0.3713, 0.6456, 1.0390501, 1.3856, 1.62296, 1.74706, 1.7826, 1.77211, 1.7441, 1.6692,
    1.5281, 1.28764, 1.0419, 0.8129501, 0.6162, 0.46518, 0.3533, 0.272, 0.2123, 0.1582, 0.1117, 0.07824999,
    0.05725001, 0.04216, 0.02984, 0.0203, 0.0134, 0.008749999, 0.005749999, 0.0039, 0.002749999, 0.0021, 0.0018,
    0.001650001, 0.0014, 0.0011, 0.001, 0.0008, 0.0006, 0.00034, 0.00024, 0.00019, 0.0001, 4.999999e-05, 3e-05, 2e-05,
    1e-05, 2.11758236814e-22, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
)
ILLUMINANT_D50 = (
    49.308, 52.91, 56.513, 58.273, 60.034, 58.926, 57.818, 66.321, 74.825, 81.036, 87.247, 88.93, 90.612, 90.99,
    91.368, 93.238, 95.109, 93.536, 91.963, 93.843, 95.724, 96.169, 96.613, 96.871, 97.129, 99.614, 102.099, 101.427,
    100.755, 101.536, 102.317, 101.159, 100.0, 98.868, 97.735, 98.327, 98.918, 96.208, 93.499, 95.593, 97.688, 98.478,
    99.269, 99.155, 99.042, 97.382, 95.722, 97.29, 98.857, 97.262, 95.667, 96.929, 98.19, 100.597, 103.003, 101.068,
    99.133, 93.257, 87.381, 89.492, 91.604,
)
ILLUMINANT_D65 = (
    82.7549, 87.1204, 91.486, 92.4589, 93.4318, 90.057, 86.6823, 95.7736, 104.865, 110.936, 117.008, 117.41, 117.812,
    116.336, 114.861, 115.392, 115.923, 112.367, 108.811, 109.082, 109.354, 108.578, 107.802, 106.296, 104.79,
    106.239, 107.689, 106.047, 104.405, 104.225, 104.046, 102.023, 100.0, 98.1671, 96.3342, 96.0611, 95.788, 92.2368,
    88.6856, 89.3459, 90.0062, 89.8026, 89.5991, 88.6489, 87.6987, 85.4936, 83.2886, 83.4939, 83.6992, 81.863,
    80.0268, 80.1207, 80.2146, 81.2462, 82.2778, 80.281, 78.2842, 74.0027, 69.7213, 70.6652, 71.6091,
)
ILLUMINANT_FL2 = (
    3.44, 15.69, 3.85, 3.74, 4.19, 4.62, 5.06, 34.98, 11.81, 6.27, 6.63, 6.93, 7.19, 7.4, 7.54, 7.62, 7.65, 7.62,
    7.62, 7.45, 7.28, 7.15, 7.05, 7.04, 7.16, 7.47, 8.04, 8.88, 10.01, 24.88, 16.64, 14.59, 16.16, 17.56, 18.62,
    21.47, 22.79, 19.29, 18.66, 17.73, 16.54, 15.21, 13.8, 12.36, 10.95, 9.65, 8.4, 7.32, 6.31, 5.43, 4.68, 4.02,
    3.45, 2.96, 2.55, 2.19, 1.89, 1.64, 1.53, 1.27, 1.1,
)
ILLUMINANT_FL7 = (
    6.15, 19.37, 7.37, 7.05, 7.71, 8.41, 9.15, 44.14, 17.52, 11.35, 12.0, 12.58, 13.08, 13.45, 13.71, 13.88, 13.95,
    13.93, 13.82, 13.64, 13.43, 13.25, 13.08, 12.93, 12.78, 12.6, 12.44, 12.33, 12.26, 29.52, 17.05, 12.44, 12.58,
    12.72, 12.83, 15.46, 16.75, 12.83, 12.67, 12.45, 12.19, 11.89, 11.6, 11.35, 11.12, 10.95, 10.76, 10.42, 10.11,
    10.04, 10.02, 10.11, 9.87, 8.65, 7.27, 6.44, 5.83, 5.41, 5.04, 4.57, 4.12,
)
ILLUMINANT_FL11 = (
    1.29, 12.68, 1.59, 1.79, 2.46, 3.33, 4.49, 33.94, 12.13, 6.95, 7.19, 7.12, 6.72, 6.13, 5.46, 4.79, 5.66, 14.29,
    14.96, 8.97, 4.72, 2.33, 1.47, 1.1, 0.89, 0.83, 1.18, 4.9, 39.59, 72.84, 32.61, 7.52, 2.83, 1.96, 1.67, 4.43,
    11.28, 14.76, 12.73, 9.74, 7.33, 9.72, 55.27, 42.58, 13.18, 13.16, 12.26, 5.11, 2.07, 2.34, 3.58, 3.01, 2.48,
    2.14, 1.54, 1.33, 1.46, 1.94, 2.0, 1.2, 1.35,
)
ILLUMINANT_LED_B1 = (
    0.04, 0.07, 0.15, 0.28, 0.53, 0.92, 1.54, 2.52, 4.16, 6.39, 7.89, 7.57, 6.25, 5.16, 4.37, 3.84, 3.7, 3.88, 4.26,
    4.79, 5.41, 6.05, 6.7, 7.34, 7.98, 8.64, 9.31, 10.02, 10.76, 11.53, 12.38, 13.28, 14.23, 15.2, 16.2, 17.19,
    18.14, 19.02, 19.78, 20.38, 20.8, 21.0, 20.97, 20.71, 20.23, 19.56, 18.76, 17.82, 16.78, 15.66, 14.49, 13.31,
    12.15, 11.02, 9.95, 8.93, 7.98, 7.1, 6.3, 5.57, 4.89,
)
ILLUMINANT_LED_B3 = (
    0.05, 0.11, 0.25, 0.56, 1.2, 2.37, 4.24, 7.17, 12.11, 17.7, 18.87, 14.58, 9.9, 7.53, 6.02, 5.11, 5.17, 5.82,
    6.77, 7.88, 8.94, 9.82, 10.52, 11.06, 11.51, 11.93, 12.37, 12.83, 13.31, 13.79, 14.26, 14.68, 15.08, 15.42,
    15.72, 15.97, 16.18, 16.37, 16.5, 16.55, 16.5, 16.32, 16.0, 15.54, 14.96, 14.27, 13.48, 12.62, 11.71, 10.78,
    9.85, 8.93, 8.04, 7.2, 6.42, 5.69, 5.02, 4.42, 3.88, 3.39, 2.95,
)
ILLUMINANT_LED_B5 = (
    0.07, 0.16, 0.35, 0.78, 1.67, 3.3, 5.94, 9.92, 16.15, 25.15, 32.34, 31.18, 23.46, 16.39, 12.08, 9.08, 7.21,
    6.48, 6.49, 7.05, 8.1, 9.45, 10.88, 12.22, 13.38, 14.29, 14.98, 15.48, 15.81, 16.01, 16.1, 16.13, 16.1, 15.98,
    15.77, 15.5, 15.15, 14.76, 14.31, 13.79, 13.22, 12.59, 11.91, 11.2, 10.47, 9.73, 9.0, 8.27, 7.57, 6.9, 6.25,
    5.65, 5.08, 4.55, 4.06, 3.61, 3.22, 2.86, 2.54, 2.26, 2.0,
)
# fmt: on


# IEC 61966-2-1: primaries and the D65 white (0.3127, 0.3290); the matrix is derived below, not copied rounded.
_SRGB_PRIMARIES_XY = np.array([[0.64, 0.33], [0.30, 0.60], [0.15, 0.06]])
_SRGB_WHITE_XY = np.array([0.3127, 0.3290])
LEAST_CONE = 0.01  # response of a lamp's white, relative to that of the white that it is brought to
# Bradford cone responses: Lam 1985, as in ICC.1:2022 annex E.
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def cie_1931_cmfs() -> np.ndarray:
    """(3, 61) colour-matching functions x, y, z of the CIE 1931 2 degree observer on the working grid."""
    return np.array([CMF_X, CMF_Y, CMF_Z])


def illuminant(name: str) -> np.ndarray:
    """(61,) relative spectral power of a CIE illuminant on the working grid, 100 at 560 nm where tabulated so.

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
    if key in {"F2", "F7", "F11"}:
        key = "FL" + key[1:]
    table = globals().get(f"ILLUMINANT_{key.replace('-', '_')}")
    if table is None:
        raise UserError(
            f"illuminant: expected one of A, D50, D65, E, FL2, FL7, FL11, LED-B1, LED-B3, LED-B5, found {name!r}; "
            "for another lamp give its measured spectrum as a table"
        )
    return np.array(table)


def xyz_matrix(illuminant: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Compute A (3, K) with XYZ = A @ sigma for S = sigma @ basis; Y = 1 for the perfect white S = 1.

    illuminant : (61,); basis : (K, 61). Sums over the 61 bands as CIE 015:2018 eq. 7 tabulates them. For XYZ of spectra
    themselves use `xyz_from_spectra`. Source: Tominaga and Tanaka (2004), eq. 19, exact because the diffuse term is
    linear in sigma.
    """
    lamp = normalised(checked_spectra(illuminant, "illuminant")[0])
    weights = cie_1931_cmfs() * lamp
    total = weights[1].sum()
    if not total > 0:
        raise UserError("illuminant: expected visible power, found none; correct the table")
    return (weights / total) @ checked_spectra(basis, "basis").T


def xyz_from_spectra(illuminant: np.ndarray, spectra: np.ndarray) -> np.ndarray:
    """XYZ (..., 3) of reflectances (..., 61), Y = 1 for the perfect white."""
    return np.asarray(spectra) @ xyz_matrix(illuminant, np.eye(WAVELENGTHS_NM.size)).T


def white_xyz(illuminant: np.ndarray) -> np.ndarray:
    """XYZ (3,) of the perfect white under the illuminant, Y = 1."""
    return xyz_from_spectra(illuminant, np.ones(WAVELENGTHS_NM.size))


def srgb_matrix() -> np.ndarray:
    """(3, 3) from XYZ (relative to D65, white Y = 1) to linear sRGB, IEC 61966-2-1 primaries."""
    xyz = np.column_stack([_SRGB_PRIMARIES_XY, 1.0 - _SRGB_PRIMARIES_XY.sum(axis=1)]).T
    x, y = _SRGB_WHITE_XY
    white = np.array([x / y, 1.0, (1.0 - x - y) / y])
    return np.linalg.inv(xyz * np.linalg.solve(xyz, white))


def adaptation_matrix(white_from: np.ndarray, white_to: np.ndarray) -> np.ndarray:
    """(3, 3) linear Bradford adaptation: maps XYZ seen under `white_from` (3,) to the match under `white_to` (3,).

    Under a lamp so narrow that a cone response of its white is negative or almost none, nothing is white to an eye and
    Bradford's quotients have no meaning: only the luminance is then brought to that of `white_to`.
    """
    white_from, white_to = np.asarray(white_from, float), np.asarray(white_to, float)
    source, target = _BRADFORD @ white_from, _BRADFORD @ white_to
    if not (source * white_to[1] > LEAST_CONE * target * white_from[1]).all():
        return np.eye(3) * (white_to[1] / white_from[1])
    return np.linalg.solve(_BRADFORD, (target / source)[:, None] * _BRADFORD)


def xyz_to_srgb_linear(xyz: np.ndarray, *, white: np.ndarray | None = None) -> np.ndarray:
    """Linear sRGB (..., 3), unclipped, from XYZ (..., 3) with white Y = 1.

    white : XYZ (3,) of the scene's white; if given, Bradford adaptation brings it to RGB (1, 1, 1). None: XYZ is
    relative to D65 already.
    """
    matrix = srgb_matrix()
    if white is not None:
        x, y = _SRGB_WHITE_XY
        matrix = matrix @ adaptation_matrix(white, np.array([x / y, 1.0, (1.0 - x - y) / y]))
    return np.asarray(xyz) @ matrix.T.astype(np.result_type(np.asarray(xyz).dtype, np.float32))


def srgb_encode(linear: np.ndarray) -> np.ndarray:
    """Display values in [0, 1] from linear sRGB, IEC 61966-2-1; values outside [0, 1] are clipped, NaN becomes 0."""
    values = np.clip(np.nan_to_num(np.asarray(linear), nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    return encode(values, "srgb")


def xyz_to_lab(xyz: np.ndarray, white: np.ndarray) -> np.ndarray:
    """CIELAB (..., 3) from XYZ (..., 3) and the white's XYZ (3,), same scale. CIE 015:2018 eq. 8.3-8.10.

    Below (6/29)^3 the function is linear, so zero and negative XYZ have finite Lab.
    """
    ratio = np.asarray(xyz) / np.asarray(white)
    limit = 6.0 / 29.0
    f = np.where(ratio > limit**3, np.cbrt(ratio), ratio / (3.0 * limit**2) + 4.0 / 29.0)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def delta_e_2000(lab1: np.ndarray, lab2: np.ndarray) -> np.ndarray:
    """CIEDE2000 colour difference (...) of Lab arrays (..., 3), kL = kC = kH = 1.

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
    return _weighted_difference(l1, l2, c1, c2, hue_term, mean_hue)


def _weighted_difference(l1, l2, c1, c2, hue_term, mean_hue):
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


Encoding = Literal["linear", "srgb"]
BLOCK = 1 << 16  # values at a time: temporaries stay in the cache
KNEE, CODED_KNEE = 0.0031308, 0.04045
"""Linear value, and code, at which the straight part ends."""
SLOPE, SCALE, OFFSET, POWER = 12.92, 1.055, 0.055, 1 / 2.4


def encode(linear: np.ndarray, encoding: Encoding) -> np.ndarray:
    """Linear values to code values, full scale 1, of any shape; float32 stays float32, all else is float64.

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


def decode(values: np.ndarray, encoding: Encoding) -> np.ndarray:
    """Code values to linear ones: the inverse of `encode`."""

    def curve(values: np.ndarray, out: np.ndarray) -> None:
        np.maximum(values, CODED_KNEE, out=out)
        out += OFFSET
        out *= 1 / SCALE
        np.power(out, 1 / POWER, out=out)
        np.multiply(values, 1 / SLOPE, out=out, where=values <= CODED_KNEE)

    return _through(values, encoding, curve)


def encoding_slope(linear: np.ndarray, encoding: Encoding) -> np.ndarray:
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
    for start in range(0, len(flat), BLOCK):
        part = slice(start, start + BLOCK)
        curve(flat[part], out[part])
    return out.reshape(values.shape)
