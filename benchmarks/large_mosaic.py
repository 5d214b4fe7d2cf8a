"""Photograph a painting of any size in overlapping fields, and score the mosaic that was made of them.

    python benchmarks/large_mosaic.py photograph --output FOLDER --megapixels 150 [--grid 5 6]
    python benchmarks/large_mosaic.py score --output FOLDER --results FOLDER/wall

The painting is a function of the place: octaves of noise and a canvas for its height, ramps of invented paints for its
colour. A field photographs it directly, through the stage's errors and the lens of `cut_mosaic.py`, under 9 lamps on
two rings; nothing is resampled, and no more than one field is in memory. `score` compares the maps of the mosaic with
the function, band by band, after the best shift, turn and scale of the whole.
"""

import argparse
import json
import math
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import zarr
from cut_mosaic import picture_places, place_fields

from nishiki.capture.seal import seal
from nishiki.colour.colour import delta_e_2000
from nishiki.evaluate.camera_colour import read_camera_colour
from nishiki.simulate.capture import (
    FINE_NM,
    CameraSettings,
    channel_names,
    expose,
    sensitivities,
    write_csv,
    write_description,
    write_image,
)
from nishiki.simulate.painting.objects import SimulatedObject
from nishiki.simulate.painting.photographs import make_tables
from nishiki.simulate.painting.relief import shade
from nishiki.simulate.painting.settings import (
    LampPose,
    LampSettings,
    SimulationSettings,
    make_palette,
    planck_spectrum,
    vignette,
)

PITCH_MM = 0.1
FAR_MM = 1e6
OCTAVES = ((5, 1, 0, 0.05), (10, 1, 0, 0.07), (7, 9, 0.5, 0.08), (9, 8, 2.2, 0.08), (60, 1, 0, 0.06), (700, 1, 0, 0.05))
"""Of the height: wavelength in pixels, how much longer along its direction (radians), rms slope."""
CANVAS_PX, CANVAS_SLOPE = 14.0, 0.10
REGION_PX, TONE_PX = (1100, 150), (160, 40)
BAND = 512


class Painting:
    """Height (mm) and paint of a painting at any place; places in pixels (column, row) of the whole."""

    def __init__(self, rows: int, columns: int, seed: int):
        self.shape, self.seed = (rows, columns), seed
        self.grids: dict = {}

    @cached_property
    def palette(self):
        return make_palette(FINE_NM, alpha=0.12, seed=self.seed)

    def noise(
        self, name: str, places: np.ndarray, wavelength: float, stretch: float = 1, angle: float = 0
    ) -> np.ndarray:
        """Smooth noise of unit variance (rows, columns)."""
        cosine, sine = math.cos(angle), math.sin(angle)
        steps = np.array([wavelength * stretch, wavelength]) / 2
        turn = np.array([[cosine, sine], [-sine, cosine]])
        rows, columns = self.shape
        corners = np.array([(0, 0), (columns, 0), (columns, rows), (0, rows)]) @ turn.T
        first = corners.min(0) - 4 * steps - 40
        if name not in self.grids:
            size = np.ceil((corners.max(0) - first + 40) / steps).astype(int) + 8
            random = np.random.default_rng([self.seed, *name.encode()])
            self.grids[name] = random.standard_normal(size[::-1], dtype=np.float32)
        at = ((places @ turn.T - first) / steps).astype(np.float32)
        return cv2.remap(self.grids[name], at, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT) / 0.75

    def height(self, places: np.ndarray) -> np.ndarray:
        """Height (rows, columns) float32 in mm."""
        total = np.zeros(places.shape[:2], np.float32)
        for number, (wavelength, stretch, angle, slope) in enumerate(OCTAVES):
            total += (
                slope * wavelength * PITCH_MM / 4 * self.noise(f"height {number}", places, wavelength, stretch, angle)
            )
        phase = places * (2 * np.pi / CANVAS_PX) + 0.8 * self.noise("threads", places, 260)[..., None]
        weave = np.sin(phase[..., 0]) * np.sin(phase[..., 1])
        thin = 1 / (1 + np.exp(-3 * self.noise("paint", places, 500)))
        return total + (CANVAS_SLOPE * CANVAS_PX * PITCH_MM / 4 * thin * weave).astype(np.float32)

    def label(self, places: np.ndarray) -> np.ndarray:
        """Paint (rows, columns) uint8."""
        coarse = sum(
            share * self.noise(f"region {px}", places, px) for px, share in zip(REGION_PX, (0.97, 0.25), strict=True)
        )
        fine = sum(share * self.noise(f"tone {px}", places, px) for px, share in zip(TONE_PX, (0.7, 0.7), strict=True))
        ramps = np.array([i for i, steps in enumerate(self.palette.steps) if steps > 1])
        share = np.clip((np.vectorize(math.erf, otypes=[float])(np.linspace(-3, 3, 601)) + 1) / 2, 0, 0.9999)
        rank = share[np.clip(np.rint(coarse * 100 / math.sqrt(2) + 300), 0, 600).astype(int)]
        ramp = ramps[(rank * len(ramps)).astype(int)]
        tone = share[np.clip(np.rint(fine * 100 / math.sqrt(2) + 300), 0, 600).astype(int)]
        return (self.palette.first[ramp] + (tone * self.palette.steps[ramp]).astype(int)).astype(np.uint8)

    def normals(self, places: np.ndarray, step: float = 1.0) -> np.ndarray:
        """Normals (rows, columns, 3), x right, y up, of slopes over two pixels, as the photographs are shaded."""
        slope = [
            (self.height(places + shift) - self.height(places - shift)) / (2 * step * PITCH_MM)
            for shift in (np.array([step, 0]), np.array([0, -step]))
        ]
        normals = np.stack([-slope[0], -slope[1], np.ones_like(slope[0])], -1)
        return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def lamps() -> list[tuple[str, np.ndarray]]:
    """Return names and directions of the lamps, over the painting."""
    found = [("top", np.array([0.0, 0.07, 1.0]))]
    for number in range(8):
        azimuth, zenith = number * math.pi / 4 + 0.1, math.radians(35 if number % 2 else 52)
        side = math.sin(zenith)
        found.append(
            (f"ring{number + 1}", np.array([side * math.cos(azimuth), side * math.sin(azimuth), math.cos(zenith)]))
        )
    return [(name, direction / np.linalg.norm(direction)) for name, direction in found]


def grid_places(field: dict) -> np.ndarray:
    """Return where in the painting (column, row) the pixels of a field lie."""
    rows, columns = field["shape"]
    return picture_places(
        field, np.stack(np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float)), -1)
    )


def photograph_field(painting: Painting, field: dict, folder: Path, seed: int) -> None:
    """Write the sealed capture of one field."""
    places = grid_places(field)
    rows, columns = field["shape"]
    height, label = painting.height(places), painting.label(places)
    none = np.zeros((rows, columns), np.float32)
    waves = np.zeros((rows, columns, 2), np.float32)
    thing = SimulatedObject(height, label, painting.palette, waves, none, height, none, float(height.max()))
    settings = SimulationSettings(
        rows=rows, columns=columns, seed=seed, gloss="satin", pitch_mm=PITCH_MM, supersampling=1, bounce=False,
        camera=CameraSettings(channels=3), lights=LampSettings(rings=2, ring_lights=4, top=True, distance_mm=1500.0),
    )  # fmt: skip
    tables = make_tables(thing, settings, with_truth=False)
    fall = vignette(settings, slice(0, rows)).astype(np.float32)
    cosine, sine = math.cos(field["turn"]), math.sin(field["turn"])
    listed, lights = [("file", "role", "light")], ["9"]
    for number, (name, direction) in enumerate(lamps()):
        x, y, z = direction
        towards = np.array([cosine * x - sine * y, sine * x + cosine * y, z])  # the field's frame, y up
        lamp = LampPose(name, "sample", towards, towards * FAR_MM, 1.0, (0.0, 0.0), 0.0)
        shading = shade(thing, lamp, settings, table=tables.table, squared=tables.squared)
        signal = (shading.body + shading.gloss[..., None]) * fall[..., None] * tables.signal.astype(np.float32) * 0.85
        write_image(folder / f"frames/{name}.png", expose(signal, settings.camera, key=seed * 100 + number))
        board = 0.98 * z * fall[..., None] * tables.signal * 0.85
        quiet = CameraSettings(channels=3, noise=False)
        write_image(folder / f"white/{name}.png", expose(board.astype(np.float32), quiet, key=1))
        listed += [(f"frames/{name}.png", "sample", name), (f"white/{name}.png", "white", name)]
        lights.append(f"{name} " + " ".join(f"{value:.6f}" for value in towards))
    (folder / "lights.lp").write_text("\n".join(lights) + "\n")
    (folder / "spectra").mkdir()
    names = channel_names(3)
    curves = sensitivities(FINE_NM, 3)
    write_csv(
        folder / "spectra/camera.csv", [("wavelength_nm", *names), *np.column_stack([FINE_NM, curves.T]).tolist()]
    )
    lamp = planck_spectrum(FINE_NM, settings.lights.colour_temperature_k)
    write_csv(
        folder / "spectra/illuminant.csv", [("wavelength_nm", "power"), *np.column_stack([FINE_NM, lamp]).tolist()]
    )
    write_csv(folder / "frames.csv", listed)
    write_description(
        folder, "Painting in fields", "plane", names, settings.camera, sensitivities="spectra/camera.csv",
        illuminant="spectra/illuminant.csv", lights={"file": "lights.lp", "kind": "direction"},
        white={"reflectance": 0.98, "normal": [0, 0, 1]}, pixel_pitch_mm=PITCH_MM,
    )  # fmt: skip
    seal(folder)


def photograph(options: argparse.Namespace) -> None:
    """Write all fields, and the truth about their places."""
    columns = round(math.sqrt(options.megapixels * 1e6 * 1.25))
    shape = round(columns / 1.25), columns
    painting = Painting(*shape, options.seed)
    fields = place_fields(shape, tuple(options.grid), options.overlap, options.seed)
    lines = ["field,path,x_mm,y_mm"]
    for number, field in enumerate(fields):
        folder = options.output / "wall" / "fields" / field["name"]
        x, y = field["stated"]
        lines.append(f"{field['name']},fields/{field['name']},{x * PITCH_MM:.3f},{-y * PITCH_MM:.3f}")
        if not folder.exists():
            folder.mkdir(parents=True)
            photograph_field(painting, field, folder, 1000 * options.seed + number)
            print(f"{field['name']}: {field['shape']}", flush=True)
    (options.output / "wall" / "fields.csv").write_text("\n".join(lines) + "\n")
    truth = {"shape": shape, "seed": options.seed, "fields": fields}
    (options.output / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")


def score(options: argparse.Namespace) -> None:
    """Print the errors of the mosaic's places, normals, expected errors and colours."""
    truth = json.loads((options.output / "truth.json").read_text())
    painting = Painting(*truth["shape"], truth["seed"])
    (folder,) = (options.results / "mosaic").glob("*/")
    placed = json.loads((folder / "mosaic.json").read_text())["fields"]
    ours, true = [], []
    for field in truth["fields"]:
        rows, columns = field["shape"]
        corners = np.array([(0, 0), (columns - 1, 0), (columns - 1, rows - 1), (0, rows - 1)], float)
        ours += (np.array(placed[field["name"]]["corners"]) @ (1, 1j)).tolist()
        true += (picture_places(field, corners) @ (1, 1j)).tolist()
    ours, true = np.array(ours), np.array(true)
    middle, centre = ours.mean(), true.mean()
    turn = np.vdot(ours - middle, true - centre) / np.vdot(ours - middle, ours - middle)
    error = np.abs(centre + turn * (ours - middle) - true)
    print(f"corners of the fields: rms {np.sqrt(np.mean(error**2)):.3f}, worst {error.max():.3f} pixels")
    maps, (heights,) = zarr.open_group(folder / "maps.zarr", mode="r"), (options.results / "height").glob("*/")
    expected = zarr.open_group(heights / "maps.zarr", mode="r")["expected_error"]
    lab = read_camera_colour(folder / "curves.npz", 3, maps.attrs["to_srgb"]).lab
    paints = sensitivities(FINE_NM, 3) * planck_spectrum(FINE_NM, LampSettings().colour_temperature_k)
    colours = (painting.palette.spectra @ (paints / paints.sum(axis=1, keepdims=True)).T).astype(np.float32)
    rows, columns = maps["flags"].shape
    angles, ratios, differences, inside = [], [], [], []
    for top in range(0, rows, 8 * BAND):  # an eighth of the bands
        band = slice(top, min(top + BAND, rows))
        y, x = np.mgrid[band, 0:columns]
        there = centre + turn * ((x + 1j * y) - middle)
        places = np.stack([there.real, there.imag], -1)
        normals = painting.normals(places)
        phase = -np.angle(turn)
        cosine, sine = math.cos(phase), math.sin(phase)
        across = cosine * normals[..., 0] + sine * normals[..., 1]
        normals = np.stack([across, cosine * normals[..., 1] - sine * normals[..., 0], normals[..., 2]], -1)
        known = (maps["flags"][band] & 11) == 0
        angle = np.degrees(np.arccos(np.clip((maps["normals"][band] * normals).sum(-1), -1, 1)))[known]
        angles.append(angle)
        ratios.append(angle / np.degrees(expected[band][known]))
        label = painting.label(places)
        inner = cv2.erode(label, np.ones((5, 5))) == cv2.dilate(label, np.ones((5, 5)))  # no border of two paints
        part = known & inner & (np.arange(known.size).reshape(known.shape) % 17 == 0)
        differences.append(delta_e_2000(lab(maps["reflectance"][band][part]), lab(colours[label[part]])))
        inside.append(inner.mean())
    angle, ratio, difference = (np.concatenate(each) for each in (angles, ratios, differences))
    print(f"{angle.size} pixels of {rows} x {columns}")
    print(f"normals: mean {angle.mean():.3f}, median {np.median(angle):.3f} degrees")
    print(f"true errors below one and two expected: {(ratio < 1).mean():.2f}, {(ratio < 2).mean():.2f}")
    print(
        f"CIEDE2000 within paints ({np.mean(inside):.2f} of all): {difference.mean():.2f}, {np.median(difference):.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=("photograph", "score"))
    parser.add_argument("--output", required=True, type=Path, help="folder of wall/ and truth.json")
    parser.add_argument("--results", type=Path, help="of the scene of the mosaic")
    parser.add_argument("--megapixels", type=float, default=12)
    parser.add_argument("--grid", nargs=2, type=int, default=(5, 6), metavar=("ROWS", "COLUMNS"))
    parser.add_argument("--overlap", type=float, default=0.15)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    {"photograph": photograph, "score": score}[options.task](options)


if __name__ == "__main__":
    main()
