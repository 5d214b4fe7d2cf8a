"""Artifacts that a run must not build on are named, set aside whole, and only those."""

import os
import time

import pytest
from archives import verify_artifact

from nishiki.artifacts.artifact import MANIFEST, ArtifactWriter
from nishiki.artifacts.provenance import stage_key
from nishiki.engine.finished import set_aside_unsound, unsound_artifacts

CAPTURE = "5" * 64
READS = {"ingest": (), "normals": ("ingest",), "render": ("ingest", "normals")}
KEYS: dict[str, str] = {}
for name, reads in READS.items():
    KEYS[name] = stage_key(name, 1, {}, {other: KEYS[other] for other in reads} or {"capture": CAPTURE})


def write(folder, stage, content=b"values"):
    upstream = {name: {"key": KEYS[name], "digest": artifact_digest(folder, name)} for name in READS[stage]}
    with ArtifactWriter(folder / stage / KEYS[stage]) as output:
        output.path("values.bin").write_bytes(content)
        described = {"scene": "s", "stage": stage, "key": KEYS[stage], "settings": {}, "diagnostics": {}}
        upstream = upstream or {"capture": {"digest": CAPTURE}}
        output.finish({**described, "format_version": 1, "upstream": upstream}, {})


def artifact_digest(folder, name):
    from nishiki.artifacts.provenance import file_digest

    return file_digest(folder / name / KEYS[name] / MANIFEST)


@pytest.fixture
def scene(tmp_path):
    for stage in KEYS:
        write(tmp_path, stage)
    return tmp_path


def planned(folder):
    places = {stage: folder / stage / KEYS[stage] for stage in KEYS}
    return [(places[stage], {other: places[other] for other in READS[stage]}) for stage in KEYS]


def test_sound_artifacts_stay(scene):
    assert set_aside_unsound(planned(scene), pytest.fail) == []


@pytest.mark.parametrize("spoil", ["truncate", "unlink", "manifest", "no manifest"])
def test_a_torn_artifact_is_set_aside_whole_and_told(scene, spoil):
    folder = scene / "normals" / KEYS["normals"]
    if spoil == "truncate":
        (folder / "values.bin").write_bytes(b"va")
    elif spoil == "unlink":
        (folder / "values.bin").unlink()
    elif spoil == "manifest":
        (folder / MANIFEST).write_text("{")
    else:
        (folder / MANIFEST).unlink()
    before = {path.name for path in folder.iterdir()}
    told = []
    (found,) = set_aside_unsound(planned(scene), told.append)
    assert found.folder == folder
    assert not folder.exists()
    assert len(told) == 1
    assert str(folder) in told[0]
    (aside,) = (scene / "normals").iterdir()
    assert {path.name for path in aside.iterdir()} == before
    assert (scene / "render" / KEYS["render"]).exists()  # it is sound: made from what the next run makes again


def test_an_artifact_made_from_another_upstream_is_stale(scene):
    write(scene, "ingest", b"other!")  # same key, newer code: the old one is kept beside
    found = unsound_artifacts(planned(scene))
    assert [item.folder.parent.name for item in found] == ["normals", "render"]
    assert "ingest" in found[0].why


def test_two_of_one_content_are_kept_apart(scene):
    folder = scene / "ingest" / KEYS["ingest"]
    for _ in range(2):
        (folder / "values.bin").unlink()
        set_aside_unsound(planned(scene), str)
        write(scene, "ingest")
    names = sorted(path.name for path in (scene / "ingest").iterdir())
    assert len(names) == 3
    assert names[0] == KEYS["ingest"]
    assert names[2].endswith("-2")
    assert verify_artifact(folder) == []


def test_dates_follow_the_flow_and_never_lie_in_the_future(scene):
    times = {"ingest": 4.2e9, "normals": 1e9, "render": 1.1e9}
    for stage, seconds in times.items():
        os.utime(scene / stage / KEYS[stage] / MANIFEST, (seconds, seconds))
    assert set_aside_unsound(planned(scene), pytest.fail) == []
    dates = [(scene / stage / KEYS[stage] / MANIFEST).stat().st_mtime for stage in KEYS]
    assert dates == sorted(dates)
    assert dates[-1] <= time.time()
    os.utime(scene / "ingest" / KEYS["ingest"] / MANIFEST, (1e9, 1e9))
    set_aside_unsound(planned(scene), pytest.fail)
    assert [(scene / stage / KEYS[stage] / MANIFEST).stat().st_mtime for stage in KEYS] == [1e9, *dates[1:]]
