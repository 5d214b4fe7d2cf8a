"""Compare a painting's maps with truth, and predictions with photographs under lights that no fit used."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.maps import MapWriter
from nishiki.artifacts.stage import Context
from nishiki.colour.colour import illuminant
from nishiki.errors import UserError, require
from nishiki.evaluate.camera_colour import read_camera_colour
from nishiki.evaluate.maps import Pool, height_error, normal_errors, reflectance_errors
from nishiki.evaluate.relighting import NAMES, LightComparison, PreviewPair, classify, stated_levels, truth_difference
from nishiki.evaluate.tables import COLUMNS, headlines, planned_truth, rows_of, write_tables
from nishiki.formats.stored import load_arrays, open_group
from nishiki.observations.plane import Observations
from nishiki.render.plane.scene import Light
from nishiki.render.plane.shade import PlaneMaps, cast_shadows
from nishiki.stages import painting_maps
from nishiki.stages.evaluate import PAINTING_OUTPUTS

DARK_SHARE = 0.25  # of a region, that is scored apart


def run(context: Context) -> dict:
    """Compare everything that has a counterpart; lights one after the other, each band by band."""
    frames = Observations(context.inputs["ingest"].folder)
    scene = EvaluatedScene(context.inputs, frames)
    truth = read_truth(context, frames)
    out = MapWriter.of(context, PAINTING_OUTPUTS, frames.shape, frames.band_rows)
    evaluation = {"pixels": int(np.count_nonzero(frames.mask)), **against_truth(truth, scene, out)}
    evaluation["colour"] = {"how": scene.camera.how, "rmse_xyz": scene.camera.rmse}
    evaluation["lights"], evaluation["parts"], pooled = relight(context, scene, truth, out)
    evaluation["overall"] = {"de00": asdict(pooled), "levels": stated_levels(evaluation["parts"])}
    evaluation["classes_from"] = "truth" if truth.checks else "model"
    evaluation["gloss"] = {"true_gamma_rad": truth.equivalent_gamma(), "gamma_rad": scene.gloss.gamma.tolist()}
    write_tables(context, evaluation, COLUMNS, rows_of(evaluation))
    return headlines(evaluation)


class EvaluatedScene(painting_maps.PaintingMaps):
    """Fitted maps of one scene and data for displaying them.

    Attributes
    ----------
    estimated : (rows, columns) bool ndarray
        Pixels with an estimate of normal and reflectance.
    parts : (rows, columns) int16 ndarray
        As of `parts_of`.
    relief : (rows, columns) float32 ndarray or None
        Height in the unit of lengths.
    """

    def __init__(self, inputs: Mapping[str, Artifact], frames: Observations):
        super().__init__(inputs)
        self.frames = frames
        self.relief = self.height(slice(0, self.shape[0])) if self.heights else None
        curves = inputs["ingest"].path("curves.npz")
        self.curves = load_arrays(curves) if curves.is_file() else {}
        self.camera = read_camera_colour(curves, len(frames.channels), frames.to_srgb)
        self.estimated, level = np.zeros(frames.shape, bool), np.zeros(frames.shape, np.float32)
        for rows in frames.bands():
            reflectance = self.maps.read("reflectance", rows)
            self.estimated[rows] = self.read_known(rows) & np.isfinite(reflectance).all(axis=-1)
            level[rows] = reflectance.mean(axis=-1)
        labels = self.regions(slice(0, self.shape[0]))
        self.parts = parts_of(labels, level, frames.mask & self.estimated)

    def predict(self, light: Light, rows: slice, visibility: np.ndarray | None) -> painting_maps.PredictedLight:
        """Predict some rows under a lamp, whose visibility (1, rows, columns) is that of the whole."""
        middle = (self.shape[0] - 1) / 2
        return painting_maps.predict_light(
            self.model(rows),
            painting_maps.lower_light(light, ((rows.start + rows.stop - 1) / 2 - middle) * self.pitch),
            visibility=None if visibility is None else visibility[:, rows],
            pitch=self.pitch,
        )


def parts_of(labels: np.ndarray | None, level: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Divide every region of the gloss into its darkest quarter and the rest.

    labels, level, known : (rows, columns) uint8 region, reflectance and bool. Returns (rows, columns) int16: 2 region,
    + 1 where dark, -1 outside of `known`.
    """
    labels = np.zeros(known.shape, np.uint8) if labels is None else labels
    parts = np.where(known, 2 * labels.astype(np.int16), np.int16(-1))
    for region in np.unique(labels[known]):
        here = known & (labels == region)
        parts[here] += level[here] < np.quantile(level[here], DARK_SHARE)
    return parts


@dataclass(frozen=True)
class CheckTruth:
    """Noise-free colour (rows, columns, 3) under one check light.

    A white facing the lamp has Y = 1, with the lamp's own spectrum and with D65; gloss and body: (rows, columns) parts
    of it; lit: (rows, columns) share of the lamp, 0..1.
    """

    xyz_lamp: np.ndarray
    xyz_d65: np.ndarray
    gloss: np.ndarray
    body: np.ndarray
    lit: np.ndarray


@dataclass(frozen=True)
class SceneTruth:
    """Truth of a scene; any part may be None or empty."""

    normals: np.ndarray | None = None  # (rows, columns, 3), zero or NaN where unknown
    height_mm: np.ndarray | None = None  # (rows, columns)
    paints: np.ndarray | None = None  # (rows, columns, samples) integers into spectra (paints, 61)
    spectra: np.ndarray | None = None
    regions: np.ndarray | None = None  # (rows, columns), with names
    region_names: tuple[str, ...] = ()
    roughness: np.ndarray | None = None  # (paints,) GGX alpha
    checks: tuple[str, ...] = ()  # names of the lights whose colours are known
    arrays: Mapping[str, Any] | None = None
    lights: tuple[str, ...] = ()
    window: tuple[slice, slice] = (slice(None), slice(None))

    def check(self, light: str) -> CheckTruth | None:
        """Return truth of one check light, read at its first use; None where it is unknown."""
        if light not in self.checks or self.arrays is None:
            return None
        at, names = self.checks.index(light), ("xyz_lamp", "xyz_d65", "gloss", "body")
        parts = {name: np.asarray(self.arrays[name][at])[self.window] for name in names}
        lit = np.asarray(self.arrays["lit"][self.lights.index(light)])[self.window].astype(np.float32) / 100.0
        return CheckTruth(**parts, lit=lit)

    def equivalent_gamma(self) -> tuple[float, float, float] | None:
        """Compute the half width at half maximum, radians, of the GGX facet distributions: least, median, largest.

        D falls to half where tan(phi) = alpha sqrt(sqrt 2 - 1), leaving cos^4 aside (Walter et al., EGSR 2007, eq. 33).
        """
        alpha = None if self.roughness is None else self.roughness[self.roughness > 0]
        if alpha is None or not alpha.size:
            return None
        gamma = np.arctan(alpha * np.sqrt(np.sqrt(2.0) - 1.0))
        return float(gamma.min()), float(np.median(gamma)), float(gamma.max())


def truth_from(
    arrays: Mapping[str, Any],
    *,
    shape: tuple[int, int],
    attributes: Mapping[str, Any] | None = None,
    region: tuple[int, int, int, int] | None = None,
    asked: tuple[int, int, int, int] | None = None,
) -> SceneTruth:
    """Build the truth from named arrays: those that docs/simulator.md lists, or `normals` alone.

    shape : (rows, columns) of the scene's maps; region : (row, column, rows, columns) of the scene in the photographs;
    asked : the region of interest of the capture, which holds that of the scene. A truth of the whole photograph or of
    the region of interest is cropped to the scene. Raises UserError where no size fits.
    """
    attributes = attributes or {}
    names = set(arrays)
    if "normals" not in names and "height_mm" not in names:
        found = ", ".join(sorted(names)) or "none"
        raise UserError(f"truth: expected an array named normals or height_mm, found {found}")
    window = _window(np.shape(arrays["normals" if "normals" in names else "height_mm"])[:2], shape, region, asked)

    def read_map(name: str) -> np.ndarray | None:
        return np.asarray(arrays[name][...])[window] if name in names else None

    def read_list(name: str) -> np.ndarray | None:
        return np.asarray(arrays[name][...]) if name in names else None

    complete = {"xyz_lamp", "xyz_d65", "gloss", "body", "lit"} <= names
    return SceneTruth(
        normals=read_map("normals"),
        height_mm=read_map("height_mm"),
        paints=read_map("labels") if "spectra" in names else None,
        spectra=read_list("spectra"),
        regions=read_map("regions"),
        region_names=tuple(attributes.get("regions", ())),
        roughness=read_list("roughness"),
        checks=tuple(attributes.get("checks", ())) if complete else (),
        arrays=arrays if complete else None,
        lights=tuple(attributes.get("lights", ())),
        window=window,
    )


def _window(size: tuple[int, int], shape: tuple[int, int], region, asked) -> tuple[slice, slice]:
    if size == tuple(shape):
        return slice(None), slice(None)
    if region is not None and tuple(region[2:]) == tuple(shape):
        row, column, rows, columns = region
        if asked is not None and size == tuple(asked[2:]):
            row, column = row - asked[0], column - asked[1]
        if row + rows <= size[0] and column + columns <= size[1]:
            return slice(row, row + rows), slice(column, column + columns)
    raise UserError(
        f"truth: expected {shape[0]} x {shape[1]} pixels as the scene, or the whole photograph, found "
        f"{size[0]} x {size[1]}; give the truth of this very capture"
    )


def read_truth(context: Context, frames: Observations) -> SceneTruth:
    """Read the truth of a simulated capture (truth.zarr), or an .npz with normals; empty where none is given."""
    path = planned_truth(context)
    if path is None:
        return SceneTruth()
    region, asked = (tuple(frames.attributes[name]) for name in ("region_of_interest", "asked_region"))
    if (path / "truth.zarr").is_dir():
        group = open_group(path / "truth.zarr")
        return truth_from(
            {name: group[name] for name in group.names()},
            shape=frames.shape,
            attributes=dict(group.attrs),
            region=region,
            asked=asked,
        )
    tables = [path] if path.suffix == ".npz" else sorted(path.glob("*.npz"))
    if len(tables) != 1:
        raise UserError(
            f"{path}: expected truth.zarr or one .npz with an array named normals, found {len(tables)} .npz files"
        )
    return truth_from(load_arrays(tables[0]), shape=frames.shape, region=region, asked=asked)


def against_truth(truth: SceneTruth, scene: EvaluatedScene, out: MapWriter) -> dict:
    """Compute errors of the maps themselves; None without truth or a map of the kind."""
    result: dict[str, dict | None] = {"normals": None, "height": None, "reflectance": None}
    if truth.normals is not None:
        normals, flags = (scene.maps.read(name) for name in ("normals", "flags"))
        angles = normal_errors(normals, truth.normals, flags=flags, mask=scene.frames.mask)
        out.write("angular_error", angles.map_deg, nan="outside what truth and estimate share")
        result["normals"] = angles.as_dict()
    if truth.height_mm is not None and scene.relief is not None and scene.pitch_mm:
        inside = scene.frames.mask & scene.estimated
        error = height_error(scene.relief, truth.height_mm, pixels=inside, pitch=scene.pitch)
        result["height"] = {"unit": "mm", **asdict(error)}
    if truth.paints is not None and scene.basis is not None:
        basis, spectra = scene.basis, require(truth.spectra)
        everything = slice(0, scene.shape[0])
        mirrors = PlaneMaps(np.empty(0), np.empty(0), scene.gloss, labels=scene.regions(everything)).mirrors
        errors = reflectance_errors(
            scene.coefficients(everything),
            basis,
            truth.paints,
            spectra,
            pixels=scene.frames.mask & scene.estimated & ~mirrors,
            regions=truth.regions,
        )
        out.write("reflectance_de00", errors.de00_map, nan="no truth or no estimate here")
        regions = truth.paints.reshape(*scene.frames.shape, -1)[..., 0] if truth.regions is None else truth.regions
        out.write("regions", np.asarray(regions))
        result["reflectance"] = {**errors.as_dict(), "region_names": list(truth.region_names)}
    return result


def relight(context: Context, scene: EvaluatedScene, truth: SceneTruth, out: MapWriter):
    """Score every light that no fit used; pool the differences of all of them, by part and together."""
    frames = scene.frames
    chosen = [
        j for j, role in enumerate(frames.roles) if role == "check" or frames.lights[j] in context.settings.hold_out
    ]
    scores, pool, numbers = [], Pool(), scene.parts
    pools: dict[int, tuple[Pool, list[dict]]] = {int(part): (Pool(), []) for part in np.unique(numbers[numbers >= 0])}
    for j in context.progress.over(chosen, "light"):
        score, difference, sums = one_light(context, scene, truth, out, j)
        scores.append(score)
        pool.add(difference)
        for number, (part, lights) in pools.items():
            part.add(difference[numbers == number])
            if sums[1, number] > 0:
                error = float(sums[0, number] / sums[1, number] - 1)
                lights.append({"incidence_deg": score["incidence_deg"], "level_error": error})
    parts = [
        {
            "finish": number // 2,
            "dark": bool(number % 2),
            "share": float((numbers == number).sum() / (numbers >= 0).sum()),
            "de00": asdict(part.summary()),
            "lights": lights,
        }
        for number, (part, lights) in pools.items()
        if lights
    ]
    return scores, parts, pool.summary()


def one_light(
    context: Context, scene: EvaluatedScene, truth: SceneTruth, out: MapWriter, j: int
) -> tuple[dict, np.ndarray, np.ndarray]:
    """Score one light, and write its map of differences.

    Returns the score, the map and, (2, parts), sums of predicted and observed light.
    """
    frames, name = scene.frames, scene.frames.lights[j]
    height = scene.relief if context.settings.cast_shadows and scene.casts_shadows else None
    light = painting_maps.captured_lamp(frames, j, float(np.radians(context.settings.lamp_diameter_deg / 2)))
    visibility = None if height is None else cast_shadows(height, [light], pitch=scene.pitch)
    known_truth = truth.check(name)
    comparison = LightComparison.of(frames.shape, scene.camera)
    views = colours_for(scene) if known_truth else {}
    pictures = {case: np.zeros((*frames.shape, 3), np.float32) for case in views}
    previews = PreviewPair(frames.shape, scene.camera)
    sums = np.zeros((2, int(scene.parts.max(initial=0)) + 1))
    for rows in frames.bands():
        observed, valid = frames.read(rows, lights=np.array([j]))
        band = scene.predict(light, rows, visibility)
        inside = frames.mask[rows]
        parts = (band.diffuse, band.specular, band.lit)
        if known_truth:
            parts = (known_truth.body[rows], known_truth.gloss[rows], known_truth.lit[rows])
        comparison.add(
            rows,
            band.channels,
            observed[0],
            usable=valid[0],
            known=scene.estimated[rows],
            inside=inside,
            classes=classify(*parts, inside=inside),
        )
        used = (comparison.classes[rows] > 0) & (scene.parts[rows] >= 0)
        for total, each in zip(sums, (band.channels, observed[0]), strict=True):
            total += np.bincount(scene.parts[rows][used], each[used].mean(axis=-1), total.size)
        previews.add(rows, band.channels, observed[0], inside=inside)
        for case, colour in views.items():
            pictures[case][rows] = colour.xyz(band, scene.coefficients(rows))
    x, y, z = frames.directions[j]
    score = comparison.score() | {
        "name": name,
        "index": j,
        "role": "check" if frames.roles[j] == "check" else "held out",
        "incidence_deg": float(np.degrees(np.arctan2(np.hypot(x, y), z))),
        "azimuth_deg": float(np.degrees(np.arctan2(y, x))),
        "cast_shadows": height is not None,
    }
    if known_truth:
        score["truth"] = {}
        for case, picture in pictures.items():
            true = known_truth.xyz_lamp if case == "lamp" else known_truth.xyz_d65  # free of noise
            total, by_class = truth_difference(picture, true, views[case].white, classes=comparison.classes)
            by_name = {name: asdict(each) for name, each in by_class.items()}
            score["truth"][case] = {"de00": asdict(total), "by_class": by_name}
    np.savez(context.output.path(f"preview_{j:03d}.npz"), **previews.arrays())
    out.write(f"de00_{j:03d}", comparison.de00_map, light=name, nan=f"not compared: classes_{j:03d}")
    out.write(f"classes_{j:03d}", comparison.classes, meaning={str(k): v for k, v in NAMES.items()}, light=name)
    return score, comparison.de00_map, sums


def colours_for(scene: EvaluatedScene) -> dict:
    """Return conversions of the prediction to XYZ: under the capture's lamp, and, with spectra, under D65."""
    if scene.basis is None or "illuminant" not in scene.curves:
        return {} if scene.camera.rmse is None else {"lamp": painting_maps.channel_colour(scene.camera)}
    return {
        "lamp": painting_maps.spectral_colour(scene.curves["illuminant"], scene.basis),
        "D65": painting_maps.spectral_colour(illuminant("D65"), scene.basis),
    }
