"""What a run may use of its machine: memory and threads."""

import os

import pytest

from nishiki.engine.machine import memory_arguments, thread_arguments
from nishiki.formats.bounds import machine_memory
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
