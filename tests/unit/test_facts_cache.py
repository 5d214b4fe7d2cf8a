"""Remembered facts: the same as read ones, and never those of a file that changed since."""

import json
import os
from types import SimpleNamespace

import pytest
from captures import make_capture, make_turntable
from goniometer_captures import make_goniometer

from nishiki.capture.seal import seal
from nishiki.engine import facts as engine_facts
from nishiki.engine.facts import FOLDER, remembered_facts, scene_facts
from nishiki.errors import UserError

MAKERS = {"plane": make_capture, "turntable": make_turntable, "goniometer": make_goniometer}


@pytest.fixture(params=MAKERS)
def scene(request, tmp_path):
    capture = MAKERS[request.param](tmp_path / "capture")
    seal(capture)
    return SimpleNamespace(name="x", capture=capture, truth=None)


@pytest.fixture
def reads(monkeypatch):
    """How often a capture was read."""
    count = []
    monkeypatch.setattr(engine_facts, "scene_facts", lambda scene: count.append(scene.name) or scene_facts(scene))
    return count


def test_the_second_time_nothing_is_read_and_the_facts_are_equal(scene, reads, tmp_path):
    read = scene_facts(scene)
    assert [remembered_facts(scene, tmp_path) for _ in range(3)] == [read] * 3
    assert len(reads) == 1


def test_every_changed_file_is_noticed(scene, reads, tmp_path):
    remembered_facts(scene, tmp_path)
    files = sorted(path for path in scene.capture.rglob("*") if path.is_file())
    for path in files[:: max(1, len(files) // 10)]:
        data, times = path.read_bytes(), path.stat()
        path.write_bytes(data)  # the same size, and the time of modification put back
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
        reads.clear()
        remembered_facts(scene, tmp_path)
        assert reads, path
    (scene.capture / "another.txt").write_text("")
    reads.clear()
    remembered_facts(scene, tmp_path)
    assert reads


def test_a_truth_is_part_of_what_is_remembered(scene, reads, tmp_path):
    truth = tmp_path / "truth"
    truth.mkdir()
    (truth / "a.txt").write_text("1")
    with_truth = SimpleNamespace(**{**vars(scene), "truth": truth})
    first = [remembered_facts(one, tmp_path).truth_sha256 for one in (scene, with_truth, scene, with_truth)]
    assert first[0] == first[2] == ""
    assert first[1] == first[3] != ""
    assert len(reads) == 2
    (truth / "a.txt").write_text("2")
    assert remembered_facts(with_truth, tmp_path).truth_sha256 != first[1]


def test_a_torn_or_foreign_file_of_the_cache_is_read_over(scene, reads, tmp_path):
    facts = remembered_facts(scene, tmp_path)
    (path,) = (tmp_path / FOLDER).iterdir()
    whole = path.read_text()
    entries = json.loads(whole)
    for torn in ("", whole[:-20], "[]", "3", {**entries, "new": 1}, {"signature": entries["signature"]}):
        path.write_text(torn if isinstance(torn, str) else json.dumps(torn))
        assert remembered_facts(scene, tmp_path) == facts


def test_another_program_reads_afresh(scene, reads, tmp_path, monkeypatch):
    remembered_facts(scene, tmp_path)
    monkeypatch.setattr(engine_facts, "_source", lambda: "another")
    remembered_facts(scene, tmp_path)
    assert len(reads) == 2


def test_results_that_cannot_be_written_do_no_harm(scene, tmp_path):
    (tmp_path / "results").write_text("a file")
    assert remembered_facts(scene, tmp_path / "results") == scene_facts(scene)


def test_errors_are_not_remembered(tmp_path):
    scene = SimpleNamespace(name="x", capture=tmp_path / "none", truth=None)
    for _ in range(2):
        with pytest.raises(UserError, match="x"):
            remembered_facts(scene, tmp_path)
