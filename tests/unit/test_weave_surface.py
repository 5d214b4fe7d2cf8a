"""The woven surface: its mesh is sound; cuts, drawings and the stage."""

import json
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from weave_rays import brute_force

from nishiki.artifacts.artifact import ArtifactWriter, open_artifact
from nishiki.goniometry.table import ReflectanceSet, write_reflectances
from nishiki.stages.goniometer_samples import OUTPUTS
from nishiki.stages.weave.run import cut, draw_section
from nishiki.weave.fit import WeaveModel
from nishiki.weave.section import WarpSection, WeftSection, WovenSurface, shade
from nishiki.weave.store import read_yarns
from nishiki.weave.yarn_search import CENTRE, weave_of
from nishiki.weave.yarn_weave import Binding

PROJECT = Path(__file__).resolve().parents[2]
SATIN = WeftSection(0.9, 0.2, 0.5, 4), WarpSection(0.4, 0.5, 0.6, 3.0)


def test_drawing_is_well_formed_and_escaped():
    weft, warp = SATIN
    root = ElementTree.fromstring(draw_section(warp.profile(800)[0], warp.period, "", title="<a & b>"))
    assert len([e for e in root.iter() if e.tag.endswith("path")]) == 2
    assert "<a & b>" in "".join(root.itertext())
    assert brute_force(weft, 0.0) == pytest.approx(1.0, abs=1e-9)


def test_mesh_of_yarns_is_a_height_field_without_a_seam():
    surface = weave_of(CENTRE, Binding(2, 2)).surface()
    np.testing.assert_allclose(surface.height[0], surface.height[-1], atol=1e-9)
    np.testing.assert_allclose(surface.height[:, 0], surface.height[:, -1], atol=1e-9)
    vertices, faces = surface.mesh()
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    assert np.all(np.cross(b - a, c - a)[:, 2] > 0)
    picture = shade(surface)
    assert picture.dtype == np.uint8
    assert picture.std() > 5


def test_cuts_follow_the_middle_of_a_yarn():
    """Of two weft yarns and three warp yarns a repeat: the weft's cut sees every warp yarn once."""
    x, y = np.arange(31) / 10, np.arange(21) / 10 * 0.8
    height = np.where(np.abs(y % 0.8 - 0.4) < 0.05, 1.0, 0.0)[:, None] + np.where(np.abs(x % 1 - 0.5) < 0.05, 2.0, 0.0)
    surface = WovenSurface(x, y, height, height > 1.5, np.ones((2, 3), bool))
    (weft, period), (warp, other) = cut(surface, "weft"), cut(surface, "warp")
    assert (period, other) == (3.0, 1.6)
    assert weft[:, 1].min() == 1
    assert (weft[:, 1] == 3).sum() == 3
    assert warp[:, 1].min() == 2
    assert (warp[:, 1] == 3).sum() == 2


@pytest.mark.slow
def test_stage_from_reflectances_to_model_mesh_and_drawings(tmp_path):
    weft, warp = SATIN
    weft, warp = weft.scale(1 / weft.period), warp.scale(1 / warp.period)
    truth = WeaveModel(weft, warp, 0.5, 0.15, 1.5, np.array([6.0]), np.array([0.03]), "shaded")
    theta = np.radians(np.arange(0, 88, 3.0))
    view = np.zeros((2, theta.size, 3))
    view[0, :, 0] = view[1, :, 1] = np.sin(theta)
    view[..., 2] = np.cos(theta)
    view = view.reshape(-1, 3)
    lamp = np.broadcast_to([0.0, 0.0, 1.0], view.shape)
    values = np.concatenate([truth.predict(plane, theta) for plane in ("weft", "warp")])
    table = ReflectanceSet.of(lamp, view, values, weave="satin")
    with ArtifactWriter(tmp_path / "goniometer_samples" / "0") as out:
        write_reflectances(out.folder, OUTPUTS, table)
        names = ("scene", "stage", "key", "version", "code")
        manifest = dict(zip(names, ("cloth", "goniometer_samples", "0", "0", ""), strict=True))
        empty = {"settings": {}, "upstream": {}, "libraries": {}, "diagnostics": {}}
        out.finish({**manifest, **empty, "format_version": 1}, {})
    command = [
        sys.executable,
        PROJECT / "scripts" / "stage.py",
        "weave",
        "--inputs",
        tmp_path / "goniometer_samples" / "0",
    ]
    subprocess.run([*command, "--settings", '{"harness": 5}', "--output", tmp_path / "weave"], check=True)
    artifact = open_artifact(next((tmp_path / "weave").iterdir()))
    assert set(artifact.manifest["files"]) == {
        "weave.json",
        "weave.ply",
        "weave.png",
        "yarns_cloth.npz",
        "section_weft.svg",
        "section_warp.svg",
        "published_weft.svg",
        "published_warp.svg",
    }
    found = artifact.diagnostics["regions"]["cloth"]["parameters"]
    for name, value in truth.parameters().items():
        assert found[name] == pytest.approx(value, rel=0.01), name
    assert read_yarns(artifact.folder)[1]["determined"]
    json.dumps(artifact.diagnostics, allow_nan=False)
    assert artifact.diagnostics["regions"]["cloth"]["harness"] == 5
