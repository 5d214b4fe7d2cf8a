"""Lay brush strokes and build the simulated object: its relief, its paints, its varnish."""

import math
from dataclasses import dataclass

import numba
import numpy as np

from nishiki.simulate.capture import FINE_NM
from nishiki.simulate.painting.picture import BRANCHES, CanvasMap, branch_curve, plan_landscape
from nishiki.simulate.painting.relief import SimulatedObject, level_out, pixel_maps, weave_under_paint
from nishiki.simulate.painting.settings import REGION, REGIONS, Palette, SimulationSettings, make_palette
from nishiki.simulate.randomness import fractal_noise, line_noise, plane_noise, subkey
from nishiki.threads import strips

# (width mm, spacing mm, thickness mm, only where the plan wants strokes finer than this share)
LAYERS = ((3.6, 3.0, 0.050, 9.0), (2.2, 1.75, 0.075, 9.0), (1.5, 1.20, 0.085, 0.85), (1.0, 0.85, 0.080, 0.50))
LENGTH_TO_WIDTH = 4.5  # of a brush stroke


@dataclass(frozen=True)
class Strokes:
    """One row a stroke, in the order in which they are painted (all float64 but label, group (uint8) and key (uint64)).

    x, y : mm from the upper left corner of the picture, y downwards. angle : radians. bend : 1/mm. length, width,
    thickness : mm. ridge : 0..1, how much paint is pushed to the edges and the end.
    """

    x: np.ndarray
    y: np.ndarray
    angle: np.ndarray
    bend: np.ndarray
    length: np.ndarray
    width: np.ndarray
    thickness: np.ndarray
    ridge: np.ndarray
    label: np.ndarray
    group: np.ndarray
    key: np.ndarray


def place_strokes(
    plan: CanvasMap, palette: Palette, layer: int, *, pitch_mm: float, scale: float, ridge: float, seed: int
) -> Strokes:
    """Place strokes of one layer on a jittered grid, in random order, each with the paint of the plan at its centre.

    scale : size of the brushes (1 for a picture about 80 mm high). ridge : 0 = thin paint, 1 = impasto.
    """
    width, spacing, thickness, finer_than = LAYERS[layer]
    random = np.random.default_rng(subkey(seed, f"strokes {layer}"))
    rows, columns = plan.region.shape
    step = spacing * scale
    grid_x = np.arange(0.5 * step, columns * pitch_mm, step)
    grid_y = np.arange(0.5 * step, rows * pitch_mm, step)
    x, y = (axis.ravel() for axis in np.meshgrid(grid_x, grid_y))
    order = random.permutation(x.size)
    x = (x + step * random.uniform(-0.6, 0.6, x.size))[order]
    y = (y + step * random.uniform(-0.6, 0.6, y.size))[order]
    row = np.clip((y / pitch_mm).astype(int), 0, rows - 1)
    column = np.clip((x / pitch_mm).astype(int), 0, columns - 1)
    keep = plan.size[row, column] <= finer_than
    x, y, row, column = x[keep], y[keep], row[keep], column[keep]
    region, size, body = plan.region[row, column], plan.size[row, column], plan.body[row, column]
    count = x.size
    steps = palette.steps[region]
    tone = np.rint(plan.tone[row, column] * (steps - 1) + random.normal(0.0, 0.55, count)).astype(int)
    breadth = np.minimum(width, 2.6 * width * size) * scale * random.uniform(0.75, 1.25, count)
    return Strokes(
        x=x,
        y=y,
        angle=plan.direction[row, column] + random.normal(0.0, 0.14, count),
        bend=random.normal(0.0, 0.05, count) / scale,
        length=breadth * LENGTH_TO_WIDTH * random.uniform(0.7, 1.3, count) * np.where(body > 1.55, 0.35, 1.0),
        width=breadth,
        thickness=thickness * scale * body * random.uniform(0.7, 1.3, count),
        ridge=ridge * np.clip(random.normal(0.55, 0.3, count) + 0.4 * (body - 1.0), 0.0, 1.2),
        label=(palette.first[region] + np.clip(tone, 0, steps - 1)).astype(np.uint8),
        group=plan.group[row, column],
        key=random.integers(0, 2**62, count).astype(np.uint64),
    )


@numba.njit(cache=True)
def stroke_profile(along, across, length_to_width, ridge, key):
    """Compute coverage (0..1), thickness (relative) of a stroke at `along` (0 start .. 1 end) and `across` (−1 .. 1).

    Bristles leave furrows along the stroke; paint is pushed into ridges at both sides and at the end; towards the end
    the brush runs dry and the furrows open.
    """
    if along <= 0.0 or along >= 1.0:
        return 0.0, 0.0
    ragged = 0.82 + 0.18 * line_noise(key, along * 6.0)
    tip = min(along * length_to_width * 1.4, 1.0)
    half = ragged * math.sqrt(tip * (2.0 - tip))
    q = abs(across) / max(half, 1e-6)
    if q >= 1.0:
        return 0.0, 0.0
    bristles = plane_noise(key + np.uint64(1), across * 3.1, along * 2.5)
    fine = plane_noise(key + np.uint64(2), across * 6.3, along * 5.0)
    furrow = 0.65 * bristles + 0.35 * fine
    dry = max(along - 0.72, 0.0) / 0.28
    cover = min(1.0, (1.0 - q) * 9.0) * min(1.0, max(0.0, (furrow - 0.62 * dry * dry) * 9.0 + 1.0))
    bank = (q - 0.80) / 0.13
    pile = (along - 0.88) / 0.06
    body = 0.45 + 0.75 * (furrow - 0.2) + 1.15 * ridge * math.exp(-bank * bank)
    body += 1.5 * ridge * math.exp(-pile * pile) * (1.0 - q * q)
    return cover, body


@numba.njit(cache=True)
def lay_strokes(paint, label, group_map, strokes, step, s):
    """Lay strokes in order on `paint` (thickness, mm) and `label`, samples `step` mm apart; group_map is coarser by s.

    A stroke levels what lies below it by half and adds its own body: wet paint on paint that is not quite dry.
    """
    x, y, angle, bend, length, width, thickness, ridge, paints, group, key = strokes
    rows, columns = paint.shape
    for index in range(x.size):
        c, sn = math.cos(angle[index]), math.sin(angle[index])
        half_l, half_w = 0.5 * length[index], 0.5 * width[index]
        sag = 0.5 * abs(bend[index]) * half_l * half_l
        reach_x = abs(c) * half_l + abs(sn) * (half_w + sag)
        reach_y = abs(sn) * half_l + abs(c) * (half_w + sag)
        top, bottom = max(int((y[index] - reach_y) / step), 0), min(int((y[index] + reach_y) / step) + 2, rows)
        left, right = max(int((x[index] - reach_x) / step), 0), min(int((x[index] + reach_x) / step) + 2, columns)
        level, count = 0.0, 0
        for part in range(-2, 3):  # paint level under the middle of the stroke
            px, py = x[index] + part * 0.2 * half_l * c, y[index] + part * 0.2 * half_l * sn
            i, j = int(py / step), int(px / step)
            if 0 <= i < rows and 0 <= j < columns:
                level += paint[i, j]
                count += 1
        level = 0.55 * level / max(count, 1)
        for i in range(top, bottom):
            dy = (i + 0.5) * step - y[index]
            for j in range(left, right):
                if group_map[i // s, j // s] != group[index]:
                    continue
                dx = (j + 0.5) * step - x[index]
                run = dx * c + dy * sn
                across = (dy * c - dx * sn - 0.5 * bend[index] * run * run) / half_w
                if abs(across) >= 1.0:
                    continue
                cover, body = stroke_profile(
                    0.5 + 0.5 * run / half_l, across, length[index] / width[index], ridge[index], key[index]
                )
                if cover <= 0.0:
                    continue
                target = 0.5 * paint[i, j] + 0.5 * level + thickness[index] * body
                paint[i, j] += np.float32(cover * (target - paint[i, j]))
                if cover > 0.5:
                    label[i, j] = paints[index]


def apply_strokes(paint: np.ndarray, label: np.ndarray, plan: CanvasMap, strokes: Strokes, *, step_mm: float) -> None:
    """Lay the strokes, in order, on paint (rows·s, columns·s) float32 mm and label uint8, both changed in place."""
    s = strokes
    arrays = s.x, s.y, s.angle, s.bend, s.length, s.width, s.thickness, s.ridge, s.label, s.group, s.key
    lay_strokes(paint, label, plan.group, arrays, step_mm, paint.shape[0] // plan.group.shape[0])


PICTURE_HEIGHT_MM = 77.0  # the brushes were chosen for a picture of this height


def make_object(settings: SimulationSettings) -> SimulatedObject:
    """Make the object that the settings describe; the same for any number of threads."""
    palette = make_palette(FINE_NM, alpha=settings.alpha, seed=settings.seed)
    make = {"painting": _painting, "spheres": _spheres}[settings.scene]
    height, label = make(settings, palette)
    step = settings.pitch_mm / settings.supersampling
    if settings.relief == "flat" and settings.scene == "painting":
        height = np.zeros_like(height)
    height *= np.float32(settings.relief_gain)
    normals, mean, steepest = pixel_maps(height, step_mm=step, supersampling=settings.supersampling)
    return SimulatedObject(
        height, label, palette, _varnish_waves(settings), normals, mean, steepest, float(height.max())
    )


def _varnish_waves(settings):
    waves = np.zeros((settings.rows, settings.columns, 2), np.float32)
    if settings.relief == "flat":
        return waves
    for band in strips(settings.rows):
        y, x = np.mgrid[band, 0 : settings.columns] * (settings.pitch_mm / 3.0)
        for axis in range(2):
            waves[band, :, axis] = 0.10 * (
                fractal_noise(x, y, key=subkey(settings.seed, f"varnish {axis}"), octaves=2) - 0.5
            )
    return waves


def _painting(settings, palette):
    s = settings.supersampling
    plan = plan_landscape(settings.rows, settings.columns, seed=settings.seed)
    paint = np.zeros((settings.rows * s, settings.columns * s), np.float32)
    label = np.full(paint.shape, palette.first[REGION["ground"]], np.uint8)
    # the size of brushes and threads follows the picture up to a limit, and is never too fine for the camera
    scale = max(min(settings.rows * settings.pitch_mm / PICTURE_HEIGHT_MM, 1.2), 3.0 * settings.pitch_mm)
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
    """Place five thick petals a blossom, scattered along the branches."""
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
    """Make a flat grey tray of sphere caps, each of one paint, rim slope 55°."""
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
