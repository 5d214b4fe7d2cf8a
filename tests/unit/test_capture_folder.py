"""Capture folders: what is read, what the schema says, seals and digests."""

import hashlib
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from captures import edit_text, edit_yaml, make_capture
from conftest import PROJECT
from refusals import refused

from nishiki.capture.folder import load_capture
from nishiki.capture.seal import capture_digest, read_manifest, seal, sha256_of, verify_seal
from nishiki.capture.tables import read_curves
from nishiki.formats.problems import CaptureError
from nishiki.observations.check import check_capture


def test_a_valid_capture_is_read(tmp_path):
    capture = load_capture(make_capture(tmp_path / "c"))
    assert [f.role for f in capture.observed] == ["sample"] * 4 + ["check"]
    assert capture.directions.shape == (5, 3)
    assert capture.white_of("L02").file == "white/L02.png"
    assert len(capture.frames_of("dark")) == 1
    assert not capture.sealed
    assert capture.warnings == ()
    assert check_capture(tmp_path / "c", level="full") == []


def test_lights_may_be_named_by_file_stem_or_photograph(tmp_path):
    folder = make_capture(tmp_path / "c")
    edit_text(folder / "frames.csv", "sample,L02", "sample,L02.png")
    capture = load_capture(folder)
    assert capture.lights.index(capture.observed[1].light) == 1


def test_yaml_details(tmp_path):
    folder = make_capture(tmp_path / "c")
    text = (folder / "capture.yaml").read_text()
    extra = "date: 2024-05-01\nobject_id: 1234\nobject_made: 1642\nobject_holder: Museum\n"
    extra += "illuminant: D65\nwhite: {reflectance: 0.98, normal: [0, 0, 2]}\n"
    (folder / "capture.yaml").write_text("\ufeff" + text + extra)
    capture = load_capture(folder)
    assert capture.settings.date == "2024-05-01"
    assert capture.settings.object_id == "1234"
    assert (capture.settings.object_made, capture.settings.object_holder) == ("1642", "Museum")
    assert capture.illuminant == "D65"
    assert capture.settings.white.normal == (0, 0, 1)


@pytest.mark.parametrize("text", ["0755", "00123", "17.5", "yes", "12:30", "1_23", "1642-5-1", "0x10"])
@pytest.mark.parametrize("key", ["title", "object_id", "object_made"])
def test_texts_on_the_object_are_taken_as_they_stand(tmp_path, key, text):
    folder = make_capture(tmp_path / "c")
    edit_yaml(folder, title=None)
    content = (folder / "capture.yaml").read_text()
    (folder / "capture.yaml").write_text(content + f"{key}: {text}\n")
    assert getattr(load_capture(folder).settings, key) == text
    (folder / "capture.yaml").write_text(content + "object_id:\n")
    assert load_capture(folder).settings.object_id is None


def test_spectra_are_read_in_the_order_of_the_channels(tmp_path):
    folder = make_capture(tmp_path / "c")
    (folder / "spectra").mkdir()
    rows = [f"{w},{w / 1000},0.5,{(1000 - w) / 1000}" for w in range(380, 740, 10)]
    (folder / "spectra/camera.csv").write_text("wavelength_nm,blue,green,red\n# by hand\n" + "\n".join(rows) + "\n")
    settings = load_capture(folder).settings.camera.model_dump(exclude_none=True)
    edit_yaml(folder, camera={**settings, "channels": ["red", "green", "blue"], "sensitivities": "spectra/camera.csv"})
    curves = load_capture(folder).sensitivities
    assert curves.names == ("red", "green", "blue")
    np.testing.assert_allclose(curves.values[0], [0.62, 0.5, 0.38])
    assert curves.wavelengths_nm[0] == 380


def test_every_error_of_a_folder_is_reported_at_once(tmp_path):
    folder = make_capture(tmp_path / "c")
    edit_yaml(folder, tilte="x", mask="nowhere.png")
    edit_text(folder / "frames.csv", "check,L05", "chek,L05")
    edit_text(folder / "lights.lp", "5\n", "6\n")
    with pytest.raises(CaptureError) as caught:
        load_capture(folder)
    kinds = {p.kind for p in caught.value.problems}
    assert kinds == {"unknown-key", "role-unknown"}
    edit_yaml(folder, tilte=None)
    with pytest.raises(CaptureError) as caught:
        load_capture(folder)
    assert {p.kind for p in caught.value.problems} == {"image-missing", "role-unknown", "lights-count"}
    assert "also:" in str(caught.value)


def test_sealing_keeps_the_digest_and_every_byte(tmp_path):
    folder = make_capture(tmp_path / "c")
    before = {p.relative_to(folder).as_posix(): sha256_of(p) for p in folder.rglob("*") if p.is_file()}
    unsealed = capture_digest(folder)
    assert seal(folder) == unsealed == capture_digest(folder)
    after = {
        p.relative_to(folder / "data").as_posix(): sha256_of(p) for p in (folder / "data").rglob("*") if p.is_file()
    }
    assert after == before
    assert verify_seal(folder) == []
    assert check_capture(folder, level="full") == []
    assert load_capture(folder).sealed
    expected = "".join(f"{before[n]}  data/{n}\n" for n in sorted(before))
    assert (folder / "manifest-sha256.txt").read_text() == expected
    assert hashlib.sha256(expected.encode()).hexdigest() == unsealed
    assert (folder / "bagit.txt").read_text() == "BagIt-Version: 1.0\nTag-File-Character-Encoding: UTF-8\n"
    size = sum(p.stat().st_size for p in (folder / "data").rglob("*") if p.is_file())
    assert f"Payload-Oxum: {size}.{len(before)}" in (folder / "bag-info.txt").read_text()
    tags = read_manifest(folder / "tagmanifest-sha256.txt")
    assert set(tags) == {"bagit.txt", "bag-info.txt", "manifest-sha256.txt"}
    with refused(CaptureError, kind="seal-done"):
        seal(folder)


def test_a_folder_with_data_inside_is_sealed_in_place(tmp_path):
    make_capture(tmp_path / "c" / "data")
    digest = capture_digest(tmp_path / "c")
    assert seal(tmp_path / "c") == digest
    assert verify_seal(tmp_path / "c") == []


def test_a_link_to_a_folder_leads_to_the_sealed_capture(tmp_path):
    folder = make_capture(tmp_path / "disk" / "c")
    digest = capture_digest(folder)
    link = tmp_path / "captures"
    link.symlink_to("disk/c")
    assert seal(link) == digest == capture_digest(link)
    assert link.readlink().as_posix() == "disk/c"
    assert verify_seal(link) == []
    assert load_capture(folder).sealed
    assert sorted(path.name for path in folder.parent.iterdir()) == ["c"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["captures", "disk"]


def test_odd_names_survive_the_manifest(tmp_path):
    folder = make_capture(tmp_path / "c")
    for name in ("a b.txt", "100%.txt", "two\nlines.txt", "ä.txt", "%0A.txt"):
        (folder / name).write_text(name)
    seal(folder)
    assert verify_seal(folder) == []


KILL = """
import os, sys
from pathlib import Path
from nishiki.capture import seal
step, count = int(sys.argv[2]), 0
def dying(call):
    def wrapped(*args, **kwargs):
        global count
        count += 1
        if count == step:
            os._exit(9)
        return call(*args, **kwargs)
    return wrapped
for name in ("rename", "replace", "open", "fsync"):
    setattr(seal.os, name, dying(getattr(os, name)))
Path.mkdir, Path.open = dying(Path.mkdir), dying(Path.open)
seal.seal(Path(sys.argv[1]))
"""


@pytest.mark.slow
def test_killed_at_any_step_nothing_is_lost_and_sealing_again_finishes(tmp_path):
    original = make_capture(tmp_path / "original", lights=[(0, 0, 1), (0.5, 0, 0.8), (0, 0.5, 0.8)], checks=0)
    digest = capture_digest(original)
    environment = os.environ | {"PYTHONPATH": str(PROJECT / "workflow" / "src")}
    program = "\n".join(
        [
            "import sys, os, shutil",
            "from pathlib import Path",
            f"KILL = {KILL!r}",
            "for step in range(1, 200):",
            "    folder = Path(sys.argv[1]) / str(step)",
            "    shutil.copytree(sys.argv[2], folder)",
            "    pid = os.fork()",
            "    if pid == 0:",
            "        sys.argv = ['x', str(folder), str(step)]",
            "        try:",
            "            exec(compile(KILL, 'kill', 'exec'), {'__name__': 'kill'})",
            "        finally:",
            "            os._exit(0)",
            "    if os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0:",
            "        break",
        ]
    )
    work = tmp_path / "work"
    work.mkdir()
    subprocess.run([sys.executable, "-c", program, str(work), str(original)], check=True, env=environment)
    steps = sorted({int(p.name.split(".")[0]) for p in work.iterdir()})
    assert len(steps) > 20
    for step in steps:
        folder = work / str(step)
        if not (folder / "bagit.txt").is_file():
            assert seal(folder) == digest, f"killed at step {step}"
        assert verify_seal(folder) == [], f"killed at step {step}"
        assert capture_digest(folder) == digest
        assert not folder.with_name(f"{step}.sealing").exists()


def test_sealing_does_not_touch_a_strange_folder_in_its_way(tmp_path):
    folder = make_capture(tmp_path / "c")
    (tmp_path / "c.sealing").mkdir()
    (tmp_path / "c.sealing" / "treasure.txt").write_text("gold")
    with pytest.raises(CaptureError) as caught:
        seal(folder)
    assert caught.value.problems[0].kind == "seal-occupied"
    assert (tmp_path / "c.sealing" / "treasure.txt").read_text() == "gold"


def test_moving_a_capture_does_not_change_it(tmp_path):
    folder = make_capture(tmp_path / "c")
    digest = capture_digest(folder)
    shutil.move(folder, tmp_path / "d")
    assert capture_digest(tmp_path / "d") == digest


def test_curves_may_be_wanted_in_part(tmp_path):
    path = tmp_path / "lamp.csv"
    path.write_text("wavelength_nm,power\n400,1\n700,2\n")
    assert read_curves(path).names == ("power",)
    with pytest.raises(CaptureError) as caught:
        read_curves(path, names=("red",))
    assert caught.value.problems[0].kind == "spectra-columns"
