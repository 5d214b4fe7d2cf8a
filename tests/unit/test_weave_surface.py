"""The woven surface: its crest lines are the sections, its mesh is sound; drawings and the stage."""

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
from nishiki.stages.weave.run import cut, draw_section
from nishiki.weave.fit import WeaveModel
from nishiki.weave.section import WarpSection, WeftSection, WovenSurface, harness_of, make_surface, shade, weave_pattern
from nishiki.weave.store import read_yarns

PROJECT = Path(__file__).resolve().parents[2]
CLOTHS = {
    "plain": (WeftSection(0.7, 0.2, 0.5, 1), WarpSection(0.7, 0.2, 0.5, 0.1), 2),
    "twill": (WeftSection(0.7, 0.2, 0.5, 2), WarpSection(0.5, 0.3, 0.5, 1.0), 3),
    "satin": (WeftSection(0.9, 0.2, 0.5, 4), WarpSection(0.4, 0.5, 0.6, 3.0), 5),
}


@pytest.mark.parametrize("weave", list(CLOTHS))
def test_crest_of_a_warp_yarn_is_the_warp_section(weave):
    """Same train of humps (up to a shift along the yarn), same masking when seen along the yarn."""
    weft, warp, harness = CLOTHS[weave]
    surface = make_surface(weft, warp, weave=weave, harness=harness, samples=200, spacing_ratio=1.0)
    section = warp.scaled(harness / warp.period)
    crest = surface.height[:, 100]
    assert crest.max() == pytest.approx(0.0, abs=1e-12)
    assert -crest.min() == pytest.approx(section.height, rel=0.02)
    points, _ = section.profile(20000)
    expected = np.interp(surface.y, points[:, 0], points[:, 1]) - section.height
    distances = [np.abs(np.roll(expected[:-1], k) - crest[:-1]).max() for k in range(len(crest) - 1)]
    assert min(distances) < 0.02 * section.height + 1e-9


@pytest.mark.parametrize("weave", list(CLOTHS))
def test_one_construction_gives_plain_twill_and_satin(weave):
    weft, warp, harness = CLOTHS[weave]
    surface = make_surface(weft, warp, weave=weave, harness=harness)
    assert np.all(np.isfinite(surface.height))
    assert surface.pattern.shape == (harness, harness)
    assert np.all((~surface.pattern).sum(axis=0) == 1)
    assert np.all((~surface.pattern).sum(axis=1) == 1)
    np.testing.assert_allclose(surface.height[0], surface.height[-1], atol=1e-9)  # repeats without a seam
    np.testing.assert_allclose(surface.height[:, 0], surface.height[:, -1], atol=1e-9)
    middle = (np.arange(harness) * 24 + 12)[:, None], (np.arange(harness) * 24 + 12)[None]
    np.testing.assert_array_equal(surface.is_warp[middle], surface.pattern)
    vertices, faces = surface.mesh()
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    assert np.all(np.cross(b - a, c - a)[:, 2] > 0)  # all triangles look upwards: a height field
    picture = shade(surface)
    assert picture.dtype == np.uint8
    assert picture.std() > 5


def test_patterns():
    satin = weave_pattern("satin", 5)
    assert satin.sum() == 20
    bound = np.argwhere(~satin)
    steps = np.diff(bound[np.argsort(bound[:, 1]), 0]) % 5
    assert set(steps) == {2}  # no two bindings side by side
    assert np.all(np.diff(np.argwhere(~weave_pattern("twill", 4))[:, 1]) == 1)
    assert harness_of(WeftSection(0.5, 1, 1, 4.2), "satin") == ("satin", 5)
    assert harness_of(WeftSection(0.5, 1, 1, 1.2), "unknown") == ("plain", 2)
    assert harness_of(WeftSection(0.5, 1, 1, 2.8), "unknown") == ("twill", 4)


def test_depths_agree_where_spacings_are_not_known():
    weft, warp, _ = CLOTHS["satin"]
    surface = make_surface(weft, warp, weave="satin", harness=5)
    scaled = weft.scaled(5 / weft.period)
    assert -surface.height[:, 12].min() == pytest.approx(scaled.height, rel=0.05)


def test_drawing_is_well_formed_and_escaped():
    weft, warp, _ = CLOTHS["satin"]
    root = ElementTree.fromstring(draw_section(warp.profile(800)[0], warp.period, "", title="<a & b>"))
    assert len([e for e in root.iter() if e.tag.endswith("path")]) == 2
    assert "<a & b>" in "".join(root.itertext())
    assert brute_force(weft, 0.0) == pytest.approx(1.0, abs=1e-9)


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
    weft, warp, _ = CLOTHS["satin"]
    weft, warp = weft.scaled(1 / weft.period), warp.scaled(1 / warp.period)
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
        write_reflectances(out.folder, table)
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
