"""Convert camera channels to XYZ and Lab: one linear map for prediction and photograph, so that both err alike."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.artifacts.maps import Maps, shrink
from nishiki.colour.colour import illuminant as named_illuminant
from nishiki.colour.colour import srgb_matrix, white_xyz, xyz_from_spectra, xyz_to_lab
from nishiki.colour.sampling import channel_weights
from nishiki.colour.training import synthetic_reflectances
from nishiki.errors import UserError
from nishiki.formats.stored import load_arrays
from nishiki.photometric.flags import NO_ESTIMATE

SMALLEST = 1e-2
"""Smallest used singular value of the channels, relative to the largest: differences along smaller ones are noise."""


@dataclass(frozen=True)
class CameraColour:
    """Linear map of channels: XYZ = channels @ matrix.T, Lab relative to `white`."""

    matrix: np.ndarray  # (3, channels)
    white: np.ndarray  # (3,) XYZ of a perfect white that faces the lamp, Y = 1
    how: str  # in words, where the map comes from
    rmse: float | None  # root mean square error of XYZ over the training spectra, or None where nothing was fitted

    def xyz(self, channels: np.ndarray) -> np.ndarray:
        """Compute XYZ (..., 3) float64 of channels (..., C) that are relative to white."""
        return np.asarray(channels, np.float64) @ self.matrix.T

    def lab(self, channels: np.ndarray) -> np.ndarray:
        """Compute CIELAB (..., 3) of channels (..., C)."""
        return xyz_to_lab(self.xyz(channels), self.white)


def fitted_colour(training: np.ndarray, illuminant: np.ndarray, sensitivities: np.ndarray) -> CameraColour:
    """Fit by least squares over training reflectances (M, 61), with the perfect white kept exact.

    illuminant : (61,) of the capture; sensitivities : (C, 61). The constraint (channels of white = 1 give the white of
    the lamp) is met by fitting the differences from white only, through an elimination: matrix = white/C + deviations
    from it that sum to 0 in every row.
    """
    responses = training @ channel_weights(illuminant, sensitivities).T
    xyz, white = xyz_from_spectra(illuminant, training), white_xyz(illuminant)
    count = responses.shape[1]
    # rows of the matrix = white / C + B t, B: basis of the vectors of sum 0
    sum_free = np.linalg.svd(np.ones((1, count)))[2][1:]
    rest = xyz - responses.mean(axis=1, keepdims=True) * white
    parts = np.linalg.lstsq(responses @ sum_free.T, rest, rcond=SMALLEST)[0] if count > 1 else np.zeros((0, 3))
    matrix = white[:, None] / count + parts.T @ sum_free
    rmse = float(np.sqrt(np.mean((responses @ matrix.T - xyz) ** 2)))
    how = f"linear map from the camera's sensitivities, least squares over {len(training)} reflectances, white exact"
    return CameraColour(matrix, white, how, rmse)


def read_camera_colour(curves: Path, channels: int, to_srgb: list[list[float]] | None = None) -> CameraColour:
    """Read the map from camera channels to XYZ: fitted where `curves.npz` has camera and lamp, else assumed."""
    stored = load_arrays(curves) if curves.is_file() else {}
    if len(stored.get("sensitivities", ())) == channels and "illuminant" in stored:
        return fitted_colour(synthetic_reflectances(), stored["illuminant"], stored["sensitivities"])
    return assumed_colour(channels, to_srgb)


def displayed_colours(channels: np.ndarray, to_srgb: list[list[float]] | None) -> np.ndarray:
    """Convert channels (..., C) without sensitivities to linear sRGB (..., 3); see `assumed_colour`."""
    if channels.shape[-1] != 3:
        return np.repeat(channels.mean(axis=-1, keepdims=True), 3, axis=-1)
    return channels if to_srgb is None else (channels @ np.array(to_srgb).T).astype(channels.dtype)


LIGHT_PERCENTILE = 95
"""Percentile of a channel's reflectances at which the object's light parts are assumed grey."""
LARGEST_FACTOR = 3.0  # of a channel
MOST_SAMPLES = 16_000_000  # pixels that are looked at, evenly spread


def display_map(maps: Maps) -> list[list[float]] | None:
    """Return the matrix (3, 3) from a painting's reflectance to linear sRGB for pictures; None: it is sRGB already.

    Without a white board, linear photographs have the colours of lamp and sensor, which no camera has balanced. The
    light parts of the object are shown as grey then, with the luminance of a white kept.
    """
    to_srgb = maps.group.attrs.get("to_srgb")
    if not maps.group.attrs.get("unbalanced") or maps.group["reflectance"].shape[-1] != 3:
        return to_srgb
    shape = maps.group["reflectance"].shape[:2]
    step = math.ceil(math.sqrt(shape[0] * shape[1] / MOST_SAMPLES))
    flags = shrink(lambda rows: maps.read("flags", rows), shape, step, "middle")
    colours = shrink(lambda rows: maps.read("reflectance", rows), shape, step, "middle")
    colours = displayed_colours(colours, to_srgb)[(flags & NO_ESTIMATE) == 0]
    if not len(colours):
        return to_srgb
    light = np.percentile(colours, LIGHT_PERCENTILE, axis=0)
    factors = np.clip(light.mean() / np.maximum(light, 1e-9), 1 / LARGEST_FACTOR, LARGEST_FACTOR)
    luminance = np.linalg.inv(srgb_matrix())[1]  # of linear sRGB, Y of XYZ
    balance = np.diag(factors / (luminance @ factors))
    return (balance if to_srgb is None else balance @ np.array(to_srgb)).tolist()


def assumed_colour(channels: int, to_srgb: list[list[float]] | None = None) -> CameraColour:
    """Assume the colour of a camera without sensitivities.

    Three channels are read in the primaries that the photographs state (`to_srgb`, (3, 3) to linear sRGB), else as
    linear sRGB, any other number as grey (their mean).
    """
    if channels < 1:
        raise UserError(f"colour: expected at least one channel, found {channels}")
    white = white_xyz(named_illuminant("D65"))
    if channels == 3:
        how = "no sensitivities: the channels are read as linear sRGB, which is a guess about the camera"
        matrix = np.linalg.inv(srgb_matrix())
        if to_srgb is not None:
            how = "no sensitivities: the channels are read in the primaries that the photographs state"
            matrix = matrix @ np.array(to_srgb)
        return CameraColour(matrix, matrix.sum(axis=1), how, None)
    what = "the one channel" if channels == 1 else f"the mean of {channels} channels"
    how = f"no sensitivities: {what} is read as luminance, so that only lightness differs"
    return CameraColour(np.repeat(white[:, None] / channels, channels, axis=1), white, how, None)
