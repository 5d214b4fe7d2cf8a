"""The stage mosaic: artifacts of fields into one that ordinary stages can read; what it refuses; finishes joined."""

import json
from pathlib import Path

import numpy as np
import pytest
from mosaics import CutMosaic, cut_relief, painted_relief
from pages import make_artifact

from nishiki.artifacts.artifact import Artifact, ArtifactWriter
from nishiki.artifacts.maps import Maps, MapWriter
from nishiki.artifacts.stage import Context, expect_finite
from nishiki.brdf.scene import join_regions
from nishiki.errors import UserError
from nishiki.formats.stored import BandedGroup
from nishiki.observations.plane import STORE, Observations
from nishiki.progress import Progress
from nishiki.stages.mosaic import MosaicSettings
from nishiki.stages.mosaic.run import run

STAMP = {"scene": "wall", "stage": "mosaic", "key": "0123456789ab", "version": "1"}
PITCH_MM = 0.1
MATT = {"at_bounds": [], "flags": [], "residual": 0.01, "rejected": 0.0, "samples": 100, "transmission": 1.0}


def region(beta: list[float], gamma: list[float], **other) -> dict:
    return {**MATT, "beta": beta, "gamma": gamma, "refractive_index": 1.45, "profile": {}, **other}


def artifacts_of(mosaic: CutMosaic, folder: Path, regions: list[list[dict]], **attributes) -> dict:
    """Artifacts of every field by stage; attributes: of the last field's frames, instead of the others'."""
    fields: dict[str, dict[str, Artifact]] = {}
    for number, (truth, maps) in enumerate(zip(mosaic.truth, mosaic.maps, strict=True)):
        rows, columns = truth["shape"]
        stored = {
            "format": 1,
            "lights": ["one"],
            "files": ["one.png"],
            "roles": ["sample"],
            "directions": [[0.0, 0.0, 1.0]],
            "positions_mm": None,
            "channels": ["red", "green", "blue"],
            "band_rows": 64,
            "pixel_pitch_mm": PITCH_MM,
            "image_centre": [(rows - 1) / 2, (columns - 1) / 2],
            "white_board": True,
            "to_srgb": None,
            **(attributes if number == len(mosaic.truth) - 1 else {}),
        }

        def ingest(writer: ArtifactWriter, stored=stored, shape=(rows, columns)) -> dict:
            group = BandedGroup.create(writer.folder / STORE, stored)
            group.create_array("codes", (1, *shape, 3), (1, 64, shape[1], 3), "uint8")
            group.create_array("mask", shape, shape, "uint8")[...] = np.ones(shape, np.uint8)
            np.savez(writer.path("curves.npz"))
            return {"capture": {"title": "Wall"}}

        def normals(writer: ArtifactWriter, maps=maps) -> dict:
            size = dict(zip(("rows", "columns"), maps["flags"].shape, strict=True))
            out = MapWriter(writer.folder, band_rows=64, stamp=STAMP, **size)
            for name, values in maps.items():
                out.write(name, values, unit="some")
            return {"valid_pixels": int(np.count_nonzero(maps["flags"] == 0))}

        def gloss(writer: ArtifactWriter, own=regions[number], shape=(rows, columns)) -> dict:
            writer.path("parameters.json").write_text(json.dumps({"regions": own}))
            if len(own) > 1:
                labels = np.zeros(shape, np.uint8)
                labels[:, shape[1] // 2 :] = 1
                MapWriter(writer.folder, rows=shape[0], columns=shape[1], band_rows=64, stamp=STAMP).write(
                    "labels", labels
                )
            return {}

        fills = {"ingest": ingest, "normals": normals, "brdf": gloss}
        fields[truth["name"]] = {
            stage: make_artifact(folder / truth["name"], None, fill, stamp=STAMP, stage=stage)
            for stage, fill in fills.items()
        }
    return fields


def stated(mosaic: CutMosaic) -> MosaicSettings:
    places = {each["name"]: (PITCH_MM * each["stated"][0], -PITCH_MM * each["stated"][1]) for each in mosaic.truth}
    return MosaicSettings(positions_mm=places)


def joined(fields: dict, settings: MosaicSettings, folder: Path, check) -> None:
    """Run the stage, and `check(folder, diagnostics)` what it wrote."""
    with ArtifactWriter(folder / "mosaic" / STAMP["key"]) as output:
        context = Context({}, settings, output, None, None, STAMP, Progress("wall/mosaic"), fields=fields)
        diagnostics = run(context)
        expect_finite(output.folder, "mosaic")
        check(output.folder, diagnostics)


@pytest.fixture(scope="module")
def mosaic():
    return cut_relief(*painted_relief(420, 560), grid=(1, 2))


def test_fields_become_one_scene_that_ordinary_readers_open(mosaic, tmp_path):
    shiny, wide = region([10.0], [0.1]), region([0.5], [0.4])
    fields = artifacts_of(mosaic, tmp_path, [[shiny], [wide, {**shiny, "samples": 50}]])

    def check(folder: Path, diagnostics: dict) -> None:
        maps, frames = Maps(folder), Observations(folder)
        page = json.loads((folder / "mosaic.json").read_text())
        assert tuple(page["shape"]) == frames.shape == maps.read("flags").shape
        assert frames.lights == ()
        assert frames.directions.shape == (0, 3)
        assert 0.9 < frames.mask.mean() <= 1
        assert maps.group.attrs["pixel_pitch_mm"] == PITCH_MM
        known = maps.read("flags") == 0
        assert diagnostics["valid_pixels"] == known.sum() > 0.9 * known.size
        assert np.allclose(np.linalg.norm(maps.read("normals"), axis=-1), 1, atol=1e-4)
        assert diagnostics["registration_rms_px"] < 0.1
        assert diagnostics["seam_deg"] < 1.5
        assert diagnostics["seam_delta_e"] < 2
        assert [each["fields"] for each in page["overlaps"]] == [["a1", "a2"]]
        regions = json.loads((folder / "parameters.json").read_text())["regions"]
        assert [each["samples"] for each in regions] == [150, 100]
        labels, middle = maps.read("labels"), known.shape[0] // 2
        assert labels[middle, 20] == 0  # shiny in the first field, and in the right half of the second
        assert labels[middle, -20] == 0
        assert (labels[middle] == 1).sum() > 20

    joined(fields, stated(mosaic), tmp_path, check)


@pytest.mark.parametrize(
    ("attributes", "word"),
    [
        ({"channels": ["a", "b", "c"]}, "channels"),
        ({"pixel_pitch_mm": 0.2}, "pitch"),
        ({"white_board": False}, "white"),
    ],
)
def test_fields_of_another_camera_are_refused_by_name(mosaic, tmp_path, attributes, word):
    one = [region([1.0], [0.1])]
    fields = artifacts_of(mosaic, tmp_path, [one, one], **attributes)
    with pytest.raises(UserError, match=word) as raised:
        joined(fields, stated(mosaic), tmp_path, lambda *_: None)
    assert "a2" in str(raised.value)


def test_finishes_that_agree_are_joined_by_the_mean_of_their_strengths():
    one = region([10.0, 2.0], [0.06, 0.15], samples=300)
    other = region([9.0, 3.0], [0.06, 0.15], samples=100, transmission=0.9)
    matt = region([0.0], [0.9], samples=50)
    regions, numbers = join_regions([[one], [matt, other]])
    assert numbers == [[0], [1, 0]]
    assert np.allclose(regions[0]["beta"], [9.75, 2.25])
    assert regions[0]["gamma"] == [0.06, 0.15]
    assert regions[0]["samples"] == 400
    assert np.isclose(regions[0]["transmission"], 0.975)
    assert regions[1]["beta"] == [0.0, 0.0]


def test_no_finishes_are_none():
    assert join_regions([[], []]) == ([], [[], []])
