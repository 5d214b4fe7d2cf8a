"""A packed scene: the same bytes from the same artifacts, whoever made it, and a description that others can read."""

import json
import shutil
import subprocess
from dataclasses import replace

import crate_profile
import pytest
from crates import ABOUT, audit, packed, scene_to_pack
from refusals import expect_facts, refused

from nishiki.archive.crate import MANIFEST, manifest_text, parse_manifest_text
from nishiki.archive.pack import write_zip
from nishiki.artifacts.provenance import file_digest
from nishiki.commands.archiving import expect_outside
from nishiki.errors import UserError


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A scene and its project."""
    return scene_to_pack(tmp_path_factory.mktemp("pack"))


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    """The crate of the scene."""
    target = tmp_path_factory.mktemp("made") / "crate"
    packed(scene, target)
    return target


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("with_capture", [True, False])
def test_a_crate_is_sound_elsewhere_and_the_same_at_every_packing(scene, tmp_path, with_capture):
    digests = []
    for number in range(2):
        target = tmp_path / f"crate-{number}"
        digests.append(packed(scene, target, with_capture=with_capture))
        write_zip(target, tmp_path / f"{number}.zip")
    assert digests[0] == digests[1] == file_digest(target / MANIFEST)
    assert contents(tmp_path / "crate-0") == contents(tmp_path / "crate-1")
    assert (tmp_path / "0.zip").read_bytes() == (tmp_path / "1.zip").read_bytes()
    for path in (target, tmp_path / "0.zip"):
        problems, facts = audit(path)
        assert problems == []
        assert (facts.scene, len(facts.stages), facts.photographs) == ("scene", 8, with_capture)
        assert (facts.capture, facts.digest) == (scene[0].digest, digests[0])
    assert (target / "capture/data/photograph 0.tif").exists() == with_capture
    assert not list(tmp_path.glob(".*"))


def test_the_usual_tool_checks_the_files(made):
    done = subprocess.run(["sha256sum", "--check", "--strict", "--quiet", MANIFEST], cwd=made, check=False)
    assert done.returncode == 0


@pytest.mark.parametrize("name", ["../x", "/x", "a//b", "a/./b", "a\nb", "a\\b"])
def test_the_manifest_names_only_what_is_inside(name):
    line = f"{'0' * 64}  {name}\n".encode()
    with pytest.raises(ValueError):
        parse_manifest_text(line)


def test_a_manifest_has_one_form():
    digests = {"b": "0" * 64, "a b": "1" * 64, "ü": "2" * 64}
    data = manifest_text(digests).encode()
    assert parse_manifest_text(data) == digests
    lines = data.splitlines(keepends=True)
    for other in (b"".join(lines[::-1]), data + lines[0], data[:-1], data.replace(b"  ", b" "), b"\xff" + data):
        with pytest.raises(ValueError):
            parse_manifest_text(other)


def test_nothing_is_overwritten_and_a_failure_leaves_nothing(scene, tmp_path):
    (tmp_path / "crate").mkdir()
    with refused(UserError, "--output"):
        packed(scene, tmp_path / "crate")
    path = scene[0].artifacts[-1].path("values.bin")
    sound = path.read_bytes()
    path.write_bytes(bytes(len(sound)))
    try:
        with refused(UserError, "values.bin"):
            packed(scene, tmp_path / "other")
    finally:
        path.write_bytes(sound)
    assert [path.name for path in tmp_path.iterdir()] == ["crate"]


def test_the_description_names_people_licences_libraries_settings_and_every_result(made, scene):
    described = json.loads((made / "ro-crate-metadata.json").read_text())
    entities = {entity["@id"]: entity for entity in described["@graph"]}
    assert len(entities) == len(described["@graph"])
    root = entities["./"]
    assert root["name"] == ABOUT["title"]
    assert root["license"] == {"@id": ABOUT["rights"]}
    assert root["datePublished"] == "2026-01-01T00:00:00+00:00"
    assert entities["#creator"]["name"] == ABOUT["creator"]
    assert entities["#object"]["identifier"] == ABOUT["object_id"]
    expect_facts(entities["#object"]["description"], ABOUT["object_kind"], ABOUT["object_holder"])
    assert entities["capture/"]["identifier"] == f"sha256:{scene[0].digest}"
    assert entities["https://pypi.org/project/numpy/2.4.6/"]["softwareVersion"] == "2.4.6"
    for item in scene[0].artifacts:
        folder = f"artifacts/{item.stage}/{item.key}/"
        assert entities[folder]["identifier"] == f"sha256:{item.digest}"
        assert entities[f"#run-{item.stage}"]["result"] == {"@id": folder}
        assert json.loads(entities[f"#settings-{item.stage}"]["value"]) == item.settings
        made_from = {entry["@id"] for entry in entities[f"#run-{item.stage}"]["object"]}
        above = item.manifest["upstream"]
        assert made_from == {f"#settings-{item.stage}"} | {
            "capture/" if stage == "capture" else f"artifacts/{stage}/{entry['key']}/" for stage, entry in above.items()
        }


def test_a_lock_is_named_only_where_the_project_has_one(made, scene, tmp_path):
    project = shutil.copytree(scene[1], tmp_path / "project")
    (project / "uv.lock").unlink()
    packed((scene[0], project), tmp_path / "crate")
    assert "lock" in (made / "ro-crate-metadata.json").read_text()
    assert "lock" not in (tmp_path / "crate/ro-crate-metadata.json").read_text()
    assert audit(tmp_path / "crate")[0] == []


def test_every_reference_of_the_description_leads_to_an_entity_or_a_file(made):
    """What the shapes of the profiles ask of the graph as a whole, without the package that holds them."""
    described = json.loads((made / "ro-crate-metadata.json").read_text())
    entities = {entity["@id"]: entity for entity in described["@graph"]}
    outside = ("https://w3id.org/", "https://bioschemas.org/", "https://doi.org/", "https://snakemake.readthedocs.io")
    for entity in entities.values():
        for value in entity.values():
            for reference in value if isinstance(value, list) else [value]:
                if isinstance(reference, dict):
                    assert reference["@id"] in entities or reference["@id"].startswith(outside), reference
        files = {"File", "Dataset"} & {*([entity["@type"]] if isinstance(entity["@type"], str) else entity["@type"])}
        if files and not entity["@id"].startswith(("http", "#")):
            assert (made / entity["@id"]).exists(), entity["@id"]
    main_entity = entities[entities["./"]["mainEntity"]["@id"]]
    assert {"File", "SoftwareSourceCode", "ComputationalWorkflow", "HowTo"} == set(main_entity["@type"])
    actions = [entity for entity in entities.values() if entity["@type"] == "CreateAction"]
    assert {main_entity["@id"]} <= {action["instrument"]["@id"] for action in actions}
    assert {entry["@id"] for entry in entities["ro-crate-metadata.json"]["conformsTo"]} == {
        "https://w3id.org/ro/crate/1.1",
        "https://w3id.org/workflowhub/workflow-ro-crate/1.0",
    }
    assert {entry["@id"] for entry in entities["./"]["conformsTo"]} >= {
        f"https://w3id.org/ro/wfrun/{name}/0.5" for name in ("process", "workflow", "provenance")
    }


@pytest.mark.slow
def test_the_shapes_of_the_profile_find_nothing(made):
    pytest.importorskip("rocrate_validator", reason="pip install roc-validator checks the shapes of the profiles too")
    found = crate_profile.problems(made, severity="RECOMMENDED")
    assert [line for line in found if not any(reason in line for reason in crate_profile.ALLOWED)] == []


def test_a_capture_that_says_nothing_of_people_can_be_packed(scene, tmp_path):
    bare = replace(scene[0], about=dict.fromkeys(ABOUT))
    packed((bare, scene[1]), tmp_path / "crate")
    assert audit(tmp_path / "crate")[0] == []
    described = (tmp_path / "crate/ro-crate-metadata.json").read_text()
    assert ABOUT["rights"] not in described
    assert "#creator" not in described


@pytest.mark.parametrize("place", ["results/crate", "results/scene/crate", "capture/crate", "capture/data/a/b"])
def test_no_crate_is_made_inside_results_or_a_sealed_capture(tmp_path, place):
    (tmp_path / "capture/data").mkdir(parents=True)
    (tmp_path / "capture/bagit.txt").write_text("BagIt-Version: 1.0\n")
    with refused(UserError, by="expect_outside"):
        expect_outside(tmp_path / place, tmp_path / "results")
    expect_outside(tmp_path / "crates" / place, tmp_path / "results")
