"""The command that exports, and the product."""

import json

import numpy as np
import pytest
import trimesh

pytestmark = pytest.mark.slow


def test_a_scene_is_exported_by_command_and_as_a_product(site):
    wrong = site.nishiki("export", "tiny", "normals", "wood", check=False)
    assert wrong.returncode == 2
    assert "wood" in wrong.stderr
    before = site.run_facts()
    told = site.nishiki("export", "tiny", "normals", "--output", "for-others").stdout
    assert "normals.tif" in told
    assert (site.folder / "for-others/normals.exr").is_file()
    assert site.run_facts() == before, "an export changes nothing of a finished scene"
    site.configure(products=["render", "evaluate", "report", "export"], export={"formats": ["normals"]})
    assert set(site.would_run()) == {"report", "publish"}, "the command and the product make the same artifact"
    site.nishiki("run")
    current = site.folder / "results/tiny/current"
    assert (current / "exports/normals.tif").read_bytes() == (site.folder / "for-others/normals.tif").read_bytes()
    assert json.loads((current / "export/artifact.json").read_text())["diagnostics"]["losses"]["normals"]["rms_deg"] > 0
    assert "normals.tif" in (current / "report.html").read_text()


def test_an_object_is_exported(object_site):
    object_site.nishiki("export", "tiny", "gltf", "--output", "for-others")
    mesh = trimesh.load(object_site.folder / "for-others/object.glb", force="mesh")
    given = trimesh.load(object_site.folder / "results/tiny/current/mesh.ply", process=False)
    np.testing.assert_allclose(mesh.bounds, given.bounds / 1000, rtol=1e-5)
    assert len(mesh.faces) == len(given.faces)
    (manifest,) = (object_site.folder / "results/tiny/object_export").glob("*/artifact.json")
    figures = json.loads(manifest.read_text())["diagnostics"]["losses"]["gltf"]["kinds"]["gltf"]["psnr_db"]
    evaluation = json.loads((object_site.folder / "results/tiny/current/object_evaluate/evaluation.json").read_text())
    model = evaluation["figures"]["model_alone"]["mean_covered_psnr_db"]
    assert figures["fitted"]["all"] > model - 0.5, "the textures show no less than the model without its residual"
