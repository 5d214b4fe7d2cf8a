"""A packed scene is audited where nothing else is: damage, deceit and hostile files are named, and none is followed."""

import hashlib
import json
import os
import shutil
import stat
import zipfile
from pathlib import Path

import pytest
from crates import audit, packed, scene_to_pack

from nishiki.archive.crate import MANIFEST, manifest_text
from nishiki.archive.pack import write_zip
from nishiki.artifacts.artifact import MANIFEST as ARTIFACT
from nishiki.artifacts.artifact import run_text
from nishiki.artifacts.provenance import file_digest
from nishiki.cli import main


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The crate of a scene."""
    target = tmp_path_factory.mktemp("made") / "crate"
    packed(scene_to_pack(tmp_path_factory.mktemp("pack")), target)
    return target


@pytest.fixture
def crate(made, tmp_path):
    """A copy of it to be spoiled."""
    return shutil.copytree(made, tmp_path / "crate")


def kinds(path):
    return {damage.kind for damage in audit(path)[0]}


def reseal(crate):
    """Another manifest that fits the files, as one would write it who wants to deceive."""
    names = [str(path.relative_to(crate)) for path in crate.rglob("*") if path.is_file() and not path.is_symlink()]
    digests = {name: file_digest(crate / name) for name in names if name != MANIFEST}
    (crate / MANIFEST).write_text(manifest_text(digests))


@pytest.mark.slow
def test_a_flipped_bit_is_found_in_every_file(crate):
    files = {str(path.relative_to(crate)): path.read_bytes() for path in crate.rglob("*") if path.is_file()}
    for name, sound in files.items():
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
    with pytest.warns(UserWarning, match="README"):
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


def test_the_command_audits_crates_among_other_folders(crate, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["verify", str(crate)])
    assert ended.value.code == 0
    assert "8 results" in capsys.readouterr().out
    (crate / "README.md").write_text("x")
    with pytest.raises(SystemExit) as ended:
        main(["verify", "--json", str(crate.parent)])
    assert ended.value.code == 1
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert lines[0]["path"] == str(crate / "README.md")
    assert [line.get("problems") for line in lines[1:]] == [1]
    assert Path(lines[1]["root"]) == crate
