"""The command that exports, and the product."""

import json

import pytest

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
