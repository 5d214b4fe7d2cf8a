"""Auditing an archive: every kind of damage is named, nothing outside is read, links are not followed."""

import errno
import json
import os
import shutil

import pytest
from archives import write_archive, write_artifact, write_scene
from refusals import expect_facts

from nishiki.archive.audit import KINDS, Counts, Damage, References, audit, check_publication, find_artifacts
from nishiki.artifacts.artifact import MANIFEST, open_artifact, run_text
from nishiki.cli import main


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    results = tmp_path_factory.mktemp("archive") / "results"
    write_archive(results, 2, flush=False)
    return results


@pytest.fixture
def results(made, tmp_path):
    return shutil.copytree(made, tmp_path / "results", symlinks=True)


def problems(*folders, threads=2):
    counts = Counts()
    return list(audit(find_artifacts(folders), counts, threads=threads, tell=lambda *_: None)), counts


def folder_of(results, stage, scene="scene-00000"):
    return next(path for path in (results / scene / stage).iterdir() if "." not in path.name)


def rewrite(folder, **changes):
    """Another manifest that its run.json vouches for, as one would have it who wants to deceive."""
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest.update(changes)
    data = json.dumps(manifest).encode()
    (folder / MANIFEST).write_bytes(data)
    (folder / "run.json").write_text(run_text({}, data))


def test_a_sound_archive_is_sound_and_counted(results):
    found, counts = problems(results)
    assert found == []
    assert (counts.artifacts, counts.files, counts.bytes) == (16, 80, 80 * 400)


@pytest.mark.parametrize("level", ["results", "scene", "stage", "artifact"])
def test_any_level_can_be_verified(results, level):
    artifact = folder_of(results, "normals")
    folder = {"results": results, "scene": artifact.parents[1], "stage": artifact.parent, "artifact": artifact}[level]
    (artifact / "values.bin").write_bytes(b"")
    found, counts = problems(folder)
    assert [damage.path for damage in found] == [artifact / "values.bin"]
    assert counts.artifacts == {"results": 16, "scene": 8, "stage": 1, "artifact": 1}[level]


def damage(folder):
    path = folder / "summary.json"
    path.write_bytes(path.read_bytes()[:-1] + b"\0")


def swap(folder):
    first, second = (folder / "maps.zarr/values/c/0" / name for name in "01")
    a, b = first.read_bytes(), second.read_bytes()
    first.write_bytes(b)
    second.write_bytes(a)


def replace_by_link(folder):
    path = folder / "values.bin"
    shutil.copy(path, folder.parents[3] / "same")
    path.unlink()
    path.symlink_to(folder.parents[3] / "same")


def replace_folder_by_link(folder):
    shutil.move(folder / "maps.zarr", folder.parents[3] / "moved.zarr")
    (folder / "maps.zarr").symlink_to(folder.parents[3] / "moved.zarr")


def replace_by_pipe(folder):
    (folder / "values.bin").unlink()
    os.mkfifo(folder / "values.bin")


SPOILED = {
    "content": (damage, {"damaged": ["summary.json"]}),
    "swapped": (swap, {"damaged": ["maps.zarr/values/c/0/0", "maps.zarr/values/c/0/1"]}),
    "lost": (lambda folder: (folder / "values.bin").unlink(), {"missing": ["values.bin"]}),
    "foreign": (lambda folder: (folder / "notes.txt").touch(), {"foreign": ["notes.txt"]}),
    "link": (replace_by_link, {"link": ["values.bin"]}),
    "linked folder": (
        replace_folder_by_link,
        {"link": ["maps.zarr"], "missing": [f"maps.zarr/{n}" for n in ("zarr.json", "values/c/0/0", "values/c/0/1")]},
    ),
    "pipe": (replace_by_pipe, {"foreign": ["values.bin"], "missing": ["values.bin"]}),
    "settings": (lambda folder: rewrite(folder, settings={"method": "other"}), {"wrong-key": [MANIFEST]}),
    "stage": (lambda folder: rewrite(folder, stage="height"), {"wrong-key": [MANIFEST], "misplaced": [""]}),
    "scene": (lambda folder: rewrite(folder, scene="other"), {"misplaced": [""]}),
    "no capture": (lambda folder: rewrite(folder, upstream={}), {"damaged": [MANIFEST], "wrong-key": [MANIFEST]}),
    "no run.json": (lambda folder: (folder / "run.json").unlink(), {"missing": ["run.json"]}),
    "run.json": (lambda folder: (folder / "run.json").write_text("{}"), {"damaged": ["run.json"]}),
    "manifest is a link": (
        lambda folder: ((folder / MANIFEST).rename(folder / "x"), (folder / MANIFEST).symlink_to("x")),
        {"link": [MANIFEST], "missing": [""]},
    ),
}


@pytest.mark.parametrize("name", SPOILED)
def test_each_damage_is_named_at_its_artifact(results, name):
    spoil, expected = SPOILED[name]
    folder = folder_of(results, "report")
    before = (folder / MANIFEST).read_bytes()
    spoil(folder)
    found, counts = problems(results)
    here = [item for item in found if item.path == folder or folder in item.path.parents]
    named = {kind: sorted(i.path.relative_to(folder).as_posix() for i in here if i.kind == kind) for kind in KINDS}
    expected = {kind: sorted(name or "." for name in names) for kind, names in expected.items()}
    assert {kind: names for kind, names in named.items() if names} == expected
    # The folder of published links knows the digest of the manifest: another one is told there as well.
    same = (folder / MANIFEST).read_bytes() == before and not (folder / MANIFEST).is_symlink()
    assert (len(found) > len(here)) == (
        not same and folder not in {item.path for item in here if item.kind == "missing"}
    )
    assert counts.problems == len(found)


def test_the_upstream_made_again_and_the_upstream_lost(results):
    scene = results / "scene-00000"
    ingest = open_artifact(folder_of(results, "ingest"))
    again = write_artifact(
        scene,
        "ingest",
        {},
        settings=ingest.settings,
        capture=ingest.manifest["upstream"]["capture"]["digest"],
        salt="x",
    )
    assert again.key == ingest.key
    stale = {damage.path.parent.name for damage in problems(results)[0] if damage.kind == "stale"}
    assert stale == {"separate", "normals", "spectra", "brdf", "report", "current"}
    shutil.rmtree(folder_of(results, "height"))
    lost = [damage for damage in problems(results)[0] if damage.kind == "missing"]
    assert any(damage.path.parent.name == "height" for damage in lost)


def test_a_superseded_artifact_is_audited_too(results):
    scene = results / "scene-00000"
    report = folder_of(results, "report")
    upstream = {stage: open_artifact(folder_of(results, stage)) for stage in ("ingest", "normals", "render")}
    write_artifact(scene, "report", upstream, salt="x")
    (aside,) = report.parent.glob("*.superseded-*")
    assert {damage.path for damage in problems(results)[0]} == {scene / "current/index.json"}
    damage(aside)
    assert aside / "summary.json" in {found.path for found in problems(results)[0]}
    aside.rename(aside.with_name(f"{report.name}.superseded-{'0' * 8}"))
    assert "wrong-key" in {found.kind for found in problems(results)[0]}


@pytest.mark.parametrize("where", ["results", "scene", "stage"])
def test_a_link_in_place_of_a_folder_is_named_and_not_followed(results, tmp_path, where):
    stage = results / "scene-00001" / "report"
    folder = {"results": results / "scene-00001", "scene": stage, "stage": folder_of(results, "report", "scene-00001")}[
        where
    ]
    moved = tmp_path / "elsewhere"
    folder.rename(moved)
    for path in moved.rglob("values.bin"):
        path.write_bytes(b"changed: would be damage if it were read")
    folder.symlink_to(moved)
    found, _ = problems(results)
    assert "link" in {item.kind for item in found if item.path == folder}
    assert not any(item.kind == "damaged" for item in found)


def test_published_links_stay_in_their_scene(results):
    current = results / "scene-00000/current"
    (current / "report").unlink()
    (current / "report").symlink_to("/etc")
    (current / "values.bin").symlink_to("../../scene-00001/report")
    (current / "gone.png").symlink_to("../report/0123456789ab")
    kinds = {(item.kind, item.path.name) for item in problems(results)[0]}
    assert kinds == {("link", "report"), ("missing", "report"), ("link", "values.bin"), ("missing", "gone.png")}


def test_every_bit_flip_in_the_index_of_what_is_published_is_found(results):
    path = results / "scene-00000/current/index.json"
    references = References()
    sound = path.read_bytes()
    for bit in range(0, 8 * len(sound), 31):
        flipped = bytearray(sound)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        assert check_publication(path.parent, references), bit
    path.write_bytes(sound)
    assert check_publication(path.parent, references) == []


def test_what_cannot_be_read_is_named(results, monkeypatch):
    folder = folder_of(results, "report")
    opened = os.open

    def refuse(path, *arguments, **options):
        if str(path).endswith("report/" + folder.name + "/values.bin"):
            raise PermissionError(13, os.strerror(errno.EACCES))
        return opened(path, *arguments, **options)

    monkeypatch.setattr(os, "open", refuse)
    found, _ = problems(results)
    assert [(item.kind, item.path, item.detail) for item in found] == [
        ("unreadable", folder / "values.bin", os.strerror(errno.EACCES))
    ]


def test_the_order_does_not_depend_on_the_threads(results):
    for stage in ("ingest", "brdf", "report"):
        for scene in ("scene-00000", "scene-00001"):
            damage(folder_of(results, stage, scene))
    first = problems(results, threads=1)[0]
    assert len(first) == 6
    assert problems(results, threads=8)[0] == first


def test_deeply_nested_and_absurd_manifests_are_damage_not_crashes(results):
    for text in ("[" * 100_000, "1" * 5000, '{"format": 1}', "\ufeff{}", '{"format": NaN}', "null", ""):
        (folder_of(results, "report") / MANIFEST).write_text(text)
        assert "damaged" in {item.kind for item in problems(results)[0]}


def test_upstream_names_lead_nowhere_else(results):
    for stage, key in (("../../x", "0" * 12), ("normals", "../../../etc"), ("/etc", "0" * 12)):
        rewrite(folder_of(results, "report"), upstream={stage: {"key": key, "digest": "0" * 64}})
        assert any(stage in item.detail or key in item.detail for item in problems(results)[0])


def test_names_of_files_cannot_control_the_terminal(tmp_path):
    told = str(Damage(tmp_path / "a\n\x1b[2Jdone: sound\udcff", "foreign", "x\ry"))
    assert told.isprintable()
    assert told.isascii() or told.encode("utf-8")


def test_the_command_tells_each_problem_and_ends_with_status_1(results, capsys):
    folder = folder_of(results, "report")
    damage(folder)
    with pytest.raises(SystemExit) as ended:
        main(["verify", str(results)])
    told = capsys.readouterr().out.splitlines()
    assert ended.value.code == 1
    assert told[0].startswith(f"damaged: {folder / 'summary.json'} (sha256")
    expect_facts(told[-1], 16, 80, "0.000", 1)
    with pytest.raises(SystemExit) as ended:
        main(["verify", "--json", "--set-aside", str(results)])
    first, last = map(json.loads, capsys.readouterr().out.splitlines())
    path = str(folder / "summary.json")
    assert first == {"path": path, "kind": "damaged", "detail": first["detail"], "artifact": str(folder)}
    assert last["artifacts"] == 16
    assert last["problems"] == 1
    assert last["sound"] is False
    assert not folder.exists()
    (aside,) = folder.parent.iterdir()
    assert ".set-aside-" in aside.name


def test_unfinished_folders_are_counted_and_never_audited(results, capsys):
    (results / "scene-00000/report/.0123456789ab.host.1-1.partial").mkdir()
    (results / "sweeps/timings/scene-00000/report/0123456789ab").mkdir(parents=True)
    with pytest.raises(SystemExit) as ended:
        main(["verify", str(results)])
    assert ended.value.code == 0
    assert "1 unfinished" in capsys.readouterr().out


def test_a_scene_without_published_links_is_sound(tmp_path):
    write_scene(tmp_path / "results/alone", published=False)
    assert problems(tmp_path / "results")[0] == []
