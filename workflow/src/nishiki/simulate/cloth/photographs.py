"""Photograph a simulated cloth on the goniometer, and write the capture's folder with the truth behind it."""

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numba
import numpy as np

from nishiki.errors import UserError
from nishiki.simulate import capture as common
from nishiki.simulate.cloth.reflectance import R2, SimulatedCloth, blocks, cell_maps, make_cloth
from nishiki.simulate.cloth.settings import PRESETS, GoniometerSettings, preset, unit
from nishiki.simulate.randomness import subkey, uniform
from nishiki.threads import over_rows

BASE_S = 1.0 / 15.0  # exposure in which a perfect white that faces the lamp reaches camera.white_level
STOPS = (-3, 8)  # exposures are base · 2^k
BRIGHTEST = 0.85  # share of full scale that the brightest pixel of a photograph may reach
TINT = (0.86, 1.0, 0.78)  # what a white gives in each channel, the largest = 1
_SAMPLES = 24  # a pixel


@dataclass(frozen=True)
class SimulatedShot:
    """One photograph.

    row of the session's angles, codes (rows, columns, channels) uint16, exposure in seconds, and the noise-free
    reflectances (cloths, channels) in 1/sr.
    """

    row: int
    codes: np.ndarray
    exposure_s: float
    reflectance: np.ndarray


def photographs(cloths: tuple[SimulatedCloth, ...], settings: GoniometerSettings) -> Iterator[SimulatedShot]:
    """Yield all photographs of the session, not in its order: those that share their rays come together."""
    angles = settings.angles_deg
    incident, outgoing = unit(angles[:, 0], angles[:, 1]), unit(angles[:, 2], angles[:, 3])
    for parts in zip(*(blocks(cloth, incident, outgoing) for cloth in cloths), strict=True):
        maps = [cell_maps(cloth, *part[1:]) for cloth, part in zip(cloths, parts, strict=True)]
        for k, row in enumerate(parts[0][0]):
            cells = [pictures[k] for pictures in maps]
            reflectance = np.array([cell.mean(axis=(0, 1)) for cell in cells])
            light = on_sensor(cells, cloths, angles[row], settings) * (math.pi * incident[row, 2] * np.array(TINT))
            exposure = exposure_for(light, settings)
            signal = light * (settings.camera.white_level * exposure / BASE_S)
            key = subkey(settings.seed, f"cloth noise {row}")
            yield SimulatedShot(int(row), common.expose(signal, settings.camera, key=key), exposure, reflectance)


def on_sensor(cells: list[np.ndarray], cloths, angles_deg: np.ndarray, settings: GoniometerSettings) -> np.ndarray:
    """Compute the BRDF (rows, columns, channels) in the pixels from the periodic pictures of the cells.

    The warp points upwards as far as it can. Of two cloths the first lies on the left, the second on the right of the
    middle.
    """
    view = unit(angles_deg[2], angles_deg[3])
    up = np.array([0.0, 1.0, 0.0]) - view[1] * view
    up /= np.linalg.norm(up)
    right = np.cross(up, view)
    to_cloth = np.linalg.inv(np.array([right[:2], up[:2]]))
    sizes = np.array([[cloth.solids.weft.length, cloth.solids.warp.length] for cloth in cloths])
    out = np.empty((settings.rows, settings.columns, cells[0].shape[2]))
    key = np.uint64(subkey(settings.seed, "cloth pixels"))
    of_cells = cells[0], cells[-1], len(cells) > 1
    over_rows(_project, settings.rows, key, to_cloth, settings.pitch_mm, sizes, of_cells, out)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _project(start, stop, key, to_cloth, pitch, sizes, cells, out):
    """Average over a point sequence in each pixel, shifted at random from pixel to pixel.

    The period of the cloth and a regular grid of samples would beat against each other.
    """
    (ground, figure, two), (rows, columns, channels) = cells, out.shape
    share = 1.0 / _SAMPLES
    for row in range(start, stop):
        for column in range(columns):
            for channel in range(channels):
                out[row, column, channel] = 0.0
            place = np.uint64(2 * (row * columns + column))
            a, b = uniform(key, place), uniform(key, place + np.uint64(1))
            for _ in range(_SAMPLES):
                a, b = a + R2[0], b + R2[1]
                a, b = a - math.floor(a), b - math.floor(b)
                u, w = pitch * (column + a - 0.5 * columns), pitch * (0.5 * rows - row - b)
                x, y = to_cloth[0, 0] * u + to_cloth[0, 1] * w, to_cloth[1, 0] * u + to_cloth[1, 1] * w
                k = 1 if two and x > 0.0 else 0
                cell = figure if k == 1 else ground
                s, t = x / sizes[k, 0], y / sizes[k, 1]
                i = min(int((s - math.floor(s)) * cell.shape[1]), cell.shape[1] - 1)
                j = min(int((t - math.floor(t)) * cell.shape[0]), cell.shape[0] - 1)
                for channel in range(channels):
                    out[row, column, channel] += share * cell[j, i, channel]


def region_labels(settings: GoniometerSettings, *, pixels: int = 256, coarser: float = 4.0) -> tuple[np.ndarray, float]:
    """Draw a label picture (pixels, pixels) uint16 of two cloths along the normal; return its pitch in mm too.

    It reaches much farther than a photograph along the normal: oblique ones show more of the cloth.
    """
    columns = np.where(np.arange(pixels) < pixels // 2, 1, 2).astype(np.uint16)
    return np.tile(columns, (pixels, 1)), coarser * settings.pitch_mm


def exposure_for(light: np.ndarray, settings: GoniometerSettings) -> float:
    """Choose the longest exposure of the series, in seconds, at which no pixel is brighter than BRIGHTEST."""
    level = max(float(light.max()) * settings.camera.white_level, 1e-9)
    stop = math.floor(math.log2(BRIGHTEST / level))
    return BASE_S * 2.0 ** min(max(stop, STOPS[0]), STOPS[1])


def white_board(number: int, theta_i_deg: float, settings: GoniometerSettings) -> tuple[np.ndarray, float]:
    """Photograph the matt board under one lamp: codes, exposure. Its reflectance varies a little with the place."""
    random = np.random.default_rng(subkey(settings.seed, "cloth board"))
    texture = 1.0 + settings.white_texture * random.standard_normal((settings.rows, settings.columns, 1))
    cosine = math.cos(math.radians(theta_i_deg))
    light = settings.white_reflectance * cosine * texture * np.array(TINT)
    exposure = exposure_for(light, settings)
    signal = light * (settings.camera.white_level * exposure / BASE_S)
    return common.expose(signal, settings.camera, key=subkey(settings.seed, f"cloth noise white {number}")), exposure


REGION_NAMES = ("ground", "figure")
HEADING = ("file", "role", "theta_i_deg", "phi_i_deg", "theta_r_deg", "phi_r_deg", "exposure_s")


def settings_from(options) -> GoniometerSettings:
    """Build the settings from the options of the command line."""
    values = {"seed": options.seed, "regions": options.two_cloths}
    for name in ("rows", "columns", "pitch_mm", "harness", "flatness", "arch_deg", "filaments", "dye"):
        if getattr(options, name) is not None:
            values[name] = getattr(options, name)
    if options.no_bounce:
        values["bounces"] = 0
    if options.harness is not None and PRESETS[options.preset] == "plain":
        raise UserError("--harness: a plain weave has 2, found another number; leave it out")
    return preset(options.preset, **values, camera=common.camera_from(options, common.CameraSettings()))


def write_all(settings: GoniometerSettings, capture: Path, truth: Path, options, report) -> None:
    """Write both folders; report(text) prints the progress."""
    quality = {name: getattr(settings, name) for name in ("candidates", "chains", "bounces")}
    cloths = tuple(make_cloth(cloth, **quality) for cloth in settings.cloths)
    report(f"cloth: {sum(len(cloth.points.area) for cloth in cloths)} points")
    angles = settings.angles_deg
    rows, reflectance = [()] * len(angles), np.zeros((len(angles), len(cloths), len(settings.cloths[0].channels)))
    for done, shot in enumerate(photographs(cloths, settings), start=1):
        file = f"frames/{shot.row + 1:05d}.{options.format}"
        common.write_image(capture / file, shot.codes)
        rows[shot.row] = frame_row(file, "sample", angles[shot.row], shot.exposure_s)
        reflectance[shot.row] = shot.reflectance
        if done % 100 == 0:
            report(f"{done} of {len(angles)} photographs")
    for number, (theta, phi) in enumerate(np.unique(angles[:, :2], axis=0), start=1):
        codes, exposure = white_board(number, theta, settings)
        common.write_image(capture / f"white/{number}.{options.format}", codes)
        rows.append(frame_row(f"white/{number}.{options.format}", "white", (theta, phi, None, None), exposure))
    for number in range(1, common.DARK_FRAMES + 1):
        codes = common.dark_frame(codes.shape, settings.camera, key=subkey(settings.seed, f"cloth dark {number}"))
        common.write_image(capture / f"dark/{number}.{options.format}", codes)
        rows.append(frame_row(f"dark/{number}.{options.format}", "dark", (None,) * 4, None))
    common.write_csv(capture / "frames.csv", [HEADING, *rows])
    describe_capture(capture, settings)
    np.savez(truth / "truth.npz", angles_deg=settings.angles_deg, reflectance=reflectance)
    for number, cloth in enumerate(cloths, start=1):
        suffix = "" if number == 1 else f"-{number}"
        (truth / f"geometry{suffix}.json").write_text(json.dumps(geometry(cloth)) + "\n")
    named = "; ".join(f"{c.harness}-harness {c.weave}, {c.face} on top" for c in settings.cloths)
    (truth / "README.md").write_text(common.readme("cloth", settings=settings, cloths=named, photographs=len(angles)))


def describe_capture(capture: Path, settings: GoniometerSettings) -> None:
    """Write capture.yaml, and the label picture of two cloths."""
    cloth = settings.cloths[0]
    block = {
        "white_reflectance": settings.white_reflectance,
        "crop_px": min(settings.rows, settings.columns),
        "symmetry": "quarter",
        "weave": cloth.weave,
    }
    if len(settings.cloths) > 1:
        labels, pitch = region_labels(settings)
        common.write_image(capture / "regions.png", labels.astype(np.uint8))
        block |= {
            "regions": "regions.png",
            "region_names": {name: label + 1 for label, name in enumerate(REGION_NAMES)},
            "regions_pitch_mm": pitch,
            "pixel_pitch_mm": settings.pitch_mm,
            "upright": "cloth",
        }
    title = f"Simulated {cloth.harness}-harness {cloth.weave} (seed {settings.seed})"
    common.write_description(capture, title, "goniometer", cloth.channels, settings.camera, goniometer=block)


def frame_row(file: str, role: str, angles_deg, exposure_s: float | None) -> tuple:
    """Format a row of frames.csv; angles_deg: four numbers, empty where not given."""
    angles = ["" if angle is None else f"{angle:g}" for angle in angles_deg]
    return (file, role, *angles, "" if exposure_s is None else f"{exposure_s:.9g}")


def geometry(cloth: SimulatedCloth) -> dict:
    """Return the contents of a geometry file of the truth folder: settings, and the layout of the yarns."""
    systems = {}
    for name, yarns in (("warp", cloth.solids.warp), ("weft", cloth.solids.weft)):
        way = yarns.descent
        systems[name] = {
            "spacing_mm": yarns.spacing,
            "offset_halfwidth_halfthickness_mm": np.round(yarns.shape, 6).tolist(),
            "exponent": yarns.exponent,
            "descent": {
                "width_mm": way.width,
                "height_mm": way.height,
                "angle_deg": float(np.degrees(way.angle)),
                "radius_mm": way.radius,
                "straight_mm": way.straight,
            },
        }
    return {"settings": asdict(cloth.settings), "pattern": cloth.solids.pattern.astype(int).tolist(), "yarns": systems}
