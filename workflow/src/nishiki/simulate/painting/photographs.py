"""Photographs of the simulated object, of the white board and of the closed lens, and the truth behind them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nishiki.simulate.painting.lamp import Lamp, beam_strength, board_cosine, planck_spectrum, vignette
from nishiki.simulate.painting.objects import SimulatedObject
from nishiki.simulate.painting.paints import camera_tables, make_palette, xyz_tables
from nishiki.simulate.painting.settings import SimulationSettings
from nishiki.simulate.painting.shading import shade
from nishiki.simulate.randomness import subkey
from nishiki.simulate.sensor import expose

BOARD_REFLECTANCE = 0.98
WAVELENGTHS_NM = np.arange(400.0, 700.5, 5.0)
_BAND_ROWS = 256


@dataclass(frozen=True)
class Photograph:
    """codes : (rows, columns, channels) uint16. lit : (rows, columns) uint8, percent of the pixel that the lamp lights.

    The following are None for sample lights. They are relative to a perfect white diffuser facing the lamp (Y = 1),
    without noise, and include the correction for the board's tilt that a white-normalised observation carries:
    xyz_lamp, xyz_d65 : (rows, columns, 3) float32 under the lamp's own spectrum and under D65; gloss, body :
    (rows, columns) float32, shares of the mirror reflection and of the body's reflection (as Y) under the lamp.
    """

    codes: np.ndarray
    lit: np.ndarray
    xyz_lamp: np.ndarray | None = None
    xyz_d65: np.ndarray | None = None
    gloss: np.ndarray | None = None
    body: np.ndarray | None = None


@dataclass(frozen=True)
class Tables:
    """Colour tables (labels, n), the same for squared reflectance, and the values of a perfect white (n,).

    Columns: the camera's channels; for check lights XYZ under the lamp and XYZ under D65 follow. `signal` (channels,)
    is what a perfect white facing the lamp gives in each channel, relative to a full well.
    """

    table: np.ndarray
    squared: np.ndarray
    white: np.ndarray
    signal: np.ndarray


def make_tables(thing: SimulatedObject, settings: SimulationSettings, *, with_truth: bool) -> Tables:
    """The colour tables for sample lights, or for check lights with their truth."""
    table, squared, response = camera_tables(thing.palette, settings)
    parts, squares, whites = [table], [squared], [np.ones(table.shape[1])]
    if with_truth:
        from nishiki.colour.colour import illuminant

        spectra = true_spectra(settings)
        for lamp in (planck_spectrum(WAVELENGTHS_NM, settings.lights.colour_temperature_k), illuminant("D65")):
            xyz, xyz_squared, xyz_white = xyz_tables(spectra, lamp)
            parts.append(xyz)
            squares.append(xyz_squared)
            whites.append(xyz_white)
    return Tables(np.hstack(parts), np.hstack(squares), np.concatenate(whites), response * settings.camera.white_level)


def true_spectra(settings: SimulationSettings) -> np.ndarray:
    """Reflectance (labels, 61) of every paint at 400, 405 .. 700 nm."""
    return make_palette(WAVELENGTHS_NM, alpha=settings.alpha, seed=settings.seed).spectra


def bands(settings: SimulationSettings) -> Iterator[slice]:
    """Row slices in which the pictures are computed; they bound the memory and do not change a byte."""
    for start in range(0, settings.rows, _BAND_ROWS):
        yield slice(start, min(start + _BAND_ROWS, settings.rows))


def photograph(thing: SimulatedObject, lamp: Lamp, settings: SimulationSettings, tables: Tables) -> Photograph:
    """The object under one lamp. Truth is returned where `tables` carry it."""
    channels = settings.camera.channels
    shape = (settings.rows, settings.columns)
    codes, lit = np.empty((*shape, channels), np.uint16), np.empty(shape, np.uint8)
    truth = None
    if tables.table.shape[1] > channels:
        truth = {"xyz_lamp": (3,), "xyz_d65": (3,), "gloss": (), "body": ()}
        truth = {name: np.empty((*shape, *tail), np.float32) for name, tail in truth.items()}
    key = subkey(settings.seed, f"noise sample {lamp.name}")
    for rows in bands(settings):
        shading = shade(thing, lamp, settings, table=tables.table, squared=tables.squared, rows=rows)
        observed = shading.body + shading.gloss[..., None] * tables.white.astype(np.float32)
        strength = (beam_strength(lamp, settings, rows) * vignette(settings, rows)).astype(np.float32)
        signal = observed[..., :channels] * strength[..., None] * tables.signal.astype(np.float32)
        codes[rows] = expose(signal, settings.camera, key=key, first_row=rows.start)
        lit[rows] = np.rint(100.0 * shading.lit)
        if truth is not None:
            tilt = (lamp.direction[2] / board_cosine(lamp, settings, rows)).astype(np.float32)
            truth["xyz_lamp"][rows] = observed[..., channels : channels + 3] * tilt[..., None]
            truth["xyz_d65"][rows] = observed[..., channels + 3 :] * tilt[..., None]
            truth["gloss"][rows] = shading.gloss * tilt
            truth["body"][rows] = shading.body[..., channels + 1] * tilt
    return Photograph(codes, lit, **(truth or {}))


def white_board(lamp: Lamp, settings: SimulationSettings, tables: Tables) -> np.ndarray:
    """Codes (rows, columns, channels) of the flat, matt white board in the place of the object under one lamp."""
    codes = np.empty((settings.rows, settings.columns, settings.camera.channels), np.uint16)
    key = subkey(settings.seed, f"noise white {lamp.name}")
    for rows in bands(settings):
        light = beam_strength(lamp, settings, rows) * board_cosine(lamp, settings, rows) * vignette(settings, rows)
        signal = BOARD_REFLECTANCE * light[..., None] * tables.signal
        codes[rows] = expose(signal, settings.camera, key=key, first_row=rows.start)
    return codes
