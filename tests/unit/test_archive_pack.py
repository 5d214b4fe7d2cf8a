"""A packed scene: the same bytes from the same artifacts, audited where nothing else is, whoever made it."""

import hashlib
import json
import os
import shutil
import stat
import subprocess
import zipfile
from pathlib import Path

import crate_profile
import pytest
from archives import write_scene

from nishiki.archive.crate_audit import CrateAudit, audit_crate
from nishiki.archive.crate_names import MANIFEST, manifest_text, parse_manifest_text
from nishiki.archive.pack import PackedScene, pack, write_zip
from nishiki.artifacts.artifact import MANIFEST as ARTIFACT
from nishiki.artifacts.artifact import run_text
from nishiki.artifacts.provenance import file_digest, stage_program
from nishiki.capture.seal import capture_digest, seal
from nishiki.cli import main
from nishiki.commands.packing import expect_outside
from nishiki.errors import UserError

ABOUT = {
    "title": "Höhe & Tiefe",
    "creator": "A. Photographer",
    "date": "2026-01-01",
    "object_id": "inv. 12",
    "object_kind": "panel",
    "object_holder": "Museum of Works",
    "rights": "https://creativecommons.org/licenses/by/4.0/",
    "notes": "a note",
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pack")
    capture = folder / "capture"
    capture.mkdir()
    (capture / "capture.yaml").write_text("format: 1\n")
    for number in range(3):
        (capture / f"photograph {number}.tif").write_bytes(bytes([number]) * 1000)
    seal(capture)
    digest = capture_digest(capture)
    made = write_scene(folder / "results/scene", capture=digest)
    project = folder / "project"
    (project / "scripts").mkdir(parents=True)
    for name in ("Snakefile", "LICENSE", "uv.lock"):
        (project / name).write_text(f"{name}\n")
    for stage in made:
        (project / stage_program(stage)).parent.mkdir(parents=True)
        (project / stage_program(stage)).write_text("print()\n")
    facts = {"stages": {stage: {"key": item.key} for stage, item in made.items()}}
    does = {stage: f"does {stage}" for stage in made}
    return PackedScene("scene", "0.1.0", list(made.values()), capture, digest, ABOUT, facts, does), project


def packed(scene, target, *, with_capture=True):
    return pack(scene[0], scene[1], target, with_capture=with_capture, tell=lambda *_: None)


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    target = tmp_path_factory.mktemp("made") / "crate"
    packed(scene, target)
    return target


@pytest.fixture
def crate(made, tmp_path):
    return shutil.copytree(made, tmp_path / "crate")


def audit(path):
    found = CrateAudit(path)
    return list(audit_crate(found, threads=2, tell=lambda *_: None)), found


def kinds(path):
    return {damage.kind for damage in audit(path)[0]}


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def reseal(crate):
    """Another manifest that fits the files, as one would write it who wants to deceive."""
    names = [str(path.relative_to(crate)) for path in crate.rglob("*") if path.is_file() and not path.is_symlink()]
    digests = {name: file_digest(crate / name) for name in names if name != MANIFEST}
    (crate / MANIFEST).write_text(manifest_text(digests))


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
        assert (facts.capture, facts.digest) == (scene[0].capture_digest, digests[0])
    assert (target / "capture/data/photograph 0.tif").exists() == with_capture
    assert not list(tmp_path.glob(".*"))


def test_the_usual_tool_checks_the_files(made):
    done = subprocess.run(["sha256sum", "--check", "--strict", "--quiet", MANIFEST], cwd=made, check=False)
    assert done.returncode == 0


@pytest.mark.slow
def test_a_flipped_bit_is_found_in_every_file(crate):
    for name, sound in contents(crate).items():
        for at in {0, len(sound) // 2, len(sound) - 1}:
            flipped = bytearray(sound)
            flipped[at] ^= 4
            (crate / name).write_bytes(flipped)
            found = {damage.path for damage in audit(crate)[0]}
            assert crate / name in found or (found and name == MANIFEST), (name, at)
        (crate / name).write_bytes(sound)
    assert audit(crate)[0] == []


def artifact_of(crate, stage):
    return next((crate / "artifacts" / stage).iterdir())


def lose_artifact(crate):
    shutil.rmtree(artifact_of(crate, "height"))


def lose_photograph(crate):
    (crate / "capture/data/photograph 0.tif").unlink()


def lose_seal(crate):
    (crate / "capture/manifest-sha256.txt").unlink()


def other_capture(crate):
    (crate / "capture/data/photograph 0.tif").write_bytes(b"another")
    path = crate / "capture/manifest-sha256.txt"
    digest = hashlib.sha256(b"another").hexdigest()
    lines = path.read_text().splitlines()
    path.write_text("".join(f"{digest if 'photograph 0' in line else line[:64]}{line[64:]}\n" for line in lines))


def other_photograph(crate):
    (crate / "capture/data/photograph 0.tif").write_bytes(b"another")


def foreign_photograph(crate):
    (crate / "capture/data/more.tif").write_bytes(b"x")


def other_settings(crate):
    folder = artifact_of(crate, "report")
    manifest = json.loads((folder / ARTIFACT).read_text())
    manifest["settings"] = {"method": "other"}
    data = json.dumps(manifest).encode()
    (folder / ARTIFACT).write_bytes(data)
    (folder / "run.json").write_text(run_text({}, data))


def other_values(crate):
    """New values, digests and all, in an artifact that others were made from."""
    folder = artifact_of(crate, "normals")
    (folder / "values.bin").write_bytes(b"new")
    manifest = json.loads((folder / ARTIFACT).read_text())
    manifest["files"]["values.bin"] = {"bytes": 3, "sha256": hashlib.sha256(b"new").hexdigest()}
    data = json.dumps(manifest).encode()
    (folder / ARTIFACT).write_bytes(data)
    (folder / "run.json").write_text(run_text({}, data))


def moved(crate):
    folder = artifact_of(crate, "height")
    (crate / "artifacts/brdf" / folder.name).parent.mkdir(exist_ok=True)
    folder.rename(crate / "artifacts/brdf" / folder.name)


def other_description(crate):
    path = crate / "ro-crate-metadata.json"
    described = json.loads(path.read_text())
    described["@graph"] = [entity for entity in described["@graph"] if entity["@id"] != "#run-normals"]
    path.write_text(json.dumps(described))


@pytest.mark.parametrize(
    ("spoil", "kind"),
    [
        (lose_artifact, "incomplete"),
        (lose_photograph, "missing"),
        (lose_seal, "missing"),
        (other_capture, "damaged"),
        (other_photograph, "damaged"),
        (foreign_photograph, "foreign"),
        (other_settings, "wrong-key"),
        (other_values, "stale"),
        (moved, "misplaced"),
        (other_description, "damaged"),
        (lambda crate: shutil.rmtree(crate / "artifacts"), "incomplete"),
    ],
)
def test_deceit_with_a_manifest_that_fits_is_found(crate, spoil, kind):
    spoil(crate)
    reseal(crate)
    assert kind in kinds(crate)
    write_zip(crate, crate.with_suffix(".zip"))
    assert kind in kinds(crate.with_suffix(".zip"))


@pytest.mark.parametrize("name", ["", "artifacts", "capture/data/photograph 1.tif", "ro-crate-metadata.json", MANIFEST])
def test_links_are_named_and_never_followed(crate, tmp_path, name):
    outside = tmp_path / "outside"
    path = crate / (name or "link")
    if name:
        path.rename(outside)
    else:
        outside.write_text("secret")
    path.symlink_to(outside)
    before = {str(p): p.lstat().st_mtime_ns for p in tmp_path.rglob("*")}
    found, _ = audit(crate)
    assert any(damage.kind == "link" and damage.path == path for damage in found)
    assert {str(p): p.lstat().st_mtime_ns for p in tmp_path.rglob("*")} == before


def test_a_pipe_does_not_hold_the_audit_up(crate):
    path = artifact_of(crate, "report") / "values.bin"
    path.unlink()
    os.mkfifo(path)
    assert {"foreign", "missing"} <= kinds(crate) | {"missing"}
    assert "foreign" in kinds(crate)


def zipped(made, target, *entries, **options):
    """The crate as a ZIP file, with more entries: (ZipInfo, content)."""
    write_zip(made, target)
    with zipfile.ZipFile(target, "a", **options) as archive:
        for entry, data in entries:
            archive.writestr(entry, data)
    return target


def entry(name, *, mode=0o100644, stored=True):
    info = zipfile.ZipInfo(name)
    info.create_system, info.external_attr = 3, mode << 16
    info.compress_type = zipfile.ZIP_STORED if stored else zipfile.ZIP_DEFLATED
    return info


@pytest.mark.parametrize("name", ["../evil", "/etc/evil", "a/../../evil", "a//b"])
def test_names_in_a_zip_file_that_lead_outside_are_named_and_nothing_is_written(made, tmp_path, name):
    path = zipped(made, tmp_path / "x.zip", (entry(name), b"evil"))
    before = sorted(tmp_path.parent.rglob("*"))
    assert "foreign" in kinds(path)
    assert sorted(tmp_path.parent.rglob("*")) == before


def test_links_bombs_and_doubles_in_a_zip_file_are_named_and_not_read(made, tmp_path):
    link = zipped(made, tmp_path / "link.zip", (entry("link", mode=stat.S_IFLNK | 0o777), b"/etc/passwd"))
    assert "link" in kinds(link)
    bomb = zipped(made, tmp_path / "bomb.zip", (entry("bomb", stored=False), bytes(50_000_000)))
    assert bomb.stat().st_size < 1_000_000
    assert "foreign" in kinds(bomb)
    with pytest.warns(UserWarning, match="Duplicate name"):
        double = zipped(made, tmp_path / "double.zip", (entry("README.md"), b"another"))
    assert "foreign" in kinds(double)


@pytest.mark.parametrize("data", [b"", b"PK", b"PK\x05\x06" + bytes(18), b"not a zip file" * 100])
def test_what_is_no_zip_file_is_reported(tmp_path, data):
    path = tmp_path / "x.zip"
    path.write_bytes(data)
    assert audit(path)[0]


def test_cut_zip_files_are_reported(made, tmp_path):
    write_zip(made, tmp_path / "x.zip")
    whole = (tmp_path / "x.zip").read_bytes()
    for at in (100, len(whole) // 2, len(whole) - 30, len(whole) - 1):
        (tmp_path / "x.zip").write_bytes(whole[:at])
        assert audit(tmp_path / "x.zip")[0], at
    for at in range(0, len(whole), len(whole) // 40):
        flipped = bytearray(whole)
        flipped[at] ^= 0x10
        (tmp_path / "x.zip").write_bytes(flipped)
        audit(tmp_path / "x.zip")  # whatever it finds, it ends by itself


@pytest.mark.parametrize("text", ["[" * 100_000, "null", "{}", '{"@graph": 3}', '{"@graph": [3]}', "\0"])
@pytest.mark.parametrize("name", ["ro-crate-metadata.json", "capture/manifest-sha256.txt", MANIFEST])
def test_absurd_texts_are_damage_not_crashes(crate, name, text):
    (crate / name).write_text(text)
    if name != MANIFEST:
        reseal(crate)
    assert "damaged" in kinds(crate)


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
    with pytest.raises(UserError, match="exists already"):
        packed(scene, tmp_path / "crate")
    path = scene[0].artifacts[-1].path("values.bin")
    sound = path.read_bytes()
    path.write_bytes(bytes(len(sound)))
    try:
        with pytest.raises(UserError, match="not what was recorded"):
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
    assert entities["#object"]["description"] == "Kind of object: panel. Kept by: Museum of Works"
    assert entities["capture/"]["identifier"] == f"sha256:{scene[0].capture_digest}"
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
    bare = PackedScene(**{**scene[0].__dict__, "about": dict.fromkeys(ABOUT)})
    packed((bare, scene[1]), tmp_path / "crate")
    assert audit(tmp_path / "crate")[0] == []
    described = (tmp_path / "crate/ro-crate-metadata.json").read_text()
    assert "No rights are stated" in described
    assert "#creator" not in described


def test_the_command_audits_crates_among_other_folders(crate, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["verify", str(crate)])
    assert ended.value.code == 0
    assert "8 results from capture" in capsys.readouterr().out
    (crate / "README.md").write_text("x")
    with pytest.raises(SystemExit) as ended:
        main(["verify", "--json", str(crate.parent)])
    assert ended.value.code == 1
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert lines[0]["path"] == str(crate / "README.md")
    assert [line.get("problems") for line in lines[1:]] == [1]
    assert Path(lines[1]["root"]) == crate


@pytest.mark.parametrize("place", ["results/crate", "results/scene/crate", "capture/crate", "capture/data/a/b"])
def test_no_crate_is_made_inside_results_or_a_sealed_capture(tmp_path, place):
    (tmp_path / "capture/data").mkdir(parents=True)
    (tmp_path / "capture/bagit.txt").write_text("BagIt-Version: 1.0\n")
    with pytest.raises(UserError, match=r"inside the .*Remedy: another folder"):
        expect_outside(tmp_path / place, tmp_path / "results")
    expect_outside(tmp_path / "crates" / place, tmp_path / "results")
