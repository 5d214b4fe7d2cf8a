"""The simulated object: its relief, its paints, its varnish."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nishiki.simulate.painting.paints import REGION, REGIONS, Palette, make_palette
from nishiki.simulate.painting.picture import BRANCHES, branch_curve, plan_landscape
from nishiki.simulate.painting.relief import level_out, pixel_maps, weave_under_paint
from nishiki.simulate.painting.settings import SimulationSettings
from nishiki.simulate.painting.strokes import LAYERS, Strokes, apply_strokes, place_strokes
from nishiki.simulate.randomness import fractal_noise, subkey
from nishiki.simulate.sensor import FINE_NM

PICTURE_HEIGHT_MM = 77.0  # the brushes were chosen for a picture of this height


@dataclass(frozen=True)
class SimulatedObject:
    """Samples are finer than camera pixels by the supersampling s.

    height_mm : (rows·s, columns·s) float32; label : (rows·s, columns·s) uint8, paint of each sample; palette : the
    paints (spectra at `FINE_NM`); waves : (rows, columns, 2) float32 slopes of the varnish against the paint; on camera
    pixels: normals (rows, columns, 3), mean_height_mm and steepest (radians), float32; ceiling_mm : highest point.
    """

    height_mm: np.ndarray
    label: np.ndarray
    palette: Palette
    waves: np.ndarray
    normals: np.ndarray
    mean_height_mm: np.ndarray
    steepest: np.ndarray
    ceiling_mm: float


def make_object(settings: SimulationSettings) -> SimulatedObject:
    """The object that the settings describe; the same for any number of threads."""
    palette = make_palette(FINE_NM, alpha=settings.alpha, seed=settings.seed)
    make = {"painting": _painting, "spheres": _spheres}[settings.scene]
    height, label = make(settings, palette)
    step = settings.pitch_mm / settings.supersampling
    if settings.relief == "flat" and settings.scene == "painting":
        height = np.zeros_like(height)
    height *= np.float32(settings.relief_gain)
    normals, mean, steepest = pixel_maps(height, step_mm=step, supersampling=settings.supersampling)
    return SimulatedObject(
        height,
        label,
        palette,
        _varnish_waves(settings),
        normals,
        mean,
        steepest,
        float(height.max()),
    )


def _varnish_waves(settings):
    waves = np.zeros((settings.rows, settings.columns, 2), np.float32)
    if settings.relief == "flat":
        return waves
    for start in range(0, settings.rows, 256):
        band = slice(start, min(start + 256, settings.rows))
        y, x = np.mgrid[band, 0 : settings.columns] * (settings.pitch_mm / 3.0)
        for axis in range(2):
            waves[band, :, axis] = 0.10 * (
                fractal_noise(x, y, key=subkey(settings.seed, f"varnish {axis}"), octaves=2) - 0.5
            )
    return waves


def brush_scale(settings: SimulationSettings) -> float:
    """Size of brushes and threads: follows the picture up to a limit, and is never too fine for the camera."""
    return max(min(settings.rows * settings.pitch_mm / PICTURE_HEIGHT_MM, 1.2), 3.0 * settings.pitch_mm)


def _painting(settings, palette):
    s = settings.supersampling
    plan = plan_landscape(settings.rows, settings.columns, seed=settings.seed)
    paint = np.zeros((settings.rows * s, settings.columns * s), np.float32)
    label = np.full(paint.shape, palette.first[REGION["ground"]], np.uint8)
    scale = brush_scale(settings)
    step = settings.pitch_mm / s
    ridge = 1.0 if settings.relief == "impasto" else 0.12
    for layer in range(len(LAYERS)):
        strokes = place_strokes(
            plan, palette, layer, pitch_mm=settings.pitch_mm, scale=scale, ridge=ridge, seed=settings.seed
        )
        apply_strokes(paint, label, plan, strokes, step_mm=step)
    plan.group[:] = 0
    apply_strokes(paint, label, plan, _blossoms(settings, palette, scale, ridge), step_mm=step)
    height = level_out(weave_under_paint(paint, step_mm=step, scale=scale))
    return height, label


def _blossoms(settings, palette, scale, ridge):
    """Five thick petals a blossom, scattered along the branches."""
    random = np.random.default_rng(subkey(settings.seed, "blossoms"))
    height_mm = settings.rows * settings.pitch_mm
    centres = []
    for *points, _ in BRANCHES:
        t = np.sort(random.uniform(0.12, 1.0, 30))
        u, v = branch_curve(points, t)
        spread = random.normal(0.0, 0.016, (2, t.size))
        centres.append(np.stack([(u + spread[0]) * height_mm, (v + spread[1]) * height_mm], axis=1))
    centres = np.concatenate(centres)
    count, petals = len(centres), 5
    turn = (np.arange(petals) / petals * 2 * np.pi + random.uniform(0, 2 * np.pi, (count, 1))).ravel()
    radius = np.repeat(random.uniform(0.65, 1.15, count), petals) * scale
    first, steps = palette.first[REGION["blossom"]], palette.steps[REGION["blossom"]]
    tone = np.clip(
        np.repeat(random.integers(0, steps, count), petals) + random.integers(-1, 2, turn.size), 0, steps - 1
    )
    return Strokes(
        x=np.repeat(centres[:, 0], petals) + 0.75 * radius * np.cos(turn),
        y=np.repeat(centres[:, 1], petals) + 0.75 * radius * np.sin(turn),
        angle=turn,
        bend=np.zeros(turn.size),
        length=1.7 * radius,
        width=1.25 * radius,
        thickness=random.uniform(0.09, 0.15, turn.size) * scale,
        ridge=ridge * random.uniform(0.5, 1.0, turn.size),
        label=(first + tone).astype(np.uint8),
        group=np.zeros(turn.size, np.uint8),
        key=random.integers(0, 2**62, turn.size).astype(np.uint64),
    )


def _spheres(settings, palette):
    """A tray of sphere caps, each of one paint, rim slope 55°; between them the tray is flat and grey."""
    s, step = settings.supersampling, settings.pitch_mm / settings.supersampling
    rows, columns = settings.rows * s, settings.columns * s
    across = 6 if settings.columns >= settings.rows else 4
    cell = columns / across
    down = max(int(rows / cell), 1)
    cell_rows = rows / down
    i, j = np.arange(rows)[:, None] + 0.5, np.arange(columns)[None, :] + 0.5
    cell_i, cell_j = np.floor(i / cell_rows), np.floor(j / cell)
    rim = 0.44 * min(cell, cell_rows) * step
    radius = rim / math.sin(math.radians(55.0))
    square = ((i / cell_rows - cell_i - 0.5) * cell_rows * step) ** 2 + ((j / cell - cell_j - 0.5) * cell * step) ** 2
    inside = square < rim * rim
    height = np.where(inside, np.sqrt(np.maximum(radius**2 - square, 0.0)) - math.sqrt(radius**2 - rim**2), 0.0)
    random = np.random.default_rng(subkey(settings.seed, "spheres"))
    chosen = random.permutation(np.arange(1, len(REGIONS)))
    regions = chosen[((cell_i * across + cell_j) % chosen.size).astype(int)]
    paint = palette.first[regions] + palette.steps[regions] // 2
    tray = palette.first[REGION["grey 3"]]
    return height.astype(np.float32), np.where(inside, paint, tray).astype(np.uint8)
