"""Mosaic: register the fields of a painting, level them, and join their maps into one scene's."""

import json
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nishiki.artifacts.artifact import Artifact
from nishiki.artifacts.maps import Maps, MapWriter
from nishiki.artifacts.stage import Context
from nishiki.brdf.scene import join_regions
from nishiki.colour.colour import delta_e_2000
from nishiki.errors import UserError
from nishiki.evaluate.camera_colour import read_camera_colour
from nishiki.formats.files import read_json
from nishiki.formats.stored import BandedArray, BandedGroup
from nishiki.model_selection.decision import economy
from nishiki.mosaic.adjustment import FieldPlacement, adjust
from nishiki.mosaic.blending import Levels, Samples, blend_band, compare_fields, level_fields
from nishiki.mosaic.registration import Field, register_fields, signals
from nishiki.observations.plane import STORE, Observations
from nishiki.photometric.flags import NO_ESTIMATE
from nishiki.stages.mosaic import OUTPUTS
from nishiki.threads import strips

BAND_PIXELS = 1 << 21  # of the mosaic, blended at a time
KINDS = ("flags", "mask", "labels", "lights_used", "condition")
BLENDED = ("normals", "reflectance", "albedo", "sigma", "correction_sigma", "residual", "shading")
PITCHES = 0.01  # relative difference of pixel pitches from which fields are no mosaic


@dataclass(frozen=True)
class FieldMaps:
    """The artifacts of one field. numbers : of the joined finishes, by those of the field; terms : of `shading`."""

    name: str
    frames: Observations
    normals: Maps
    labels: Maps | None
    numbers: np.ndarray
    terms: int

    def read(self, name: str, rows: slice) -> np.ndarray:
        """Read rows of a map by its name in the mosaic; a missing map of a field has neutral values."""
        if name == "mask":
            return BandedArray.of(self.frames.path / "mask")[rows]
        if name == "labels":
            count = rows.stop - rows.start, self.frames.shape[1]
            return self.numbers[np.zeros(count, int) if self.labels is None else self.labels.read("labels", rows)]
        if name == "shading_normals" and name not in self.normals:
            name = "normals"
        if name not in self.normals:  # Lambert's law; nothing put right
            values = np.zeros((rows.stop - rows.start, self.frames.shape[1], *([self.terms] * (name == "shading"))))
            values[..., :1] = name == "shading"
            return values.astype(np.float32)
        values = self.normals.read(name, rows)
        return values[..., : self.terms] if name == "shading" else values

    def as_field(self, stated_mm: tuple[float, float] | None) -> Field:
        """Return the field for the registration; y of the stated position is up."""

        def read(rows: slice, columns: slice) -> tuple[np.ndarray, np.ndarray]:
            known = (self.normals.read("flags", rows)[:, columns] & NO_ESTIMATE) == 0
            parts = (self.normals.read(name, rows)[:, columns] for name in ("reflectance", "normals"))
            return signals(*parts) * known[..., None], known

        pitch, centre = self.frames.pixel_pitch_mm, np.array(self.frames.image_centre[::-1])
        stated = None if stated_mm is None or not pitch else np.array(stated_mm) * (1, -1) / pitch
        return Field(self.name, self.frames.shape, read, centre, stated)


def run(context: Context) -> dict:
    """Place, level and blend all fields; one band of the mosaic is in memory at a time."""
    parameters, fields = open_fields(context.fields)
    first = context.fields[fields[0].name]["ingest"]
    context.progress.tell("registering fields")
    unplaced = [each.as_field(context.settings.positions_mm.get(each.name)) for each in fields]
    placement, adjusted = adjust(unplaced, register_fields(unplaced))
    readers = [each.read for each in fields]
    samples = compare_fields(placement, readers)
    used = np.arange(len(samples.pair)) % 2 == 0
    levels, decision = level_fields(samples.only(used), len(fields))
    context.progress.tell(str(decision))
    lab = read_camera_colour(first.path("curves.npz"), len(fields[0].frames.channels), fields[0].frames.to_srgb).lab
    seams = measure_seams(samples.only(~used), [each.name for each in fields], levels, lab)
    counts, notes = write_maps(context, fields, placement, levels, several=len(parameters) > 1)
    text = json.dumps({"regions": parameters}, indent=1, sort_keys=True, allow_nan=False)
    context.output.path("parameters.json").write_text(text + "\n")
    context.output.path("curves.npz").write_bytes(first.path("curves.npz").read_bytes())
    described = describe(placement, adjusted, levels, seams) | {"notes": notes}
    text = json.dumps(described, indent=1, sort_keys=True, allow_nan=False)
    context.output.path("mosaic.json").write_text(text + "\n")
    weights = [seam["samples"] for seam in seams.values()]
    means = {
        name: float(np.average([seam[key][1] for seam in seams.values()], weights=weights)) if seams else 0.0
        for name, key in (("seam_delta_e", "delta_e"), ("seam_deg", "angle_deg"))
    }
    return {
        "capture": first.diagnostics["capture"],
        "fields": len(fields),
        "overlaps": sum(each["used"] for each in adjusted["overlaps"]),
        "registration_rms_px": adjusted["rms_px"],
        "position_sigma_px": float(placement.sigma.max()),
        **means,
        **counts,
        "regions": len(parameters),
        "economy": economy(decision),
    }


def open_fields(artifacts: dict[str, dict[str, Artifact]]) -> tuple[list[dict], list[FieldMaps]]:
    """Open the artifacts of all fields, and join their finishes.

    Raises UserError where fields differ in what one painting under the same lamps and camera has in common.
    """
    names = sorted(artifacts)
    empty = [name for name in names if not artifacts[name]["normals"].diagnostics["valid_pixels"]]
    if empty:
        raise UserError(
            f"mosaic: no normal in field {empty[0]}. Remedy: photograph it again, or take it out of fields.csv"
        )
    frames = [Observations(artifacts[name]["ingest"].folder) for name in names]
    for name, other in zip(names, frames, strict=True):
        for what in ("channels", "to_srgb", "white_board", "pixel_pitch_mm"):
            expected, found = getattr(frames[0], what), getattr(other, what)
            if expected != found and not (what == "pixel_pitch_mm" and np.isclose(expected, found, rtol=PITCHES)):
                raise UserError(
                    f"{other.path}: field {name} differs from {names[0]} in {what}: expected {expected}, found {found}"
                    ". Remedy: correct its capture, or photograph it again with the camera of the others."
                )
    regions = [
        read_json(artifacts[name]["brdf"].path("parameters.json"))["regions"] if "brdf" in artifacts[name] else []
        for name in names
    ]
    joined, numbers = join_regions(regions)
    if len(joined) > np.iinfo(np.uint8).max:
        raise UserError(f"mosaic: expected at most 255 different finishes in all fields, found {len(joined)}")
    maps = [Maps(artifacts[name]["normals"].folder) for name in names]
    terms = {each.group["shading"].shape[2] for each in maps if "shading" in each} or {0}
    common = 5 if terms == {5} else min(terms | {3})
    fields = []
    for name, seen, each, number in zip(names, frames, maps, numbers, strict=True):
        labels = Maps(artifacts[name]["brdf"].folder) if len(number) > 1 else None
        fields.append(FieldMaps(name, seen, each, labels, np.array(number or [0], np.uint8), common))
    return joined, fields


def measure_seams(
    samples: Samples, names: list[str], levels: Levels, lab: Callable[[np.ndarray], np.ndarray]
) -> dict[tuple[str, ...], dict]:
    """Measure how far two fields differ where they overlap, before and after levelling, by their names.

    delta_e : mean CIEDE2000; angle_deg : mean angle between normals, of areas that the levels were not solved from.
    """
    seams = {}
    for pair in np.unique(samples.pair, axis=0):
        here = samples.only((samples.pair == pair).all(axis=1))
        both = [here.values, levels.taken_off(here)]
        colours = [lab(np.exp(ends[..., :-2])) for ends in both]
        angles = [np.hypot(*np.moveaxis(ends[:, 0, -2:] - ends[:, 1, -2:], -1, 0)) for ends in both]
        seams[tuple(names[i] for i in pair)] = {
            "samples": len(here.pair),
            "delta_e": [float(delta_e_2000(each[:, 0], each[:, 1]).mean()) for each in colours],
            "angle_deg": [float(np.degrees(each.mean())) for each in angles],
        }
    return seams


def write_maps(
    context: Context, fields: list[FieldMaps], placement: FieldPlacement, levels: Levels, *, several: bool
) -> tuple[dict, list[str]]:
    """Blend band by band into the maps of the mosaic, and write its mask as ingested frames without a light.

    Returns counts of pixels and the median sigma, and what was left out, in sentences.
    """
    rows, columns = placement.shape
    step = max(16, min(256, BAND_PIXELS // columns))
    of_all = [name for name in BLENDED if any(name in each.normals for each in fields)]
    if any("shading_normals" in each.normals for each in fields):
        of_all.append("shading_normals")
    kinds = {name: False for name in of_all} | {name: True for name in KINDS if several or name != "labels"}
    out = MapWriter.of(context, OUTPUTS, (rows, columns), step)
    one = fields[0].frames
    unbalanced = fields[0].normals.group.attrs.get("unbalanced", False)
    out.group.update(pixel_pitch_mm=one.pixel_pitch_mm, to_srgb=one.to_srgb, unbalanced=unbalanced)
    group = BandedGroup.create(context.output.folder / STORE)
    stored: dict = {}
    counts, sigmas = {"object_pixels": 0, "valid_pixels": 0}, []
    for band in context.progress.over(list(strips(rows, step)), "band"):
        maps = blend_band(placement, [each.read for each in fields], levels, kinds, band)
        for name, values in maps.items():
            if name not in stored and name == "mask":
                stored[name] = group.create_array(name, (rows, columns), (step, columns), "uint8", compression="zstd")
            elif name not in stored:
                stored[name] = out.create(name, values.shape[2:])
            stored[name][band] = values
        inside = maps["mask"] > 0
        known = inside & ((maps["flags"] & NO_ESTIMATE) == 0)
        counts["object_pixels"] += int(inside.sum())
        counts["valid_pixels"] += int(known.sum())
        sigmas.append(maps["sigma"][known][::199])
    shape = (0, rows, columns, len(one.channels))
    group.create_array("codes", shape, (1, step, *shape[2:]), one.dtype)
    nothing = {name: [] for name in ("lights", "files", "roles", "directions")}
    middle = [(rows - 1) / 2, (columns - 1) / 2]
    group.update(**one.attributes | nothing | {"positions_mm": None, "image_centre": middle, "band_rows": step})
    sigma = np.concatenate(sigmas)
    own = {each.name: each.normals.group["shading"].shape[2] for each in fields if "shading" in each.normals}
    lost = ", ".join(each.name for each in fields if own.get(each.name, 0) > each.terms)
    notes = [f"Shadows that the surroundings throw are left out; only these fields have them: {lost}."] if lost else []
    return {**counts, "sigma_median_deg": float(np.degrees(np.median(sigma))) if sigma.size else None}, notes


def describe(placement: FieldPlacement, adjusted: dict, levels: Levels, seams: dict) -> dict:
    """Return the mosaic's data for the page, places in pixels (column, row)."""
    fields = {}
    for i, field in enumerate(placement.fields):
        rows, columns = field.shape
        corners = np.array([(0, 0), (columns - 1, 0), (columns - 1, rows - 1), (0, rows - 1)], float)
        used = [each for each in adjusted["overlaps"] if each["used"] and field.name in each["fields"]]
        squares = sum(each["windows"] * each["rms_px"] ** 2 for each in used)
        fields[field.name] = {
            "corners": placement.to_mosaic(i, corners).tolist(),
            "rotation_deg": float(np.degrees(placement.turn[i])),
            "scale": float(placement.scale[i]),
            "gain": np.exp(-levels.own[i, :-2]).tolist(),
            "tilt_deg": np.degrees(levels.own[i, -2:]).tolist(),
            "residual_px": float(np.sqrt(squares / max(sum(each["windows"] for each in used), 1))),
            "position_sigma_px": float(placement.sigma[i]),
        }
    for each in adjusted["overlaps"]:
        each |= seams.get(tuple(each["fields"]), {"samples": 0, "delta_e": None, "angle_deg": None})
    return {"shape": list(placement.shape), "fields": fields, **adjusted}
