"""A painting for the viewers of museums: tiles and manifest."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from small_painting import COLUMNS, PITCH_MM, ROWS, STAMP, exported_painting

from nishiki.formats.banded_pictures import read_jpeg, write_iiif_image
from nishiki.render.display import normals_as_colours
from nishiki.stages.export.iiif import manifest
from nishiki.stages.export.scene import ExportedScene


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The painting, the folder of its exports, and what the stage reports."""
    with exported_painting(tmp_path_factory.mktemp("painting"), ("iiif",)) as made:
        yield made


def test_iiif_tiles_are_the_picture_and_the_manifest_is_one(exported):
    from iiif_prezi3 import Manifest

    folder = exported.folder / "iiif"
    text = (folder / "manifest.json").read_text(encoding="utf-8")
    manifest = Manifest(**json.loads(text))
    assert json.loads(manifest.json())["id"] == "http://localhost:8000/manifest.json"
    canvas = json.loads(text)["items"][0]
    assert (canvas["height"], canvas["width"]) == (ROWS, COLUMNS)
    assert canvas["service"][0]["physicalScale"] == PITCH_MM
    choices = canvas["items"][0]["items"][0]["body"]["items"]
    assert [choice["service"][0]["id"].rsplit("/", 1)[1] for choice in choices] == ["colour", "relief", "normals"]
    for choice in choices:
        picture = read_jpeg(folder / choice["id"].removeprefix("http://localhost:8000/"))
        assert picture.shape == (choice["height"], choice["width"], 3)
    read = (
        read_jpeg(folder / "normals" / f"0,0,{COLUMNS},{ROWS}" / f"{COLUMNS},{ROWS}" / "0" / "default.jpg") / 255 * 2
        - 1
    )
    known = exported.painting.known
    angle = np.degrees(
        np.arccos(np.clip((read * exported.painting.normals).sum(-1) / np.linalg.norm(read, axis=-1), -1, 1))
    )
    assert np.median(angle[known]) < 2
    losses = exported.reported["losses"]["iiif"]["jpeg_psnr_db"]
    coded = normals_as_colours(exported.painting.normals.astype(np.float32)) // 257
    error = ((read + 1) / 2 * 255 - coded)[known]
    assert losses["normals"] == pytest.approx(-10 * np.log10(np.mean((error / 255) ** 2)), abs=1)


@pytest.mark.parametrize("shape", [(700, 1300), (513, 512), (2500, 40), (3, 5)])
def test_iiif_files_are_those_that_a_viewer_asks_for(tmp_path, shape):
    y, x = np.mgrid[: shape[0], : shape[1]]
    picture = np.stack([x * 200 // shape[1], y * 200 // shape[0], (x + y) // 40 % 2 * 60 + 60], axis=-1).astype(
        np.uint8
    )
    write_iiif_image(tmp_path / "a", "https://a.example/a", picture, tmp_path, 95)
    info = json.loads((tmp_path / "a" / "info.json").read_text())
    assert (info["height"], info["width"]) == shape
    (tiles,) = info["tiles"]
    asked = {"full/max", *(f"full/{size['width']},{size['height']}" for size in info["sizes"])}
    for factor in tiles["scaleFactors"]:
        side = tiles["width"] * factor
        shown = np.zeros((-(-shape[0] // factor), -(-shape[1] // factor), 3), np.uint8)
        for top in range(0, shape[0], side):
            for left in range(0, shape[1], side):
                wide, high = min(side, shape[1] - left), min(side, shape[0] - top)
                size = -(-wide // factor), -(-high // factor)
                name = f"{left},{top},{wide},{high}/{size[0]},{size[1]}"
                tile = read_jpeg(tmp_path / "a" / name / "0" / "default.jpg")
                assert tile.shape == (size[1], size[0], 3)
                shown[top // factor : top // factor + size[1], left // factor : left // factor + size[0]] = tile
                asked.add(name)
        if factor == 1:
            assert np.abs(shown.astype(int) - picture).mean() < 2
    there = {path.parent.parent.relative_to(tmp_path / "a").as_posix() for path in tmp_path.glob("a/*/*/0/default.jpg")}
    assert there == asked
    whole = read_jpeg(tmp_path / "a" / "full" / "max" / "0" / "default.jpg")
    assert max(whole.shape) == min(max(shape), 1024)
    means = picture.reshape(-1, 3).mean(axis=0)
    np.testing.assert_allclose(whole.reshape(-1, 3).mean(axis=0), means, atol=3)


def test_rights_of_a_manifest(exported):
    def stated(rights):
        ingest = exported.painting.inputs["ingest"]
        about = {**ingest.diagnostics["capture"], "rights": rights, "creator": "A. N. Other", "object_holder": "Museum"}
        inputs = {"ingest": SimpleNamespace(diagnostics={"capture": about})}
        context = SimpleNamespace(inputs=inputs, stamp=STAMP)
        return manifest(context, ExportedScene(exported.painting.inputs), "https://a.example")

    assert stated("https://creativecommons.org/licenses/by/4.0/")["rights"].endswith("by/4.0/")
    rights = "Museum of X, all rights reserved"
    assert stated(rights)["requiredStatement"]["value"]["none"] == [rights]
    plain = stated(None)
    assert not {"rights", "requiredStatement"} & set(plain)
    assert {"A. N. Other", "Museum"} <= {
        entry["value"]["none"][0] for entry in plain["metadata"] if "none" in entry["value"]
    }
