"""A live run is never disturbed, a dead one never in the way, and what cannot be known is not guessed."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from refusals import refused

from nishiki import processes
from nishiki.engine.running_lock import MARK, RUNS, here, records, refuse_while_running, register_run
from nishiki.errors import UserError

SOURCE = Path(__file__).resolve().parents[2] / "workflow/src"
HOLD = """
import sys, time
from pathlib import Path
from nishiki.engine.running_lock import register_run
with register_run(Path("results"), sys.argv[1].split(",")) as held:
    {inside}
"""
WAIT = "print('ready', flush=True); time.sleep(60)"
CALL = "held.call([sys.executable, '-c', {child!r}], {{'PATH': '/usr/bin:/bin'}})"


@pytest.fixture(autouse=True)
def somewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def start():
    """Start another process that registers a run of some scenes; killed at the end of the test."""
    started = []

    def begin(scenes="a", inside=WAIT):
        process = subprocess.Popen(
            [sys.executable, "-c", HOLD.format(inside=inside), scenes],
            env={**os.environ, "PYTHONPATH": str(SOURCE)},
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        started.append(process)
        assert process.stdout.readline() == "ready\n"
        return process

    yield begin
    for process in started:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()


def kill(process):
    process.kill()
    process.wait()


def run_once(*scenes, **options):
    told = []
    with register_run(Path("results"), scenes or ("a",), tell=told.append, **options) as held:
        held.ended = "done"
    return held, told


def record_of(**facts):
    """A record that some run left behind."""
    values = {"id": "x", "process": "1-1", "directory": os.getcwd(), "results": "results", "scenes": ["a"], **here()}
    path = Path("results", RUNS, "x.json")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**values, "started": "2999-01-01T00:00:00Z", **facts}))
    return path


def test_a_run_leaves_nothing_after_success_and_a_note_after_failure():
    held, told = run_once()
    assert told == []
    assert not held.unclean
    assert records(Path("results")) == []
    with register_run(Path("results"), ["a"]):
        pass
    assert [record.state for record in records(Path("results"))] == ["ended"]
    held, told = run_once()
    assert (told, held.unclean) == ([], False)
    assert records(Path("results")) == []


def test_a_live_run_is_told_by_process_host_user_and_time_and_stays(start):
    process = start("a,b")
    (record,) = records(Path("results"))
    with pytest.raises(UserError) as told:
        run_once("b", "c")
    for word in ("b", f"process {process.pid}", processes.host(), record.facts["started"], "Remedy"):
        assert word in str(told.value)
    with refused(UserError, by="refuse_while_running"):
        refuse_while_running(Path("results"), "nothing is deleted")
    assert process.poll() is None
    assert record.path.exists()


def test_runs_of_other_scenes_may_live_side_by_side(start):
    start("a,b")
    held, told = run_once("c")
    assert (told, held.unclean) == ([], False)


def test_a_killed_run_is_not_in_the_way(start):
    kill(start("a,b"))
    held, told = run_once("a", "b", "c")
    assert held.unclean
    assert len(told) == 1
    assert "killed" in told[0]
    assert not run_once("a", "b")[0].unclean


def test_what_a_killed_run_left_of_other_scenes_is_remembered(start):
    kill(start("a,b"))
    assert run_once("a")[0].unclean
    assert not run_once("a")[0].unclean
    assert run_once("b")[0].unclean


def test_a_run_killed_while_it_cleared_up_is_still_unclean(start):
    kill(start("a"))
    with register_run(Path("results"), ["a"], tell=str):
        pass  # it fails
    assert run_once("a")[0].unclean


def test_the_engine_of_a_dead_command_line_is_alive(start):
    child = "import time; print('ready', flush=True); time.sleep(60)"
    process = start("a", CALL.format(child=child))
    kill(process)
    (engine,) = processes.find_marked(MARK, records(Path("results"))[0].facts["id"])
    with refused(UserError, engine):
        run_once("a")
    with refused(UserError, by="_refuse"):
        run_once("a")
    (engine,) = processes.find_marked(MARK, records(Path("results"))[0].facts["id"])
    os.kill(engine, signal.SIGKILL)
    wait_until(lambda: processes.start_ticks(engine) is None)
    assert run_once("a")[0].unclean


def test_jobs_that_outlive_a_dead_run_are_ended_first(start):
    child = "import subprocess as s; s.Popen(['sleep', '77']); print('ready', flush=True); import time; time.sleep(60)"
    process = start("a", CALL.format(child=child))
    (record,) = records(Path("results"))
    # A process that has just started shows no environment for a moment.
    wait_until(lambda: len(processes.find_marked(MARK, record.facts["id"])) == 2)
    marked = processes.find_marked(MARK, record.facts["id"])
    names = {Path("/proc", str(pid), "comm").read_text().strip(): pid for pid in marked}
    kill(process)
    os.kill(next(pid for name, pid in names.items() if name != "sleep"), signal.SIGKILL)
    wait_until(lambda: records(Path("results"))[0].state == "dead")
    assert processes.start_ticks(names["sleep"]) is not None
    held, told = run_once("a")
    assert held.unclean
    assert "ending 1 processes" in told[0]
    assert processes.start_ticks(names["sleep"]) is None


def test_a_process_that_ignores_termination_is_killed():
    stubborn = "import signal,time; signal.signal(15, signal.SIG_IGN); print('ready', flush=True); time.sleep(60)"
    process = subprocess.Popen(
        [sys.executable, "-c", stubborn], env={**os.environ, MARK: "some-run"}, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "ready\n"
    assert processes.find_marked(MARK, "some-run") == [process.pid]
    assert processes.stop(lambda: processes.find_marked(MARK, "some-run"), patience_s=0.5) == []
    assert process.wait() == -signal.SIGKILL
    process.stdout.close()


def test_manifests_that_a_killed_run_put_by_are_forgotten(start):
    start("b")
    record_of()
    backups = [Path(".snakemake/backups/results", scene, "normals/x/artifact.json") for scene in "ab"]
    for path in backups:
        path.parent.mkdir(parents=True)
        path.touch()
    run_once("a")
    assert [path.exists() for path in backups] == [False, True]


@pytest.mark.parametrize(
    ("facts", "state"),
    [
        ({}, "dead"),
        ({"boot": "another start", "machine": "m"}, "dead"),
        ({"boot": "another start", "machine": "another machine"}, "elsewhere"),
        ({"boot": "another start", "machine": "m", "host": "another-host"}, "elsewhere"),
        ({"boot": "another start", "machine": ""}, "elsewhere"),
        ({"namespace": "pid:[1]"}, "elsewhere"),
        ({"ended": "failed", "boot": "another start"}, "ended"),
    ],
)
def test_what_is_certain_of_a_record_with_a_free_lock(monkeypatch, facts, state):
    monkeypatch.setattr(processes, "machine", lambda: "m")
    record_of(**{"machine": "m", **facts})
    assert [record.state for record in records(Path("results"))] == [state]


def test_without_a_machine_name_another_start_proves_nothing(monkeypatch):
    monkeypatch.setattr(processes, "machine", lambda: "")
    record_of(boot="another start", machine="")
    assert records(Path("results"))[0].state == "elsewhere"


def test_another_users_run_is_not_ours_to_clear_up(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    record_of(user="somebody")
    with refused(UserError, "--host-is-gone"):
        run_once("a")


def test_a_run_of_another_machine_is_never_ended_from_here():
    path = record_of(host="far-away", machine="another", boot="another")
    with pytest.raises(UserError, match=r"far-away.*--host-is-gone far-away"):
        run_once("a")
    with refused(UserError, "--host-is-gone"):
        refuse_while_running(Path("results"), "nothing is deleted")
    assert path.exists()
    held, _ = run_once("a", gone=["far-away"])
    assert held.unclean
    assert not path.exists()


@pytest.mark.parametrize("text", ["", "{", "[]", '{"id": 1}', "[" * 100_000, '{"id": "x"}'])
def test_a_record_that_cannot_be_read_is_not_guessed_about(text):
    path = record_of()
    path.write_text(text)
    with refused(UserError, path.name):
        run_once("a")
    assert path.exists()


def test_a_process_number_used_again_is_another_process():
    mine = processes.identity()
    assert processes.is_alive(mine)
    assert not processes.is_alive(f"{os.getpid()}-1")
    assert not processes.is_alive("999999999-1")
    assert not processes.is_alive("x")
    record_of(process=f"{os.getpid()}-1")
    assert records(Path("results"))[0].state == "dead"


def test_results_that_cannot_be_written_are_reported(somewhere):
    Path("results").write_text("a file")
    with refused(UserError, by="_one_at_a_time"):
        run_once("a")


@pytest.mark.parametrize("whole_group", [False, True])
def test_a_termination_ends_an_engine_whose_own_handler_waits_for_ever(start, whole_group):
    """As Snakemake's does where the signal comes while its scheduler holds the lock that the handler takes."""
    child = (
        "import signal,sys,threading,time; lock=threading.Lock(); signal.signal(15, lambda *_: lock.acquire())\n"
        "try:\n with lock: print('ready', flush=True); time.sleep(60)\n"
        "except KeyboardInterrupt: sys.exit(7)"
    )
    heed = "import signal; signal.signal(2, signal.default_int_handler); "
    process = start("a", heed + "sys.exit(" + CALL.format(child=child) + ")")
    (os.killpg if whole_group else os.kill)(process.pid, signal.SIGTERM)
    assert process.wait(timeout=20) == 7
    assert [record.state for record in records(Path("results"))] == ["ended"]


def test_a_termination_of_all_processes_ends_an_engine_inside_its_event_loop(start):
    """There asyncio keeps an interrupt to itself until the loop ends, and a lock's holder never ends."""
    child = (
        f"import sys; sys.path.insert(0, {str(SOURCE)!r})\n"
        "import asyncio,signal,threading,time; from nishiki.processes import interrupt_when_terminated\n"
        "lock=threading.Lock(); signal.signal(15, lambda *_: lock.acquire()); interrupt_when_terminated()\n"
        "async def work():\n with lock: print('ready', flush=True); time.sleep(60)\n"
        "try: asyncio.run(work())\n"
        "except KeyboardInterrupt: sys.exit(7)"
    )
    heed = "import signal; signal.signal(2, signal.default_int_handler); "
    process = start("a", heed + "sys.exit(" + CALL.format(child=child) + ")")
    os.killpg(process.pid, signal.SIGTERM)
    assert process.wait(timeout=20) == 7
    assert [record.state for record in records(Path("results"))] == ["ended"]


def test_a_termination_reaches_an_engine_that_heeds_no_interrupt(start):
    """Shells start what stands before & with interrupts ignored."""
    child = "import signal,sys,time; signal.signal(15, lambda *_: sys.exit(7)); "
    child += "print('ready', flush=True); time.sleep(60)"
    process = start("a", "import signal; signal.signal(2, signal.SIG_IGN); sys.exit(" + CALL.format(child=child) + ")")
    process.terminate()
    assert process.wait(timeout=50) == 7
    assert [record.state for record in records(Path("results"))] == ["ended"]


@pytest.mark.parametrize("interrupts", [1, 2])
def test_an_interrupt_ends_a_job_that_heeds_none_and_a_second_one_the_engine_too(start, interrupts):
    """A job that compiles does not come to its own handler for seconds."""
    deaf = "import signal,time; signal.signal(2, signal.SIG_IGN); "
    job = deaf + "print('ready', flush=True); time.sleep(60)"
    child = deaf + f"import subprocess,sys; job = subprocess.Popen([sys.executable, '-c', {job!r}, 'stage.py']); "
    child += "job.wait(); " + ("sys.exit(7)" if interrupts == 1 else "time.sleep(60)")
    heed = "import signal; signal.signal(2, signal.default_int_handler); "
    process = start("a", heed + "sys.exit(" + CALL.format(child=child) + ")")
    for number in range(interrupts):
        time.sleep(number)
        os.kill(process.pid, signal.SIGINT)
    status = process.wait(timeout=20)
    assert status == 7 if interrupts == 1 else status not in (0, 7)
    assert [(record.state, record.unclean) for record in records(Path("results"))] == [("ended", True)]


def test_only_one_registers_at_a_time(start):
    inside = "import fcntl, os; f = os.open('results/.runs/register', os.O_RDWR); fcntl.flock(f, fcntl.LOCK_EX); "
    start("b", inside + "print('ready', flush=True); time.sleep(0.5); os.close(f); time.sleep(60)")
    begun = time.monotonic()
    run_once("a")
    assert time.monotonic() - begun > 0.3


def wait_until(condition, seconds=20.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.05)
