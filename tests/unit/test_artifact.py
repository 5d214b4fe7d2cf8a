"""The artifact contract: whole or not at all, and every damage named."""

import json
import os

import pytest

from nishiki.artifact import MANIFEST, ArtifactWriter, open_artifact, verify_artifact
from nishiki.errors import UserError

KEY = "0123456789ab"


def write(target, content=b"data", code="c1"):
    with ArtifactWriter(target) as output:
        output.path("sub/values.bin").write_bytes(content)
        output.path("empty.bin").write_bytes(b"")
        manifest = {"scene": "s", "stage": "normals", "key": target.name, "settings": {}, "upstream": {}, "code": code}
        return output.finish({**manifest, "diagnostics": {}}, {"seconds": 1.0})


@pytest.fixture
def target(tmp_path):
    return tmp_path / "results" / "s" / "normals" / KEY


def test_a_finished_artifact_is_sound_and_readable(target):
    write(target)
    assert verify_artifact(target) == []
    assert open_artifact(target / MANIFEST).path("sub/values.bin").read_bytes() == b"data"


def test_the_same_content_gives_the_same_manifest(target, tmp_path):
    first = write(target).digest
    second = write(tmp_path / "other" / KEY).digest
    assert first == second


def test_run_facts_are_no_part_of_the_digest(target):
    before = write(target).digest
    (target / "run.json").write_text("{}")
    assert verify_artifact(target) == []
    assert open_artifact(target).digest == before


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
    assert [damage.kind for damage in verify_artifact(moved)] == ["damaged"]


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
    dead = target.parent / f".{KEY}.999999999.partial"
    living = target.parent / f".{KEY}.{os.getppid()}.partial"
    dead.mkdir()
    living.mkdir()
    write(target)
    assert not dead.exists()
    assert living.exists()


def test_manifest_lists_bytes_and_digests(target):
    write(target)
    files = json.loads((target / MANIFEST).read_text())["files"]
    assert files["sub/values.bin"]["bytes"] == 4
    assert files["empty.bin"]["sha256"] == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"


def test_opening_finds_swapped_chunks_by_their_checksums_and_other_files_by_their_digests(target):
    with ArtifactWriter(target) as output:
        for name in ("a.zarr/c/0", "a.zarr/c/1", "a.zarr/zarr.json", "notes.json"):
            output.path(name).write_bytes(name.encode().rjust(20)[::-1] + name[-3:].encode())
        described = {"scene": "s", "stage": "normals", "key": KEY, "settings": {}, "upstream": {}, "diagnostics": {}}
        output.finish(described, {})
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
