"""Find a colour target in a photograph, and estimate colour errors and spectral sensitivities from it.

The target is the ColorChecker Classic with 24 patches. Its reference colours follow from mean reflectances of thirty
charts (BabelColor, as tabulated in colour-science), or from a table of the chart's own.
"""

import warnings
from dataclasses import dataclass

import numpy as np

from nishiki.calibrate.result import SATURATED_SHARE
from nishiki.colour.colour import adaptation_matrix, delta_e_2000, srgb_matrix, white_xyz, xyz_to_lab
from nishiki.colour.colour import illuminant as named_illuminant
from nishiki.colour.sampling import WAVELENGTHS_NM, channel_weights
from nishiki.errors import UserError
from nishiki.installation import optional

ROWS, COLUMNS = 4, 6
NEUTRAL = slice(18, 24)
"""The grey scale, from white to black."""
HALF_WINDOW = 0.2
"""Half a side of the averaged square, in distances between patches: patches are at least 0.8 wide."""
WIDEST = 1600
"""Largest width in pixels of the picture in which the target is searched."""
LIKENESS = 0.9
"""Lowest correlation of the patches' lightness with the reference; lower values mean other patches."""


@dataclass(frozen=True)
class Patches:
    """Measurements of the 24 patches in a photograph, in the order of the reference."""

    # mean, deviation: (24, 3) float64: of the pixels in the middle of each patch, relative to full scale, as stored
    mean: np.ndarray
    deviation: np.ndarray
    clipped: np.ndarray  # (24,) float64: share of pixels with a channel at full scale
    corners: np.ndarray  # (24, 4, 2) float64: corners of the squares that were averaged, (x, y) in pixels

    @property
    def usable(self) -> np.ndarray:
        """(24,) bool: unclipped patches."""
        return self.clipped < SATURATED_SHARE


@dataclass(frozen=True)
class ColourErrors:
    """Differences of 24 colours from the reference."""

    xyz: np.ndarray  # xyz, lab: (24, 3): under D50; a perfect white has Y = 1 and L* = 100
    lab: np.ndarray
    delta_e: np.ndarray  # (24,): CIEDE2000; NaN where the patch is not usable
    lightness: float  # largest |difference of L*| of the grey scale
    white_balance: float  # largest distance in the plane of a* and b* of the grey scale

    @property
    def summary(self) -> dict[str, float]:
        """Figures compared with the criteria."""
        return {
            "delta_e_mean": float(np.nanmean(self.delta_e)),
            "delta_e_90th_percentile": float(np.nanpercentile(self.delta_e, 90)),
            "delta_e_max": float(np.nanmax(self.delta_e)),
            "lightness_max": self.lightness,
            "white_balance_max": self.white_balance,
        }

    def as_dict(self) -> dict[str, object]:
        """Return the figures of all patches and their summary for JSON."""
        differences = [float(value) if np.isfinite(value) else None for value in self.delta_e]
        return {**self.summary, "lab_d50": self.lab.tolist(), "delta_e": differences}


CRITERIA: dict[str, dict[str, dict[str, float]]] = {
    "ISO 19264-1:2021": {
        "A": {"delta_e_mean": 4, "delta_e_max": 10, "lightness_max": 2, "white_balance_max": 3},
        "B": {"delta_e_mean": 5, "delta_e_max": 15, "lightness_max": 3, "white_balance_max": 4},
        "C": {"delta_e_mean": 5, "delta_e_max": 15, "lightness_max": 4, "white_balance_max": 5},
    },
    "FADGI 2023": {
        "4 stars": {"delta_e_mean": 2, "delta_e_90th_percentile": 4, "lightness_max": 1.5, "white_balance_max": 2},
        "3 stars": {"delta_e_mean": 3.5, "delta_e_90th_percentile": 7, "lightness_max": 3, "white_balance_max": 4},
        "2 stars": {"delta_e_mean": 5, "delta_e_90th_percentile": 10, "lightness_max": 4.5, "white_balance_max": 6},
        "1 star": {"delta_e_mean": 6.5, "delta_e_90th_percentile": 13, "lightness_max": 6, "white_balance_max": 8},
    },
}
"""Limits of colour, tone and white balance, best level first: those of ISO 19264-1 and of FADGI for bound collections,
from published comparisons of the two. Resolution, sharpness, noise, evenness and geometry have limits of their own."""


def verdict(figures: dict[str, float], standard: str) -> str:
    """Return the best level of a standard all of whose limits are met; "none" where there is none."""
    for level, limits in CRITERIA[standard].items():
        if all(figures[name] <= limit for name, limit in limits.items()):
            return level
    return "none"


def find_target(picture: np.ndarray) -> np.ndarray:
    """Find the corners of the middles of the 24 patches of a ColorChecker Classic in a picture.

    Parameters
    ----------
    picture : (rows, columns, 3) uint8
        sRGB-coded, red first.

    Returns
    -------
    (24, 4, 2) float64
        As of `Patches.corners`.

    Raises
    ------
    UserError
        Where none is found.
    """
    import cv2

    scale = max(1.0, picture.shape[1] / WIDEST)
    small = cv2.resize(picture, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
    detector = cv2.mcc.CCheckerDetector.create()
    detector.setColorChartType(cv2.mcc.MCC24)
    if not detector.process(np.ascontiguousarray(small[..., ::-1]), 1):
        raise UserError(
            "no ColorChecker Classic was found. Remedy: give the middles of its four corner patches with --corners: "
            "dark skin, bluish green, black, white, each as X,Y in pixels"
        )
    charts = np.array(detector.getBestColorChecker().getColorCharts(), np.float64).reshape(ROWS * COLUMNS, 4, 2)
    middles = charts.mean(axis=1) * scale + (scale - 1) / 2
    grid = _grid()
    plane, _ = cv2.findHomography(grid, middles)
    return _windows(plane)


def target_at(corners: np.ndarray) -> np.ndarray:
    """Compute patch corners (24, 4, 2) from the middles (4, 2) of dark skin, bluish green, black and white.

    Raises UserError where these four lie on a line or cross.
    """
    import cv2

    corners = np.asarray(corners, np.float32)
    turned = np.diff(np.concatenate([corners, corners[:2]]), axis=0)
    sense = turned[:-1, 0] * turned[1:, 1] - turned[:-1, 1] * turned[1:, 0]
    if not (np.all(sense > 0) or np.all(sense < 0)):
        raise UserError(
            "the four corners do not surround the target. Remedy: give dark skin, bluish green, black, white"
        )
    last = COLUMNS - 1, ROWS - 1
    square = np.array([(0, 0), (last[0], 0), last, (0, last[1])], np.float32)
    return _windows(cv2.getPerspectiveTransform(square, corners))


def _grid() -> np.ndarray:
    """Return places (24, 2) of the patches, in distances between patches."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    return np.stack([x.ravel(), y.ravel()], axis=-1).astype(np.float64)


def _windows(plane: np.ndarray) -> np.ndarray:
    """Project corners (24, 4, 2) of the averaged squares by a homography (3, 3) from the grid to pixels."""
    import cv2

    square = HALF_WINDOW * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    places = (_grid()[:, None] + square).reshape(1, -1, 2)
    return cv2.perspectiveTransform(places, plane).reshape(-1, 4, 2)


def read_patches(values: np.ndarray, corners: np.ndarray, full_scale: float) -> Patches:
    """Average the patches in a photograph.

    Parameters
    ----------
    values : (rows, columns, 3)
        As stored.
    corners : (24, 4, 2)
        As of `Patches.corners`.
    full_scale : float
        Value at which a pixel is saturated.

    Raises
    ------
    UserError
        Where a patch lies outside of the picture or is smaller than 3 x 3 pixels.
    """
    import cv2

    means, deviations, clipped = (np.empty((len(corners), 3)) for _ in range(3))
    rows, columns = values.shape[:2]
    for k, quad in enumerate(corners):
        low, high = np.floor(quad.min(axis=0)).astype(int), np.ceil(quad.max(axis=0)).astype(int) + 1
        if (low < 0).any() or high[0] > columns or high[1] > rows:
            raise UserError(f"patch {k + 1} of the target lies outside of the photograph. Remedy: correct --corners")
        inside = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
        cv2.fillConvexPoly(inside, np.round(quad - low).astype(np.int32), 1)
        pixels = values[low[1] : high[1], low[0] : high[0]][inside > 0].astype(np.float64) / full_scale
        if len(pixels) < 9:
            raise UserError(
                f"patch {k + 1}: expected 9 pixels, found {len(pixels)}. Remedy: photograph the target larger"
            )
        means[k], deviations[k] = pixels.mean(axis=0), pixels.std(axis=0)
        clipped[k] = (pixels >= 1 - 1e-6).any(axis=1).mean()
    return Patches(means, deviations, clipped[:, 0], corners)


def expect_target(linear: np.ndarray, reference: np.ndarray) -> None:
    """Raise UserError unless linear values (24, 3) are as light and dark as the reference XYZ (24, 3)."""
    seen, known = np.log(np.maximum(linear.mean(axis=1), 1e-4)), np.log(np.maximum(reference[:, 1], 1e-4))
    if np.corrcoef(seen, known)[0, 1] >= LIKENESS:
        return
    turned = np.corrcoef(seen[::-1], known)[0, 1] >= LIKENESS
    cause = "the corners were given the other way round" if turned else "the corners are not those of the target"
    raise UserError(
        f"the patches are not as light and dark as those of a ColorChecker Classic: {cause}. Remedy: give the middles "
        "of dark skin, bluish green, black and white with --corners, in this order"
    )


def errors_of(xyz: np.ndarray, reference: np.ndarray, usable: np.ndarray, *, delivered: bool = False) -> ColourErrors:
    """Compute colour differences of XYZ (24, 3) from the reference (24, 3), both under D50, perfect white Y = 1.

    delivered: `xyz` is linear sRGB, of which a viewer of the picture sees the XYZ adapted from D65.
    """
    white = white_xyz(named_illuminant("D50"))
    if delivered:
        to_xyz = np.linalg.inv(srgb_matrix())
        xyz = xyz @ to_xyz.T @ adaptation_matrix(to_xyz.sum(axis=1), white).T
    lab, expected = xyz_to_lab(xyz, white), xyz_to_lab(reference, white)
    difference = np.where(usable[:, None], lab - expected, np.nan)[NEUTRAL]
    return ColourErrors(
        xyz,
        lab,
        np.where(usable, delta_e_2000(lab, expected), np.nan),
        float(np.nanmax(np.abs(difference[:, 0]))),
        float(np.nanmax(np.hypot(difference[:, 1], difference[:, 2]))),
    )


def fitted_xyz(linear: np.ndarray, reference: np.ndarray, usable: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the best linear map of the camera, and predict each colour (24, 3) from the other patches.

    Least squares of XYZ relative to the patch's luminance, so that dark patches count as light ones do.

    Returns
    -------
    matrix : (3, 3)
        XYZ = matrix @ channels, from all usable patches.
    predicted : (24, 3)
        XYZ of each patch by the map of the usable others.
    """
    weight = 1 / np.maximum(reference[:, 1], 0.02)

    def fit(chosen: np.ndarray) -> np.ndarray:
        scaled = weight[chosen, None]
        return np.linalg.lstsq(scaled * linear[chosen], scaled * reference[chosen], rcond=None)[0].T

    matrix, predicted = fit(usable), np.empty_like(reference)
    for k in range(len(linear)):
        others = usable.copy()
        others[k] = False
        predicted[k] = fit(others) @ linear[k]
    return matrix, predicted


@dataclass(frozen=True)
class Sensitivities:
    """Sensitivities estimated from a target."""

    # (3, 61) float64: on the working grid (400 to 700 nm, every 5 nm), the largest of each channel at 1, never negative
    curves: np.ndarray
    residual: float  # root mean square of what they leave of the patches, relative to the white patch
    left_out: float  # the same of patches that were left out in turn


def chart_reflectances() -> tuple[tuple[str, ...], np.ndarray]:
    """Return names and reflectances (24, 61) of the ColorChecker Classic: means of thirty charts, BabelColor 2012."""
    colour = _colour_science()
    chart = colour.SDS_COLOURCHECKERS["BabelColor Average"]
    curves = [np.interp(WAVELENGTHS_NM, each.wavelengths, each.values) for each in chart.values()]
    return tuple(chart), np.array(curves)


def recover(linear: np.ndarray, illuminant: np.ndarray, reflectances: np.ndarray, usable: np.ndarray) -> Sensitivities:
    """Estimate each channel's sensitivity as two principal components of 28 cameras (Jiang et al. 2013, eq. 5).

    Parameters
    ----------
    linear : (24, 3)
        Linear values of the patches.
    illuminant : (61,)
        Spectrum of the lamp on the working grid.
    reflectances : (24, 61)
        Reflectance of each patch.
    usable : (24,) bool
        Patches that take part.

    Notes
    -----
    The components are those of Dyer et al. (2017), computed from the cameras of Jiang et al.
    """
    fit = _fit(linear[usable], illuminant, reflectances[usable])
    expected = _responses(fit, illuminant, reflectances, linear, usable)
    left_out = np.empty_like(linear)
    for k in np.flatnonzero(usable):
        others = usable.copy()
        others[k] = False
        curves = _fit(linear[others], illuminant, reflectances[others])
        left_out[k] = _responses(curves, illuminant, reflectances, linear, others)[k]
    white = linear[18].mean()
    return Sensitivities(
        fit / fit.max(axis=1, keepdims=True),
        float(np.sqrt(np.mean((expected - linear)[usable] ** 2)) / white),
        float(np.sqrt(np.mean((left_out - linear)[usable] ** 2)) / white),
    )


def _fit(linear: np.ndarray, illuminant: np.ndarray, reflectances: np.ndarray) -> np.ndarray:
    """Fit curves (3, 61), not normalised."""
    colour = _colour_science()
    shape = colour.SpectralShape(400, 700, 10)
    every = slice(None, None, 2)
    grid = WAVELENGTHS_NM[every]
    lamp = colour.SpectralDistribution(illuminant[every] / illuminant.max(), grid)
    patches = colour.MultiSpectralDistributions(reflectances.T[every], grid)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        recovered = colour.recovery.RGB_to_msds_camera_sensitivities_Jiang2013(linear, lamp, patches, shape=shape)
    curves = np.array([np.interp(WAVELENGTHS_NM, recovered.wavelengths, values) for values in recovered.values.T])
    return np.maximum(curves, 0)


def _responses(curves, illuminant, reflectances, linear, usable) -> np.ndarray:
    """Predict values (24, 3) from curves, each channel scaled to fit the usable patches best."""
    seen = reflectances @ channel_weights(illuminant, curves).T
    scale = np.sum(seen[usable] * linear[usable], axis=0) / np.sum(seen[usable] ** 2, axis=0)
    return scale * seen


def _colour_science():
    """Import the package without its warnings about other missing packages."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return optional("colour-science")
