"""What a run may use of its machine: memory, threads, links, the places of caches."""

import errno
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from nishiki.artifacts.artifact import expect_links
from nishiki.commands.engine import engine_environment
from nishiki.commands.running import _tell_unfinished
from nishiki.engine.workflow import memory_arguments, thread_arguments
from nishiki.errors import UserError
from nishiki.formats.files import machine_memory
from nishiki.threads import over_rows, threads


def test_stages_share_nine_tenths_of_the_memory():
    option, value = memory_arguments()
    assert option == "--resources"
    name, amount = value.split("=")
    assert name == "mem_mb"
    assert int(amount) == pytest.approx(0.9 * machine_memory() / 2**20, abs=1)


@pytest.mark.parametrize(
    ("cores", "unfinished", "one"),
    [("2", 0, False), ("2", 1, False), ("2", 2, True), ("2", 9, True), ("4", 3, False), ("4", 4, True), ("1", 1, True)],
)
def test_one_thread_a_stage_where_unfinished_scenes_keep_all_processors_at_work(tmp_path, cores, unfinished, one):
    there, missing = tmp_path / "artifact.json", tmp_path / "missing/artifact.json"
    there.write_text("{}")
    scenes = [[there, missing]] * unfinished + [[there, there]] * 3
    assert thread_arguments(cores, scenes) == (["--max-threads", "1"] if one else [])


@pytest.mark.parametrize("cores", [None, "all"])
def test_all_cores_are_those_that_this_process_may_use(tmp_path, monkeypatch, cores):
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    count = len(os.sched_getaffinity(0))
    missing = [[tmp_path / "artifact.json"]]
    assert thread_arguments(cores, missing * count)
    assert not thread_arguments(cores, missing * (count - 1))


@pytest.mark.parametrize("given", ["3", "1"])
def test_a_job_uses_the_threads_that_it_was_given(monkeypatch, given):
    monkeypatch.setenv("NUMBA_NUM_THREADS", given)
    assert threads() == int(given)


@pytest.mark.parametrize("given", ["", "0", "many"])
def test_without_a_number_a_process_uses_the_processors_that_it_may(monkeypatch, given):
    monkeypatch.setenv("NUMBA_NUM_THREADS", given)
    assert threads() == len(os.sched_getaffinity(0))


@pytest.mark.parametrize(("rows", "workers"), [(0, 2), (1, 2), (7, 1), (7, 2), (7, 3), (100, 4)])
def test_strips_cover_every_row_once(monkeypatch, rows, workers):
    monkeypatch.setattr("nishiki.threads.threads", lambda: workers)
    seen = []
    over_rows(lambda start, stop, add: seen.extend(range(start + add, stop + add)), rows, 5)
    assert sorted(seen) == list(range(5, rows + 5))


@pytest.mark.parametrize("number", [errno.EOPNOTSUPP, errno.EPERM])
def test_results_on_a_file_system_without_links_are_refused_before_the_work(tmp_path, monkeypatch, number):
    expect_links(tmp_path)
    assert list(tmp_path.iterdir()) == []

    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "symlink", refuse)
    with pytest.raises(UserError, match=str(tmp_path)):
        expect_links(tmp_path)


@pytest.mark.parametrize("home", ["/proc/nohome", None])
def test_a_home_that_cannot_be_written_is_not_used_for_caches(tmp_path, monkeypatch, home):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", home or str(tmp_path / "home"))
    environment = engine_environment()
    assert environment.get("XDG_CACHE_HOME") == (str(tmp_path / ".snakemake/cache") if home else None)


def test_a_profile_for_other_work_is_left_out_and_named(monkeypatch, capsys):
    monkeypatch.setenv("SNAKEMAKE_PROFILE", "slurm-of-others")
    assert "SNAKEMAKE_PROFILE" not in engine_environment()
    assert "slurm-of-others" in capsys.readouterr().err


@pytest.mark.parametrize("failed_stage", ["publish", None])
def test_a_run_that_failed_never_ends_with_all_scenes_finished(tmp_path, monkeypatch, capsys, failed_stage):
    artifact = tmp_path / "artifact.json"
    artifact.write_text("{}")
    plan = SimpleNamespace(stages=["ingest"])
    flow = SimpleNamespace(plans={"icon": plan}, artifact=lambda scene, stage: Path(artifact), refused={})
    monkeypatch.setattr("nishiki.engine.finished.reason_to_run", lambda flow, scene: "not published")
    failure = {"scene": "icon", "stage": failed_stage, "name": "icon", "why": "Stale file handle", "log": "x.log"}
    _tell_unfinished(flow, 1.0, [failure] if failed_stage else [])
    text = capsys.readouterr().err
    assert "1 of 1 scenes" not in text
    assert (os.strerror(errno.ESTALE) in text) == bool(failed_stage)
