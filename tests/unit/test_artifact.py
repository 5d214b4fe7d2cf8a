"""The artifact contract: whole or not at all, and every damage named."""

import json
import os
import weakref

import numpy as np
import pytest
from archives import verify_artifact
from refusals import refused

from nishiki.artifacts.artifact import MANIFEST, ArtifactWriter, open_artifact, run_text
from nishiki.artifacts.maps import MapWriter
from nishiki.artifacts.provenance import stage_key
from nishiki.artifacts.stage import problems
from nishiki.errors import UserError
from nishiki.formats.stored import BandedArray
from nishiki.processes import host, identity

CAPTURE = "5" * 64
KEY = stage_key("normals", 1, {}, {"capture": CAPTURE})
DESCRIBED = {
    "scene": "s",
    "stage": "normals",
    "key": KEY,
    "format_version": 1,
    "settings": {},
    "upstream": {"capture": {"digest": CAPTURE}},
    "diagnostics": {},
}


def write(target, content=b"data", code="c1"):
    with ArtifactWriter(target) as output:
        output.path("sub/values.bin").write_bytes(content)
        output.path("empty.bin").write_bytes(b"")
        return output.finish({**DESCRIBED, "code": code}, {"seconds": 1.0})


@pytest.fixture
def target(tmp_path):
    return tmp_path / "results" / "s" / "normals" / KEY


def test_maps_that_may_hold_nan_are_searched_chunk_by_chunk(tmp_path, monkeypatch):
    maps = MapWriter(tmp_path, rows=400, columns=8, band_rows=2, stamp={})
    errors = maps.create("errors", nan="outside of the truth")
    errors[...] = np.full((400, 8), np.nan)
    held, most, read = [], [], BandedArray.chunk

    def counted(array, place):
        values = read(array, place)
        held.append(weakref.ref(values))
        most.append(sum(each() is not None for each in held))
        return values

    monkeypatch.setattr(BandedArray, "chunk", counted)
    assert not any(problems(tmp_path))
    assert len(most) == 200
    assert max(most) < 100
    values = np.full((2, 8), np.nan)
    values[1, 7] = np.inf
    errors[20:22] = errors[398:400] = values
    (told,) = filter(None, problems(tmp_path))
    assert "2 infinite" in told
    assert "(21, 7)" in told


def test_a_finished_artifact_is_sound_and_readable(target):
    write(target)
    assert verify_artifact(target) == []
    assert open_artifact(target / MANIFEST).path("sub/values.bin").read_bytes() == b"data"


def test_the_same_content_gives_the_same_manifest(target, tmp_path):
    first = write(target).digest
    second = write(tmp_path / "other" / KEY).digest
    assert first == second


def test_run_facts_are_no_part_of_the_digest(target, tmp_path):
    before = write(target).digest
    path = target / "run.json"
    path.write_text(run_text({"seconds": 2.0}, (target / MANIFEST).read_bytes()))
    assert verify_artifact(target) == []
    assert open_artifact(target).digest == before
    path.unlink()
    assert open_artifact(target).run == {}
    assert [(damage.kind, damage.path) for damage in verify_artifact(target)] == [("missing", path)]


@pytest.mark.parametrize("name", [MANIFEST, "run.json"])
def test_every_bit_flip_in_the_manifest_and_beside_it_is_found(target, name):
    write(target)
    path = target / name
    sound = path.read_bytes()
    for bit in range(0, 8 * len(sound), 13):
        flipped = bytearray(sound)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        assert verify_artifact(target), bit
        if name == MANIFEST:
            with pytest.raises(UserError, match="Remedy"):
                open_artifact(target)
    path.write_bytes(sound)
    assert verify_artifact(target) == []


def test_a_manifest_beside_the_files_of_another_is_refused(target):
    write(target, content=b"old!")
    old = (target / MANIFEST).read_bytes()
    write(target, content=b"new!")
    (target / MANIFEST).write_bytes(old)
    with refused(UserError, "artifact.json"):
        open_artifact(target, contents=False)


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "a//b", "a/../../b", "", ".", "a/./b", "a\0b"])
def test_a_manifest_that_names_files_outside_is_refused(target, name):
    write(target)
    manifest = json.loads((target / MANIFEST).read_text())
    manifest["files"][name] = manifest["files"].pop("empty.bin")
    (target / MANIFEST).write_text(json.dumps(manifest))
    with refused(UserError, "artifact.json"):
        open_artifact(target)
    assert any("outside" in damage.detail for damage in verify_artifact(target))


@pytest.mark.parametrize(
    ("spoil", "kind", "name"),
    [
        (lambda folder: (folder / "sub/values.bin").write_bytes(b"dat4"), "damaged", "values.bin"),
        (lambda folder: (folder / "sub/values.bin").write_bytes(b"dat"), "damaged", "values.bin"),
        (lambda folder: (folder / "sub/values.bin").unlink(), "missing", "values.bin"),
        (lambda folder: (folder / "sub/new.bin").write_bytes(b""), "foreign", "new.bin"),
        (lambda folder: (folder / MANIFEST).unlink(), "missing", MANIFEST),
        (lambda folder: (folder / MANIFEST).write_text("{"), "damaged", MANIFEST),
        (lambda folder: (folder / MANIFEST).write_text("{}"), "damaged", MANIFEST),
    ],
)
def test_verify_names_each_damage(target, spoil, kind, name):
    write(target)
    spoil(target)
    (damage,) = verify_artifact(target)
    assert (damage.kind, damage.path.name) == (kind, name)


def test_every_single_bit_flip_is_found(target):
    write(target, content=bytes(range(64)))
    path = target / "sub/values.bin"
    sound = path.read_bytes()
    for bit in range(0, 512, 7):
        flipped = bytearray(sound)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        assert [damage.path for damage in verify_artifact(target)] == [path]
    path.write_bytes(sound)
    assert verify_artifact(target) == []


def test_an_artifact_under_another_key_is_damage(target):
    write(target)
    moved = target.with_name("f" * 12)
    target.rename(moved)
    assert [damage.kind for damage in verify_artifact(moved)] == ["wrong-key"]


@pytest.mark.parametrize("spoil", ["truncate", "unlink"])
def test_opening_refuses_missing_and_truncated_files_with_a_remedy(target, spoil):
    write(target)
    path = target / "sub/values.bin"
    path.unlink() if spoil == "unlink" else path.write_bytes(b"d")
    with pytest.raises(UserError, match=r"sub/values.bin.*Remedy"):
        open_artifact(target)


def test_an_exception_leaves_nothing_and_keeps_the_old(target):
    before = write(target).digest

    def fail():
        with ArtifactWriter(target) as output:
            output.path("half.bin").write_bytes(b"x")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert open_artifact(target).digest == before
    assert [path.name for path in target.parent.iterdir()] == [KEY]


def test_a_successor_keeps_the_superseded_one_intact(target):
    old = write(target, content=b"old!", code="c1").digest
    write(target, content=b"new!", code="c2")
    aside = target.with_name(f"{KEY}.superseded-{old[:8]}")
    assert open_artifact(aside).digest == old
    assert verify_artifact(aside) == []
    assert (target / "sub/values.bin").read_bytes() == b"new!"


def test_an_equal_successor_leaves_one(target):
    write(target)
    write(target)
    assert [path.name for path in target.parent.iterdir()] == [KEY]


def test_leftovers_of_a_dead_process_are_removed_and_those_of_a_living_one_kept(target):
    target.parent.mkdir(parents=True)
    parent = os.getppid()
    dead = [f"{host()}.999999999-5", "999999999", f"{host()}.{parent}-1", f"old.{host()}.999999999-5"]
    living = [f"{host()}.{identity(parent)}", str(parent), "another-host.999999999-5"]
    for name in (*dead, *living):
        (target.parent / f".{KEY}.{name}.partial").mkdir()
    write(target)
    assert {path.name for path in target.parent.glob(".*")} == {f".{KEY}.{name}.partial" for name in living}


def test_an_artifact_is_dated_no_earlier_than_what_it_was_made_from(target, tmp_path):
    upstream = tmp_path / "upstream.json"
    upstream.touch()
    os.utime(upstream, (4e9, 4e9))  # the clock was set back since
    with ArtifactWriter(target) as output:
        output.path("empty.bin").write_bytes(b"")
        output.finish(DESCRIBED, {}, inputs=[upstream])
    assert (target / MANIFEST).stat().st_mtime_ns == upstream.stat().st_mtime_ns
    write(target, content=b"new")
    assert (target / MANIFEST).stat().st_mtime < 4e9


def test_manifest_lists_bytes_and_digests(target):
    write(target)
    files = json.loads((target / MANIFEST).read_text())["files"]
    assert files["sub/values.bin"]["bytes"] == 4
    assert files["empty.bin"]["sha256"] == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"


def test_opening_finds_swapped_chunks_by_their_checksums_and_other_files_by_their_digests(target):
    with ArtifactWriter(target) as output:
        for name in ("a.zarr/c/0", "a.zarr/c/1", "a.zarr/zarr.json", "notes.json"):
            output.path(name).write_bytes(name.encode().rjust(20)[::-1] + name[-3:].encode())
        output.finish(DESCRIBED, {})
    open_artifact(target)
    first, second = (target / "a.zarr/c" / name for name in "01")
    swap(first, second)
    with pytest.raises(UserError, match=r"a.zarr/c/0 \(SHA-256 differs\)"):
        open_artifact(target)
    swap(first, second)
    for name in ("a.zarr/zarr.json", "notes.json"):
        path = target / name
        sound = path.read_bytes()
        path.write_bytes(b"x" + sound[1:])
        with pytest.raises(UserError, match=name):
            open_artifact(target)
        assert open_artifact(target, contents=False).path(name) == path
        path.write_bytes(sound)


def swap(first, second):
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)
