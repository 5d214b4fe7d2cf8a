"""What the stages really loaded and read, against what plans and the table of stages say."""

import json
import os

import pytest

from nishiki.packages import EXTRAS
from nishiki.stages.table import CHAIN

pytestmark = pytest.mark.slow

LIGHT = {"numpy"}


def run_facts(site) -> dict[str, dict]:
    current = site.folder / "results/tiny/current"
    return {path.parent.name: json.loads(path.read_text()) for path in current.glob("*/run.json")}


@pytest.fixture(params=["finished_site", "finished_object", "finished_cloth"])
def any_site(request):
    return request.getfixturevalue(request.param)


def test_no_stage_loads_a_heavy_package_that_it_has_not_declared(any_site):
    found = run_facts(any_site)
    undeclared = {name: set(facts["packages"]) - LIGHT - set(CHAIN[name].libraries) for name, facts in found.items()}
    assert len(undeclared) > 6
    assert not {name: packages for name, packages in undeclared.items() if packages}


def test_optional_packages_are_loaded_exactly_where_the_plan_says(any_site):
    told = json.loads(any_site.nishiki("plan", "--json").stdout)
    planned = {stage["stage"]: set(stage["packages"]) & set(EXTRAS) for stage in told["stages"]}
    found = {name: set(facts["packages"]) & set(EXTRAS) for name, facts in run_facts(any_site).items()}
    assert found == planned
    assert set(told["optional_packages"]["loaded"]) == set().union(*planned.values())


def test_ingest_reads_what_the_plan_says(any_site):
    told = json.loads(any_site.nishiki("plan", "--json").stdout)
    current = any_site.folder / "results/tiny/current/ingest"
    assert json.loads((current / "artifact.json").read_text())["diagnostics"]["read"] == told["reads"]
    # every file at least once: to be decoded; and most twice: to be proven against the seal
    assert json.loads((current / "run.json").read_text())["bytes_read"] > told["reads"]["total"]["bytes_read"]


def test_the_report_says_what_was_read_and_left_out(any_site):
    page = (any_site.folder / "results/tiny/current/report.html").read_text()
    assert "What was read and what was left out, and why" in page
    assert "no photograph is camera raw" in page
    assert "all files" in page


def test_a_scene_that_needs_less_reads_less(site):
    whole = bytes_of_photographs(site)
    with_all_products = normals_files(site)
    table = site.folder / "config/scenes.tsv"
    usual = table.read_text()
    table.write_text("scene\tcapture\ttruth\tproducts\ntiny\tcaptures/tiny\t\tnormals\n")
    photographs = sorted((site.folder / "captures/tiny/data/frames").glob("check*"))
    for file in photographs:
        os.rename(file, file.with_suffix(".aside"))
        file.write_bytes(b"nobody should look at this")
    try:
        text = site.nishiki("plan").stdout
        site.nishiki("run")
        facts = run_facts(site)
        less = bytes_of_photographs(site)
        with_normals_alone = normals_files(site)
    finally:
        for file in photographs:
            os.replace(file.with_suffix(".aside"), file)
        table.write_text(usual)
        site.nishiki("run")  # publishes the whole scene again
    assert "without 4 photographs under check lights: only evaluate and export look at them" in text
    assert set(facts) == {"ingest", "separate", "normals"}
    assert less < 0.9 * whole
    assert with_normals_alone == with_all_products, "normals depend on the products asked for"
    assert not set(facts["normals"]["packages"]) & set(EXTRAS)


def bytes_of_photographs(site) -> int:
    """Bytes of the files that the published ingest opened. The process also reads its imports, more than tiny files."""
    artifact = json.loads((site.folder / "results/tiny/current/ingest/artifact.json").read_text())
    return artifact["diagnostics"]["read"]["total"]["bytes_read"]


def normals_files(site):
    """Bytes of every file of the published map of normals, by name."""
    folder = (site.folder / "results/tiny/current/normals").resolve() / "maps.zarr/normals"
    files = {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    assert any("c/" in name for name in files), "expected chunks of the map"
    return files
