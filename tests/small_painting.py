"""A small painting with an analytic relief: the artifacts that an export reads, and its photographs."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import cv2
import numpy as np
import yaml
from captures import write_frame
from pages import make_artifact

from nishiki.artifacts.artifact import Artifact, ArtifactWriter
from nishiki.artifacts.maps import MapWriter
from nishiki.artifacts.stage import Context, expect_finite
from nishiki.brdf.torrance_sparrow import MIRROR
from nishiki.capture.folder import load_capture
from nishiki.installation import is_installed
from nishiki.observations.plane_store import write_observations
from nishiki.progress import Progress
from nishiki.stages.brdf import BrdfSettings
from nishiki.stages.export import ExportSettings, Format
from nishiki.stages.export.painting import run
from nishiki.stages.height import HeightSettings
from nishiki.stages.ingest import IngestSettings
from nishiki.stages.normals import NormalsSettings
from nishiki.stages.spectra import SpectraSettings

ROWS, COLUMNS, PITCH_MM, BAND_ROWS = 45, 60, 0.25, 16
STAMP = {"scene": "small", "stage": "export", "key": "0123456789ab", "version": "1"}
NANOMETRES = np.arange(400, 701, 5)

LAMPS = [(np.sin(a) * 0.7, np.cos(a) * 0.7, 0.714) for a in np.radians([10, 100, 190, 280])]

OF_PACKAGES = {"usd": "usd-core", "materialx": "materialx"}
FORMATS_HERE = tuple(name for name in get_args(Format) if is_installed(OF_PACKAGES.get(name, "numpy")))
"""Formats that can be written: those of the extra `export` only where it is installed."""


@dataclass(frozen=True)
class SmallPainting:
    """Maps of the painting, rows from the top; artifacts by stage; lights (n, 3), the last three of them checks."""

    height: np.ndarray
    normals: np.ndarray
    coefficients: np.ndarray
    basis: np.ndarray
    known: np.ndarray
    lights: np.ndarray
    inputs: dict[str, Artifact]

    def reflectance(self) -> np.ndarray:
        """(rows, columns, 61) spectra."""
        return self.coefficients @ self.basis


def dome(count: int, seed: int) -> np.ndarray:
    """(count, 3) unit directions between 15 and 65 degrees from the normal, evenly around."""
    angle = np.arange(count) * 2.39996 + seed
    polar = np.radians(15 + 50 * np.sqrt((np.arange(count) + 0.5) / count))
    return np.stack([np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle), np.cos(polar)], axis=1)


def small_painting(
    folder: Path,
    *,
    regions: np.ndarray | None = None,
    shading: np.ndarray | None = None,
    transmission: float = 0.0,
    gilded: bool = False,
) -> SmallPainting:
    """Make the painting; one corner has no estimate.

    regions : (rows, columns) uint8, 1 where highlights are narrow; shading : (rows, columns, terms) of the body;
    transmission : share of the surface's loss that the body's light suffers; gilded : the last region is a metal.
    """
    y, x = np.mgrid[ROWS:0:-1, 0:COLUMNS] * PITCH_MM  # y points up
    phase_x, phase_y = 2 * np.pi * x / 5, 2 * np.pi * y / 4
    height = 0.18 * np.sin(phase_x) * np.cos(phase_y) + 0.02 * x
    slope_x = 0.18 * 2 * np.pi / 5 * np.cos(phase_x) * np.cos(phase_y) + 0.02
    slope_y = -0.18 * 2 * np.pi / 4 * np.sin(phase_x) * np.sin(phase_y)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    basis = np.stack([np.ones(61), (NANOMETRES - 550) / 150, np.cos((NANOMETRES - 400) / 60)])
    waves = np.stack([0.4 + 0.1 * np.sin(x), 0.15 * np.cos(y / 2), 0.05 * np.sin(x + y)], axis=-1)
    known = (x > 1.5) | (y > 1.5)
    lights = np.concatenate([dome(18, 0), dome(3, 1)])
    maps = {
        "normals": (NormalsSettings, {"normals": normals, "flags": np.where(known, 0, 1).astype(np.uint8)}),
        "height": (HeightSettings, {"height": np.where(known, height, np.nan)}),
        "spectra": (SpectraSettings, {"coefficients": waves}),
    }
    channels = np.stack([(waves @ basis)[..., band] for band in (45, 28, 8)], axis=-1)
    maps["normals"][1].update(reflectance=channels, sigma=np.full(known.shape, 0.01), residual=np.zeros(known.shape))
    maps["normals"][1]["lights_used"] = np.full(known.shape, 18, np.uint8)
    maps["spectra"][1]["sigma"] = np.full(known.shape, 0.03)
    if shading is not None:
        maps["normals"][1]["shading"] = shading
    inputs = {stage: _artifact(folder, stage, *made, basis) for stage, made in maps.items()}
    inputs["brdf"] = _gloss(folder, regions, transmission, gilded)
    inputs["ingest"] = _photographs(folder, normals, channels, lights, regions)
    return SmallPainting(height, normals.astype(np.float32), waves.astype(np.float32), basis, known, lights, inputs)


def export_context(painting: SmallPainting, folder: Path, settings) -> Context:
    """What a stage is given, with the output in `folder`."""
    output = ArtifactWriter(folder / STAMP["key"])
    return Context(painting.inputs, settings, output, None, None, STAMP, Progress("small/export"))


@contextmanager
def exported_painting(folder: Path, formats: tuple[str, ...], **settings) -> Iterator[SimpleNamespace]:
    """The painting, the folder of its exports in `formats`, and what the stage reports."""
    painting = small_painting(folder)
    context = export_context(painting, folder / "export", ExportSettings(formats=formats, **settings))
    with context.output as output:
        reported = run(context)
        expect_finite(output.folder, "export")
        yield SimpleNamespace(painting=painting, folder=output.folder / "exports", reported=reported)


def of_pixels(vertices: np.ndarray) -> np.ndarray:
    """(n,) bool: vertices (n, 3) in mm of a mesh of the painting that stand in pixels, not on the picture's edge."""
    outer = np.array([COLUMNS, ROWS]) * PITCH_MM / 2
    return (np.abs(vertices[:, :2]) < outer * 0.999).all(axis=1)


def shaded(normals: np.ndarray, lamp: tuple[float, float, float]) -> np.ndarray:
    """Of matte white."""
    return np.maximum(normals @ np.asarray(lamp), 0)


def _artifact(folder: Path, stage: str, settings, maps: dict, basis: np.ndarray) -> Artifact:
    def fill(writer: ArtifactWriter) -> dict:
        out = MapWriter(writer.folder, rows=ROWS, columns=COLUMNS, band_rows=BAND_ROWS, stamp=STAMP)
        out.group.update(pixel_pitch_mm=PITCH_MM)
        for name, values in maps.items():
            values = values if values.dtype == np.uint8 else values.astype(np.float32)
            said = {"basis": basis.tolist()} if name == "coefficients" else {"unit": "mm", "nan": "none"}
            out.write(name, values, **said)
        return {}

    return make_artifact(folder, settings(), fill, stamp=STAMP, stage=stage)


def _gloss(folder: Path, regions: np.ndarray | None, transmission: float, gilded: bool) -> Artifact:
    def fill(writer: ArtifactWriter) -> dict:
        lobes = [([0.6], [0.25]), ([40.0], [0.1])][: 1 if regions is None else 2]
        shared = {"refractive_index": 1.45, "transmission": transmission}
        parameters = {"regions": [{"beta": beta, "gamma": gamma, **shared} for beta, gamma in lobes]}
        if gilded:  # all light is reflected
            mirror = np.log(2) / (4 * lobes[-1][1][0] ** 2)
            parameters["regions"][-1] |= {"beta": [mirror], "refractive_index": MIRROR, "transmission": 0.0}
        if regions is not None:
            out = MapWriter(writer.folder, rows=ROWS, columns=COLUMNS, band_rows=BAND_ROWS, stamp=STAMP)
            out.write("labels", regions.astype(np.uint8))
        writer.path("parameters.json").write_text(json.dumps(parameters))
        return {}

    return make_artifact(folder, BrdfSettings(), fill, stamp=STAMP, stage="brdf")


def _photographs(
    folder: Path, normals: np.ndarray, channels: np.ndarray, lights: np.ndarray, regions: np.ndarray | None
) -> Artifact:
    """12-bit photographs of the matte relief, with a white board for every light."""
    capture = folder / "capture"
    table, names = ["file,role,light,exposure_s"], [f"L{number:02d}" for number in range(len(lights))]
    for number, (name, light) in enumerate(zip(names, lights, strict=True)):
        shading = np.maximum(normals @ light, 0)[..., None]
        write_frame(capture / f"frames/{name}.png", 3200 * shading * channels)
        write_frame(capture / f"white/{name}.png", np.full((ROWS, COLUMNS, 3), 3200 * light[2]))
        role = "check" if number >= len(lights) - 3 else "sample"
        table += [f"frames/{name}.png,{role},{name},", f"white/{name}.png,white,{name},"]
    (capture / "frames.csv").write_text("\n".join(table) + "\n")
    rows = [f"{name}.png {x:.9g} {y:.9g} {z:.9g}" for name, (x, y, z) in zip(names, lights, strict=True)]
    (capture / "lights.lp").write_text(f"{len(lights)}\n" + "\n".join(rows) + "\n")
    cv2.imwrite(str(capture / "mask.png"), np.full((ROWS, COLUMNS), 255, np.uint8))
    settings = {
        "format": 1,
        "title": "Small painting",
        "geometry": "plane",
        "camera": {"channels": ["red", "green", "blue"], "encoding": "linear", "bits": 12, "saturation": 1.0},
        "lights": {"file": "lights.lp", "kind": "direction"},
    }
    if regions is not None:
        cv2.imwrite(str(capture / "regions.png"), regions)
        settings["regions"] = "regions.png"
    (capture / "capture.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))

    def fill(writer: ArtifactWriter) -> dict:
        write_observations(load_capture(capture), writer.folder, settings=IngestSettings())
        return {"capture": settings}

    return make_artifact(folder, IngestSettings(), fill, stamp=STAMP, stage="ingest")
