"""What a run prints: one line a finished stage, failures with the stage's own message, a live line on a terminal."""

import io
import json
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
from refusals import expect_facts
from snakemake_interface_logger_plugins.common import LogEvent
from snakemake_interface_logger_plugins.tests import MockOutputSettings, TestLogHandlerBase

from nishiki.stages.runner import _bug
from snakemake_logger_plugin_nishiki import LogHandler, LogHandlerSettings
from snakemake_logger_plugin_nishiki.progress import Job, RunProgress
from snakemake_logger_plugin_nishiki.terminal import CLEAR, Screen

SOURCE = Path(__file__).resolve().parents[2] / "workflow/src"
EXPECTED = {"scenes": 3, "finished": 1, "seconds": {"ingest": 10.0, "normals": 30.0}}


class Terminal(io.StringIO):
    """A stream that says that it is a terminal."""

    def isatty(self):
        return True


class Console(LogHandler):
    """The handler, printing into a text."""

    def __post_init__(self):
        self.stream = io.StringIO()
        super().__post_init__()
        self.now = 100.0
        self.progress.clock = lambda: self.now

    def say(self, event, message="", level=logging.INFO, **facts):
        """Emit a record; what is printed for it."""
        before = len(self.stream.getvalue())
        record = logging.LogRecord("snakemake.logging", level, "x.py", 1, message, (), None)
        vars(record).update(facts, event=event)
        self.handle(record)
        return self.stream.getvalue()[before:]

    def start(self, number, scene, rule, /, **wildcards):
        """A job begins."""
        wildcards = {"scene": scene, "key": "0" * 12, **wildcards}
        facts = {"jobid": number, "rule_name": rule, "wildcards": wildcards, "threads": 2}
        return self.say(LogEvent.JOB_INFO, **facts)

    def fail(self, number, log=()):
        """A job fails."""
        return self.say(LogEvent.JOB_ERROR, "Error in rule", logging.ERROR, jobid=number, log=list(log), indent=False)

    def line(self, text):
        """A job writes to its standard error; what is printed for it."""
        before = len(self.stream.getvalue())
        self.take_line(text)
        return self.stream.getvalue()[before:]


@pytest.fixture
def failures(tmp_path):
    """A file for what failed, as descriptor and reader."""
    path = tmp_path / "failures"
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT)
    yield descriptor, lambda: [json.loads(line) for line in path.read_text().splitlines()]
    os.close(descriptor)


@pytest.fixture
def console(failures):
    """A handler of a run with three scenes, one of them finished before."""
    settings = LogHandlerSettings(expected=json.dumps(EXPECTED), failures=failures[0])
    handler = Console(MockOutputSettings(), settings)
    handler.say(LogEvent.RUN_INFO, stats={"all": 1, "ingest": 2, "normals": 2, "publish": 2, "total": 7})
    return handler


class TestPlugin(TestLogHandlerBase):
    """What the interface asks of every plugin."""

    __test__ = True

    def get_log_handler_cls(self):
        return Console

    def get_log_handler_settings(self):
        return LogHandlerSettings()


def test_one_line_a_finished_stage_with_scene_time_and_count(console):
    assert console.start(1, "jar", "ingest") == ""
    console.now += 2.5
    expect_facts(console.say(LogEvent.JOB_FINISHED, job_id=1), "jar/ingest", "2.5 s", "1 of 4")
    console.start(2, "jar", "part", stage="normals", number="1", total="3")
    console.now += 300
    expect_facts(console.say(LogEvent.JOB_FINISHED, job_id=2), "jar/normals", "1 of 3", "5 min")
    console.start(3, "jar", "publish")
    expect_facts(console.say(LogEvent.JOB_FINISHED, job_id=3), "jar", "2 of 3")


def test_what_snakemake_says_for_itself_is_left_to_its_log_file(console):
    assert console.say(None, "Building DAG of jobs...") == ""
    assert console.say(LogEvent.PROGRESS, done=1, total=7) == ""
    assert console.say(LogEvent.SHELLCMD, "python scripts/stage.py", shellcmd="python") == ""
    assert console.say(None, "Nothing to be done (all files are there).") != ""
    assert console.say(None, "Cannot restore results/x: no backup found.", logging.WARNING) == ""
    warning = "a disk is slow"
    assert console.say(None, warning, logging.WARNING) == f"{warning}\n"
    assert "MissingInputException" in console.say(
        LogEvent.ERROR, "MissingInputException:\nno rule", logging.ERROR, exception="MissingInputException"
    )


def test_a_failure_has_the_message_of_its_stage_and_the_log(console, failures):
    console.start(1, "jar", "ingest")
    console.start(2, "bowl", "ingest")
    message = "nishiki bowl/ingest: frames/3.png: 12 bytes are missing"
    assert console.line(message) == message + "\n"
    console.now += 4
    told = console.fail(2, log=["slurm/17.log"])
    expect_facts(told, "bowl/ingest", "4.0 s", "slurm/17.log")
    why = "frames/3.png: 12 bytes are missing"
    row = {"scene": "bowl", "stage": "ingest", "name": "bowl/ingest", "why": why, "log": "slurm/17.log"}
    assert failures[1]() == [row]
    assert set(console.progress.running) == {1}


@pytest.mark.parametrize(
    ("error", "said"),
    [
        ("returned non-zero exit status 137.", "SIGKILL"),
        ("died with <Signals.SIGSEGV: 11>.", "SIGSEGV"),
        ("returned non-zero exit status 3.", " 3"),
    ],
)
def test_a_stage_that_dies_without_a_word_is_told_with_its_status(console, error, said):
    console.start(1, "jar", "ingest")
    text = f"RuleException:\nCalledProcessError in file \"x.smk\", line 3:\nCommand 'python' {error}"
    assert console.say(LogEvent.ERROR, text, logging.ERROR, exception="RuleException") == ""
    assert said in console.fail(1)


def test_a_failed_job_that_is_tried_again_and_then_done_is_no_longer_a_failure(console):
    console.start(1, "jar", "ingest")
    console.fail(1)
    assert console.say(None, "Trying to restart job 1.").startswith("jar/ingest: ")
    console.start(1, "jar", "ingest")
    console.say(LogEvent.JOB_FINISHED, job_id=1)
    assert console.progress.stages() == (1, 4)


def test_of_a_group_the_stage_that_has_a_message_is_reported(console, failures, tmp_path):
    log = tmp_path / "17.log"
    log.write_text("Building DAG of jobs...\nnishiki bowl/normals: no light is left\n")
    for number, stage in enumerate(("ingest", "normals", "height")):
        console.start(number, "bowl", stage)
    jobs = [{"jobid": number} for number in range(3)]
    facts = {"groupid": "level0-a", "aux_logs": [str(log)], "job_error_info": jobs}
    told = console.say(LogEvent.GROUP_ERROR, "", logging.ERROR, **facts)
    message, failed = told.splitlines()
    assert message in log.read_text()
    expect_facts(failed, "bowl/normals", 3, log)
    assert console.fail(1) == "", "the jobs of a group are not told of once more"
    assert [row["name"] for row in failures[1]()] == ["bowl/normals"]
    again = console.say(None, "Trying to restart job 808423e5-8354-5cba-956d-8f8b01786330.")
    assert "808423e5" not in again, "Snakemake names it by a number of its own"
    assert again


def test_jobs_that_an_interrupt_ended_are_no_failures(console, failures):
    console.start(1, "jar", "ingest")
    console.say(None, "Terminating processes on user request, this might take some time.")
    assert console.fail(1) == ""
    assert failures[1]() == []


def test_progress_of_a_stage_goes_to_the_live_line_and_warnings_are_shown(console):
    console.start(1, "jar", "normals")
    assert console.line("jar/normals: rows 3 of 8, 5 s left") == ""
    assert "jar/normals (rows 3 of 8, 5 s left)" in console.progress.line()
    warning = "nishiki jar/normals: warning: a fitted parameter ended at its bound: gloss"
    assert console.line(warning) == warning + "\n"
    assert "gloss" not in console.fail(1), "a warning is not why it failed"


def test_of_a_traceback_the_last_line_is_shown(console):
    try:
        raise ValueError("two\nlines")
    except ValueError as error:
        text = _bug("jar/normals", error)
    shown = "".join(console.line(line) for line in text.splitlines())
    assert shown == "nishiki jar/normals: ValueError: two lines\n"
    for line in ("Traceback (most recent call last):", '  File "x.py", line 3', "KeyError: 3"):
        shown = console.line(line)
    assert shown == "KeyError: 3\n"


def test_messages_of_two_stages_on_one_line_are_told_apart(console):
    shown = console.line("nishiki jar/normals: interruptednishiki bowl/ingest: interrupted")
    assert shown.splitlines() == ["nishiki jar/normals: interrupted", "nishiki bowl/ingest: interrupted"]


def test_names_of_strangers_do_not_command_the_terminal(console):
    assert "\x1b" not in console.line("nishiki jar/ingest: \x1b]0;title: not found")


def test_the_time_that_is_left_follows_the_models_first_and_then_the_clock():
    now = [0.0]
    progress = RunProgress(seconds={"ingest": 100.0}, clock=lambda: now[0], cores=2.0)
    progress.plan({"ingest": 4, "total": 4})
    assert progress.seconds_left() is None
    for number in range(4):
        progress.start(number, type("Job", (), {"rule": "ingest", "threads": 1, "started": 0.0, "name": "a"})())
    assert progress.seconds_left() == pytest.approx(200)
    now[0] = 400.0
    progress.finish(0), progress.finish(1)
    left = progress.seconds_left()
    assert 10 < left < 200, "the running two are nearly through by their models"
    assert RunProgress().line() == "stages 0/0"
    running = {i: Job("normals", {"scene": f"altarpiece-left-{i}"}, 1, 0.0, "rows 3 of 8, 5 s left") for i in range(3)}
    whole = RunProgress(3, 1, running=running)
    assert len(whole.line()) > 79 >= len(whole.line(79))
    assert "altarpiece-left-0/normals" in whole.line(79)


def test_a_terminal_has_one_live_line_below_the_lines_that_stay(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    terminal = Terminal()
    screen = Screen(terminal)
    screen.show("stages 0/2")
    screen.tell("jar/ingest: done")
    screen.show("stages 1/2" + "x" * 200)
    screen.close()
    text = terminal.getvalue()
    assert text.startswith(f"{CLEAR}stages 0/2{CLEAR}jar/ingest: done\n{CLEAR}stages 1/2x")
    assert text.endswith(CLEAR)
    assert max(len(part) for part in text.split(CLEAR)) < 80


def test_without_a_terminal_there_are_plain_lines_only():
    stream = io.StringIO()
    screen = Screen(stream)
    screen.show("stages 0/2")
    screen.tell("jar/ingest: done")
    screen.close()
    assert stream.getvalue() == "jar/ingest: done\n"


SPEAK = """
import os, subprocess, sys
from snakemake_interface_logger_plugins.tests import MockOutputSettings
from snakemake_logger_plugin_nishiki import LogHandler, LogHandlerSettings
handler = LogHandler(MockOutputSettings(), LogHandlerSettings())
subprocess.run(["sh", "-c", "echo nishiki jar/ingest: from a job >&2; printf unfinished >&2"])
handler.close()
os.write(2, b"after\\n")
"""


def test_the_standard_error_of_jobs_is_read_and_given_back():
    environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
    done = subprocess.run([sys.executable, "-c", SPEAK], env=environment, capture_output=True, text=True, check=True)
    assert done.stderr.splitlines() == ["nishiki jar/ingest: from a job", "unfinished", "after"]
