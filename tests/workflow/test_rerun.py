"""What runs again, and what does not, as Snakemake sees it."""

import json
import os
import re
import shutil

import pytest
from refusals import expect_facts

pytestmark = pytest.mark.slow

DOWNSTREAM_OF_NORMALS = ["height", "spectra", "brdf", "render", "evaluate", "report"]


def edit(site, name, old, new):
    path = site.folder / name
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_every_stage_ran_and_nothing_is_left_to_do(site):
    assert set(site.run_facts()) == site.usual_stages()
    assert site.would_run() == []
    assert ": done" not in site.nishiki("run").stderr


def test_the_engine_hears_of_unfinished_scenes_only(site):
    """A capture under another path, of the same digest: Snakemake by itself would make the scene again."""
    shutil.copytree(site.folder / "results/tiny", site.folder / "results/other", symlinks=True)
    shutil.rmtree((site.folder / "results/other/current/report").resolve())
    moved = site.folder.resolve() / "captures/tiny"
    rows = f"tiny\t{moved}\tcaptures/tiny-truth\nother\tcaptures/tiny\tcaptures/tiny-truth\n"
    (site.folder / "config/scenes.tsv").write_text("scene\tcapture\ttruth\n" + rows)
    before = site.run_facts()
    assert "ingest" in site.would_run()
    done = site.nishiki("run")
    assert "1 of 2 " in done.stderr
    assert "2 of 2 " in site.nishiki("run").stderr
    assert (site.folder / "results/other/current/report/report.html").is_file()
    assert site.run_facts() == before
    assert not list((site.folder / "results/.runs").glob("*.json"))


def test_times_comments_docstrings_and_layout_rerun_nothing(site):
    name = "workflow/src/nishiki/photometric/solve.py"
    path = site.folder / name
    path.write_text("# a comment\n\n\n" + path.read_text())
    edit(site, "workflow/src/nishiki/observations/plane.py", '"""The ingested frames', '"""Changed words')
    for folder in ("workflow", "scripts", "captures", "config", "results"):
        for path in (site.folder / folder).rglob("*"):
            if path.is_file() and not path.is_symlink():
                path.touch()
    assert site.would_run() == []


def test_code_reruns_the_stages_that_import_it_and_what_follows(site):
    edit(site, "workflow/src/nishiki/colour/fitting.py", "import numpy as np", "import numpy as np\n\nUNUSED = 1")
    stages = site.would_run()
    assert "spectra" in stages
    assert not {"ingest", "separate", "normals", "height", "brdf"} & set(stages)


def test_changing_w1_leaves_ingest_alone(site):
    site.configure(separate={"method": "threshold", "w1": 1.3})
    assert site.would_run() == ["separate", "normals", *DOWNSTREAM_OF_NORMALS, "publish"]
    assert site.planned() == ["separate", "normals", *DOWNSTREAM_OF_NORMALS]


def test_changing_a_render_light_reruns_render_and_what_follows(site):
    light = {"elevation_deg": 30, "azimuth_deg": 10}
    site.configure(render={"pictures": [{"name": "daylight", "lights": [light]}], "sequences": []})
    assert site.planned() == ["render", "report"]


def test_going_back_costs_a_publication_only(site):
    before = site.run_facts()
    site.configure(height={"method": "weighted"})
    site.nishiki("run")
    changed = site.run_facts()
    assert changed["height"] != before["height"]
    assert changed["normals"] == before["normals"]
    site.configure()
    assert site.would_run() == ["publish"]
    site.nishiki("run")
    assert site.run_facts() == before


def test_explain_names_the_setting(site):
    site.configure(separate={"method": "threshold", "w1": 1.3})
    text = site.nishiki("explain", "tiny").stdout
    assert re.search("^tiny/ingest: up ", text, re.M)
    assert re.search("^tiny/separate: will ", text, re.M)
    assert "w1: 1.2 -> 1.3" in text


def test_plan_says_what_is_left_out_and_why(site):
    (site.folder / "config/scenes.tsv").write_text("scene\tcapture\ttruth\tproducts\ntiny\tcaptures/tiny\t\tnormals\n")
    text = site.ask("plan")
    expect_facts(text, "without render", "without 4")
    assert "colour" not in text, "normals take all channels, whichever products are asked for"


def test_verify_passes_then_names_each_damage(site):
    assert "sound" in site.nishiki("verify").stdout
    copy = site.folder / "damaged"
    shutil.copytree(site.folder / "results", copy, symlinks=True)
    maps = next((copy / "tiny/normals").glob("*/maps.zarr/normals/c/0/0/0"))
    data = bytearray(maps.read_bytes())
    data[100] ^= 1
    maps.write_bytes(data)
    missing = next((copy / "tiny/brdf").glob("*/parameters.json"))
    missing.unlink()
    foreign = next((copy / "tiny/height").glob("*")) / "notes.txt"
    foreign.write_text("x")
    done = site.nishiki("verify", str(copy), check=False)
    shutil.rmtree(copy)
    assert done.returncode == 1
    for word, path in (("damaged", maps), ("missing", missing), ("foreign", foreign)):
        assert any(
            line.startswith(word) and str(path.relative_to(site.folder)) in line for line in done.stdout.splitlines()
        )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"separate": {"methd": "threshold"}}, "'method'"),
        ({"separate": {"method": "magic"}}, "separate.method"),
        ({"separate": {"w1": -1}}, "separate.w1"),
        ({"normals": {"max_condition": "large"}}, "normals.max_condition"),
        ({"products": ["rendering"]}, "products"),
        ({"products": []}, "products"),
        ({"scenes": "config/none.tsv"}, "config/none.tsv"),
        ({"hold_out": ["no-such-light"]}, "no-such-light"),
        ({"hold_out": ["top", *[f"ring{i}" for i in range(1, 8)]]}, "3"),
        ({"render": {"pictures": [{"name": "A B"}]}}, "render.pictures.0.name"),
        ({"render": {"pictures": [{"name": "x", "lights": [{"elevation_deg": 0}]}]}}, "elevation_deg"),
        ({"render": {"pictures": [{"name": "x", "lights": [{"illuminant": "lamp.csv"}]}]}}, "lamp.csv"),
        ({"spectra": {"training": "nowhere.csv"}}, "nowhere.csv"),
        ({"unknown": 1}, "'unknown'"),
    ],
)
def test_bad_configuration_is_told_in_one_line_with_status_2(asked, settings, message):
    site, ask = asked
    site.configure(**settings)
    status, _, told = ask("plan")
    assert status == 2
    assert message in told
    assert len(told.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("separate: {method: [", "line 2"),
        ("- a\n- b\n", "config.yaml"),
        ("separate: !!python/object/apply:os.system [ls]\n", "line 1"),
    ],
)
def test_broken_yaml_is_told_with_its_file(asked, text, message):
    site, ask = asked
    (site.folder / "config/config.yaml").write_text(text)
    status, _, told = ask("plan")
    assert status == 2
    assert message in told
    assert "config/config.yaml" in told


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("scene\tcapture\ntiny\tcaptures/none\n", "captures/none"),
        ("scene\tcapture\ntiny\tcaptures/tiny\ntiny\tcaptures/tiny\n", "twice"),
        ("scene\tphotos\ntiny\tcaptures/tiny\n", "columns"),
        ("scene\tcapture\n../x\tcaptures/tiny\n", "../x"),
        ("scene\tcapture\ttruth\ntiny\tcaptures/tiny\tcaptures/none\n", "captures/none"),
        ("scene\tcapture\ttruth\tproducts\ntiny\tcaptures/tiny\t\tpicture\n", "picture"),
        ("scene\tcapture\ttruth\tproducts\tsettings\ntiny\tcaptures/tiny\t\t\tnone.yaml\n", "none.yaml"),
    ],
)
def test_bad_scene_table_is_told_in_one_line_with_status_2(asked, table, message):
    site, ask = asked
    (site.folder / "config/scenes.tsv").write_text(table)
    status, _, told = ask("plan")
    assert status == 2
    assert message in told


@pytest.mark.long
def test_scenes_side_by_side_have_one_thread_each_and_the_last_one_two(site):
    rows = "".join(f"{name}\tcaptures/tiny\t\tnormals\n" for name in ("first", "second"))
    broken = "".join(f"{name}\tcaptures/{name}\t\tnormals\n" for name in ("cut", "gone"))
    table, columns = site.folder / "config/scenes.tsv", "scene\tcapture\ttruth\tproducts\n"
    table.write_text(columns + broken + rows)
    shutil.copytree(site.folder / "captures/tiny", site.folder / "captures/cut")
    os.truncate(site.folder / "captures/cut/data/frames/top.png", 1000)
    done = site.nishiki("run", "--cores", "2", check=False)
    shutil.rmtree(site.folder / "captures/cut")
    assert_told_by_scene(done, site)
    table.write_text(columns + rows)
    assert threads_of_normals(site, "first") == threads_of_normals(site, "second") == 1
    artifact = (site.folder / "results/second/current/normals").resolve()
    before = (artifact / "artifact.json").read_bytes()
    shutil.rmtree(artifact)
    site.nishiki("run", "--cores", "2")
    assert threads_of_normals(site, "first") == 1
    assert threads_of_normals(site, "second") == 2
    assert (artifact / "artifact.json").read_bytes() == before


def assert_told_by_scene(done, site):
    """A line for each stage that was done, what is wrong with the other scenes, and nothing of Snakemake's own."""
    assert done.returncode == 1
    assert "\r" not in done.stderr
    lines = done.stderr.splitlines()
    for name in ("first", "second"):
        for stage in ("ingest", "separate", "normals"):
            assert any(re.fullmatch(rf"{name}/{stage}: .* [0-9.]+ \w+ \(\d of 9 .*\)", line) for line in lines)
        assert any(line.startswith(f"{name}: finished (") and line.endswith(" of 4 scenes)") for line in lines)
    assert any(line.startswith("nishiki cut/ingest: frames/top.png: changed after sealing") for line in lines)
    assert any(line.startswith("cut/ingest: failed") and ".snakemake/log/" in line for line in lines)
    expect_facts(done.stderr, "2 of 4", "cut (at ingest)", "gone")
    first, second = lines[lines.index("failed:") + 1 :]
    assert first.startswith("  cut/ingest: frames/top.png")
    assert second.startswith("  scene 'gone'")
    assert "jobid:" not in done.stderr + done.stdout
    log = max((site.folder / ".snakemake/log").glob("*.log"))
    assert "jobid:" in log.read_text()


def threads_of_normals(site, scene):
    return json.loads((site.folder / f"results/{scene}/current/normals/run.json").read_text())["threads"]
