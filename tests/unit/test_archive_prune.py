"""Pruning: only what nothing references goes, only what is an artifact by contract, and whole."""

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from archives import write_artifact, write_scene
from refusals import refused

from nishiki.archive.prune import decide, remove
from nishiki.artifacts.artifact import open_artifact
from nishiki.cli import main
from nishiki.commands import archiving as command
from nishiki.processes import host, identity

SOURCE = Path(__file__).resolve().parents[2] / "workflow/src"


@pytest.fixture
def results(tmp_path):
    return tmp_path / "results"


def places(made):
    return {(item.manifest["scene"], stage, item.key) for stage, item in made.items()}


def names(items):
    return {(item.folder.parent.name, item.folder.name) for item in items}


def everything(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_what_a_configuration_asks_for_stays_and_the_rest_is_listed_downstream_first(results):
    before = write_scene(results / "a", normals={"method": "old"}, published=False)
    now = write_scene(results / "a")
    found = decide(results, places(now))
    changed = [stage for stage in now if before[stage].key != now[stage].key]
    assert [item.folder.parent.name for item in found.remove] == changed[::-1]
    assert {item.folder for item in found.remove} == {before[stage].folder for stage in changed}
    assert (found.keep, found.left_alone) == ([], [])
    assert all(
        item.bytes == sum(p.stat().st_size for p in item.folder.rglob("*") if p.is_file()) for item in found.remove
    )


def test_both_of_two_configurations_are_kept(results):
    first = write_scene(results / "a", normals={"method": "old"}, published=False)
    second = write_scene(results / "a")
    assert decide(results, places(first) | places(second)).remove == []


def test_upstream_artifacts_of_what_stays_are_kept_and_named(results):
    made = write_scene(results / "a", published=False)
    found = decide(results, {("a", "report", made["report"].key)})
    assert found.remove == []
    assert {item.folder.parent.name for item in found.keep} == set(made) - {"report"}
    assert all(item.why for item in found.keep)


def test_the_superseded_artifact_that_another_was_made_from_is_kept(results):
    made = write_scene(results / "a", published=False)
    old = made["ingest"].digest
    capture = made["ingest"].manifest["upstream"]["capture"]["digest"]
    write_artifact(results / "a", "ingest", {}, capture=capture, salt="newer code")
    again = write_artifact(
        results / "a", "report", {name: made[name] for name in ("ingest", "normals", "render")}, salt="x"
    )
    superseded = f"{made['ingest'].key}.superseded-{old[:8]}"
    found = decide(results, places(made))
    assert ("ingest", superseded) in names(found.keep)
    assert names(found.remove) == {("report", f"{again.key}.superseded-{item}") for item in superseded_of(again)}


def superseded_of(artifact):
    return [path.name.rpartition("-")[2] for path in artifact.folder.parent.glob("*.superseded-*")]


def test_what_is_published_is_kept_until_a_run_publishes_something_else(results):
    before = write_scene(results / "a")
    now = write_scene(results / "a", normals={"method": "new"}, published=False)
    found = decide(results, places(now))
    assert found.remove == []
    assert any("published" in item.why for item in found.keep)
    shutil.rmtree(results / "a/current")
    changed = {before[s].folder for s in before if before[s].key != now[s].key}
    assert {item.folder for item in decide(results, places(now)).remove} == changed


def test_scenes_that_no_configuration_names_are_kept_and_named_unless_asked_for(results):
    made = write_scene(results / "a")
    other = write_scene(results / "b")
    found = decide(results, places(made))
    assert found.remove == []
    assert [item.folder for item in found.keep] == [results / "b"]
    found = decide(results, places(made), unnamed=True)
    assert {item.folder for item in found.remove} == {item.folder for item in other.values()} | {results / "b/current"}


def test_unfinished_and_set_aside_folders(results):
    made = write_scene(results / "a")
    stage = results / "a/report"
    key = made["report"].key
    gone = [f".{key}.{host()}.999999999-1.partial", f".{key}.old.{host()}.999999999-1.partial", f"{key}.set-aside-torn"]
    gone += [f"{key}.set-aside-01234567-2", f".{key}.elsewhere.1-1.pruned"]
    kept = [f".{key}.{host()}.{identity()}.partial", f".{key}.elsewhere.1-1.partial"]
    for name in (*gone, *kept):
        (stage / name).mkdir()
    (results / f"a/.current.{host()}.999999999-1.partial").mkdir()
    found = decide(results, places(made))
    assert names(found.remove) == {("report", name) for name in gone} | {
        ("a", f".current.{host()}.999999999-1.partial")
    }
    assert names(found.keep) == {("report", name) for name in kept}
    assert ("report", kept[1]) in names(decide(results, places(made), hosts=["elsewhere"]).remove)


def spoil_foreign(folder):
    (folder / "my notes.txt").write_text("x")


def spoil_link(folder):
    (folder / "link").symlink_to("/")


def spoil_manifest(folder):
    (folder / "artifact.json").write_text("{")


def spoil_stage(folder):
    target = folder.parents[1] / "brdf" / folder.name
    folder.rename(target)
    return target


@pytest.mark.parametrize("spoil", [spoil_foreign, spoil_link, spoil_manifest, spoil_stage])
def test_what_is_no_artifact_by_contract_is_left_alone_and_named(results, spoil):
    made = write_scene(results / "a")
    old = write_artifact(results / "a", "report", {"ingest": made["ingest"]}, settings={"method": "old"}).folder
    old = spoil(old) or old
    found = decide(results, places(made))
    assert found.remove == []
    assert [item.folder for item in found.left_alone] == [old]


def test_other_folders_and_links_are_left_alone(results, tmp_path):
    made = write_scene(results / "a")
    for name in ("notes", "normals/my-copy", "normals/0123456789ab-copy"):
        (results / "a" / name).mkdir()
    elsewhere = write_scene(tmp_path / "elsewhere/a", normals={"method": "old"})
    (results / "a/normals/0123456789ab").symlink_to(elsewhere["normals"].folder)
    (results / "linked").symlink_to(tmp_path / "elsewhere/a")
    found = decide(results, places(made), unnamed=True)
    assert found.remove == []
    assert names(found.left_alone) == {
        *(("normals", name) for name in ("my-copy", "0123456789ab-copy", "0123456789ab")),
        ("a", "notes"),
        ("results", "linked"),
    }


def test_removal_follows_no_link_and_leaves_what_stays_as_it_was(results, tmp_path):
    made = write_scene(results / "a")
    old = write_artifact(results / "a", "report", {"ingest": made["ingest"]}, settings={"method": "old"})
    aside = old.folder.with_name(f"{old.key}.set-aside-torn")
    old.folder.rename(aside)
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "kept.txt").write_text("kept")
    (aside / "link").symlink_to(outside)
    expected = [name for name in everything(results) if ".set-aside-" not in name]
    found = decide(results, places(made))
    total, failed = remove(found.remove, lambda item: None)
    assert failed == []
    assert total == sum(item.bytes for item in found.remove) > 0
    assert everything(results) == expected
    assert (outside / "kept.txt").read_text() == "kept"
    assert decide(results, places(made)).remove == []


def test_empty_folders_go_with_their_last_artifact(results):
    made = write_scene(results / "a")
    write_scene(results / "b")
    remove(decide(results, places(made), unnamed=True).remove, lambda item: None)
    assert [path.name for path in results.iterdir()] == ["a"]


def test_what_cannot_be_removed_is_told_and_the_rest_is_removed(results, monkeypatch):
    made = write_scene(results / "a")
    write_scene(results / "b", published=False)
    found = decide(results, places(made), unnamed=True)
    renamed = os.rename

    def refuse(source, target):
        if "brdf" in str(source):
            raise PermissionError(13, "Permission denied")
        return renamed(source, target)

    monkeypatch.setattr(os, "rename", refuse)
    _, failed = remove(found.remove, lambda item: None)
    assert [(folder.parent.name, why) for folder, why in failed] == [("brdf", os.strerror(errno.EACCES))]
    assert [path.name for path in (results / "b").iterdir()] == ["brdf"]


KILLED = """
import os, shutil, sys
from pathlib import Path
from nishiki.archive.prune import decide
from nishiki.archive.prune import remove
left = int(sys.argv[2])
unlink, rmdir, rename = os.unlink, os.rmdir, os.rename
def counted(call):
    def wrapped(*arguments, **options):
        global left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), 9)
        return call(*arguments, **options)
    return wrapped
os.unlink, os.rmdir, os.rename = map(counted, (unlink, rmdir, rename))
remove(decide(Path(sys.argv[1]), {("a", "ingest", "0" * 12)}).remove, lambda item: None)
"""


@pytest.mark.slow
@pytest.mark.parametrize("steps", [0, 1, 2, 5, 9, 14, 20])
def test_killed_in_the_middle_every_artifact_is_whole_or_gone(results, steps):
    made = write_scene(results / "a", published=False)
    write_scene(results / "a", published=False, normals={"method": "old"})
    script = KILLED
    environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
    done = subprocess.run([sys.executable, "-c", script, str(results), str(steps)], env=environment, check=False)
    assert done.returncode == -9
    standing = [path for path in results.glob("a/*/*") if not path.name.startswith(".")]
    for folder in standing:
        open_artifact(folder)
    left = [stage for stage in made if list((results / "a" / stage).glob("[0-9a-f]*"))]
    for folder in standing:
        upstream = open_artifact(folder).manifest["upstream"]
        assert all(
            (results / "a" / stage / entry["key"]).is_dir() for stage, entry in upstream.items() if "key" in entry
        )
    assert left == list(made)[: len(left)]  # from the end of the chain
    found = decide(results, {("a", "ingest", "0" * 12)})
    remove(found.remove, lambda item: None)
    assert not list(results.glob("a/*/*"))


def told(monkeypatch, capsys, results, planned, *arguments, sweeps=()):
    monkeypatch.setattr(command, "_list_references", lambda *given: [(results, set(planned), set(sweeps))])
    with pytest.raises(SystemExit) as ended:
        main(["prune", *arguments])
    output = capsys.readouterr()
    return ended.value.code, output.out.splitlines(), output.err


def test_the_command_lists_first_and_removes_when_told(results, monkeypatch, capsys):
    made = write_scene(results / "a")
    old = write_artifact(results / "a", "report", {"ingest": made["ingest"]}, settings={"method": "old"})
    before = everything(results)
    status, lines, _ = told(monkeypatch, capsys, results, places(made))
    assert status == 0
    assert str(old.folder) in lines[0]
    assert "--delete" in lines[-1]
    assert everything(results) == before
    status, lines, _ = told(monkeypatch, capsys, results, places(made), "--json")
    assert [json.loads(line).get("what") for line in lines] == ["remove", None]
    assert json.loads(lines[-1]) == {"folders": 1, "bytes": json.loads(lines[0])["bytes"], "removed": False}
    status, lines, _ = told(monkeypatch, capsys, results, places(made), "--delete")
    assert (status, lines[-1][:17]) == (0, "removed 1 folders")
    assert not old.folder.exists()
    assert all(item.folder.exists() for item in made.values())


def test_the_command_refuses_while_a_run_is_alive_and_lets_no_run_start_meanwhile(results, monkeypatch, capsys):
    from nishiki.engine.running_lock import register_run

    made = write_scene(results / "a")
    with register_run(results, ["a"]) as held:
        status, _, errors = told(monkeypatch, capsys, results, places(made), "--delete")
        assert status == 2
        assert str(os.getpid()) in errors
        status, _, errors = told(monkeypatch, capsys, results, places(made))
        assert status == 0
        assert str(os.getpid()) in errors
        held.ended = "done"

    def start_a_run(*_):
        with refused(Exception, by="_refuse"), register_run(results, ["a"]):
            pass
        return 0

    monkeypatch.setattr(command, "_delete", start_a_run)
    assert told(monkeypatch, capsys, results, places(made), "--delete")[0] == 0


def test_sweeps_that_are_not_given_are_refused_and_their_pages_stay(results, monkeypatch, capsys):
    made = write_scene(results / "a")
    (results / "sweeps/mine").mkdir(parents=True)
    (results / "sweeps/mine/sweep.json").write_text('{"name": "mine"}')
    status, _, errors = told(monkeypatch, capsys, results, places(made))
    assert (status, "sweeps/mine" in errors) == (2, True)
    status, _, errors = told(monkeypatch, capsys, results, places(made), "--delete", "--unnamed")
    assert status == 0
    assert everything(results / "sweeps") == ["mine", "mine/sweep.json"]
