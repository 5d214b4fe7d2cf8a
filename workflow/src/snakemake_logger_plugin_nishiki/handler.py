"""Select the log records of Snakemake and the messages of stages that are printed for the user."""

import atexit
import json
import logging
import os
import re
import signal
import threading
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from snakemake_interface_logger_plugins.base import LogHandlerBase
from snakemake_interface_logger_plugins.common import LogEvent

from snakemake_logger_plugin_nishiki.progress import Job, RunProgress, duration
from snakemake_logger_plugin_nishiki.terminal import Screen, StageOutput

LOGGER = "snakemake.logging"
"""Snakemake's own logger."""
STAGE_MESSAGE = re.compile(r"nishiki ([\w-]+)/(\w+): (.*)")
STAGE_PROGRESS = re.compile(r"([\w-]+)/(\w+): (.*)")
EXIT_STATUS = re.compile(r"exit status (\d+)|died with <Signals\.(\w+)")
INTERRUPTED = "Terminating processes on user request"
JOINED = re.compile(r"(?<=.)(?=nishiki [\w-]+/\w+: )")
"""Boundary between messages of two stages that were written at the same moment."""
RETRY = re.compile(r"Trying to restart job (\S+)\.")
KILLED = 128
"""A shell reports a signal as this number plus the signal's."""
NOTHING_TO_DO = "Nothing to be done"
REPEATED = (
    *("At least one job did not complete successfully", "Exiting because a job execution failed"),
    "Cannot restore",  # the output of a failed job that had none before
)
"""Messages of Snakemake about a failed job, which has been reported already."""
CHAINED = ("During handling of the above exception", "The above exception was the direct cause")
LOG_TAIL = 2**16
"""Bytes of the end of a cluster's log of a failed job that are looked through."""
TICK_S = 1.0


class RunHandler(LogHandlerBase):
    """Show the records of one run; see `RunProgress` for the live line.

    Snakemake calls `emit` in one thread, `StageOutput` calls `take_line` in another, and a third renews the live line.
    """

    stream: TextIO | None = None
    """Stream to print to, for tests; None: standard error, and that of the jobs is read."""
    writes_to_stream = True  # Snakemake itself prints nothing then
    writes_to_file = False  # Snakemake writes its log file itself
    has_filter = True  # every record is wanted, whatever is quiet in the log file
    has_formatter = True  # the lines are made here
    needs_rulegraph = False

    def __post_init__(self) -> None:
        settings = self.settings
        expected = json.loads(getattr(settings, "expected", "") or "{}")
        self.progress = RunProgress(**expected)
        self._failures = getattr(settings, "failures", -1)
        self._state = threading.RLock()
        self._messages: dict[tuple[str, str], str] = {}
        self._names: dict[str, str] = {}
        self._exit = ""
        self._interrupted = False
        self._traceback = False
        self._ended = threading.Event()
        self._output: StageOutput | None = None
        if self.stream is None:
            logging.raiseExceptions = False  # a log file that cannot be written must not fill the screen
            with self._state:  # no line is taken before there is a screen
                self._output = StageOutput(self.take_line)
                self.screen = Screen(self._output.terminal())
            atexit.register(self.close)  # a traceback of Snakemake itself is still in the pipe then
            threading.Thread(target=self._tick, daemon=True, name="live line").start()
        else:
            self.screen = Screen(self.stream)

    def emit(self, record: logging.LogRecord) -> None:
        """Show what a record says, where a user has to know."""
        try:
            event = getattr(record, "event", None)
            if event in (LogEvent.JOB_ERROR, LogEvent.GROUP_ERROR, LogEvent.JOB_FINISHED) and self._output:
                self._output.catch_up()  # what the stage said stands before what became of it
            with self._state:
                self._show(event, record)
        except Exception:
            self.handleError(record)

    def take_line(self, line: str) -> None:
        """Show a line that a job wrote to its standard error; reports of progress go to the live line.

        Everything else goes to Snakemake's log file too. Of tracebacks only the last line is shown.
        """
        for text in JOINED.split(line):
            self._take(text)

    def _take(self, line: str) -> None:
        progress = STAGE_PROGRESS.fullmatch(line)
        with self._state:
            if progress and self._note(*progress.groups()):
                return
            logging.getLogger(LOGGER).info(line, extra={"of_stage": True})
            message = STAGE_MESSAGE.fullmatch(line)
            if message:
                self._traceback = False
                self._keep(message)
            elif self._is_traceback(line):
                return
            self.screen.tell(line)

    def close(self) -> None:
        """Take the live line away and give standard error back; more than one call does no harm."""
        if not self._ended.is_set():
            if self._output:
                self._output.close()
            self._ended.set()
            with self._state:
                self.screen.close()
        super().close()

    def _tick(self) -> None:
        while not self._ended.wait(TICK_S):
            with self._state:
                if not self._ended.is_set() and self.progress.waiting:
                    self.screen.show(self.progress.line(self.screen.width))

    def _note(self, scene: str, stage: str, text: str) -> bool:
        """Return whether a stage that runs reports its progress."""
        jobs = [job for job in self.progress.running.values() if (job.scene, job.stage) == (scene, stage)]
        for job in jobs:
            job.note = text
        return bool(jobs)

    def _keep(self, message: re.Match) -> None:
        """Remember what a stage said last, for its failure."""
        if not message[3].startswith("warning:"):
            self._messages[message[1], message[2]] = message[3]

    def _is_traceback(self, line: str) -> bool:
        """Return whether a line is part of a traceback, its last line aside."""
        if line.startswith("Traceback (most recent call last)") or line.startswith(CHAINED):
            self._traceback = True
        elif self._traceback and not line.startswith(" "):
            self._traceback = False
            return False
        return self._traceback

    def _show(self, event: str | None, record: Any) -> None:
        match event:
            case LogEvent.RESOURCES_INFO:
                with suppress(TypeError, ValueError):
                    self.progress.cores = max(1.0, float(getattr(record, "cores", 1)))
            case LogEvent.RUN_INFO:
                self.progress.plan(record.stats)
            case LogEvent.JOB_INFO:
                self._started(record)
            case LogEvent.JOB_FINISHED:
                self._finished(record.job_id)
            case LogEvent.JOB_ERROR:
                self._failed(record)
            case LogEvent.GROUP_ERROR:
                self._group_failed(record)
            case LogEvent.ERROR:
                self._error(record)
            case None if not getattr(record, "of_stage", False):
                self._show_message(record)
        if self.screen.live and self.progress.waiting:
            self.screen.show(self.progress.line(self.screen.width))

    def _started(self, record: Any) -> None:
        if record.rule_name != "all":
            wildcards = dict(record.wildcards or {})
            job = Job(record.rule_name, wildcards, int(record.threads or 1), self.progress.clock())
            self.progress.start(record.jobid, job)
            self._names[str(record.jobid)] = job.name

    def _finished(self, number: int) -> None:
        finished = self.progress.finish(number)
        if finished is None:
            return
        job, seconds = finished
        self._messages.pop((job.scene, job.stage), None)
        if job.rule == "publish":
            many = f" ({self.progress.scenes_done()} of {self.progress.scenes} scenes)" if self.progress.scenes else ""
            self.screen.tell(f"{job.name}: finished{many}")
        else:
            done, total = self.progress.stages()
            self.screen.tell(f"{job.name}: done in {duration(seconds)} ({done} of {total} stages)")

    def _failed(self, record: Any) -> None:
        """Tell of a failed job, and forget it; a job of a group was told of with the group."""
        job = self.progress.stop(record.jobid)
        if job is None or getattr(record, "indent", False):
            return
        logs = [name for name in record.log if name]
        self._read_logs(logs)
        message, status = self._messages.pop((job.scene, job.stage), ""), self._exit
        self._exit = ""
        after = duration(self.progress.clock() - job.started)
        self._tell_failure(f"{job.name}: failed after {after}", [job], message, status, logs)

    def _group_failed(self, record: Any) -> None:
        stopped = (self.progress.stop(info["jobid"]) for info in record.job_error_info)
        jobs = [job for job in stopped if job is not None]
        if not jobs:
            return
        logs = [name for name in record.aux_logs if name]
        self._read_logs(logs)
        # Of a group only the first failed stage has something to say; those behind it never ran.
        named = [job for job in jobs if (job.scene, job.stage) in self._messages] or jobs
        messages = [self._messages.pop((job.scene, job.stage), "") for job in named]
        text = ", ".join(job.name for job in named)
        self._tell_failure(f"{text}: failed in a job of {len(jobs)} stages", named, messages[0], "", logs)

    def _tell_failure(self, text: str, jobs: Iterable[Job], message: str, status: str, logs: list[str]) -> None:
        """Print one line on a failure; the stage's own message stands above it already."""
        if self._interrupted:  # its jobs were ended, which is no failure of theirs
            return
        files = [each for each in logging.getLogger(LOGGER).handlers if isinstance(each, logging.FileHandler)]
        log = next(iter(logs), "") or next((os.path.relpath(each.baseFilename) for each in files), "")
        why = message or status or "it left no message"
        self.screen.tell(text + ("" if message else f", {why}") + (f"; log: {log}" if log else ""))
        for job in jobs:
            failure = {"scene": job.scene, "stage": job.stage, "name": job.name, "why": why, "log": log}
            if self._failures >= 0:
                with suppress(OSError):
                    os.write(self._failures, json.dumps(failure).encode() + b"\n")

    def _read_logs(self, names: list[str]) -> None:
        """Show what the stages said in logs that a cluster wrote."""
        for name in names:
            with suppress(OSError):
                data = Path(name).read_bytes()[-LOG_TAIL:]
                for line in data.decode("utf-8", "backslashreplace").splitlines():
                    message = STAGE_MESSAGE.fullmatch(line.strip())
                    if message:
                        self._keep(message)
                        self.screen.tell(line.strip())

    def _error(self, record: Any) -> None:
        text = record.getMessage()
        status = EXIT_STATUS.search(text)
        if status and ("CalledProcessError" in text or "CalledProcessError" in str(getattr(record, "exception", ""))):
            self._exit = _status_text(status)
        elif not any(words in text for words in REPEATED):
            self.screen.tell(text.rstrip())

    def _show_message(self, record: Any) -> None:
        """Show Snakemake's warnings and errors, and the little of its information that a user has to know."""
        text = record.getMessage().strip()
        retry = RETRY.match(text)
        if retry:
            self.screen.tell(f"{self._names.get(retry[1], 'a job of several stages')}: tried again")
        elif record.levelno >= logging.WARNING:
            if not any(words in text for words in REPEATED):
                self.screen.tell(text)
        elif text.startswith(INTERRUPTED):
            self._interrupted = True
        elif text.startswith(NOTHING_TO_DO):
            self.screen.tell(text)


def _status_text(status: re.Match) -> str:
    """Explain the status of a job's command."""
    number = int(status[1] or 0) - KILLED
    if status[2] or number > 0:
        name = status[2] or (signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}")
        return f"killed by {name}" + (", most often for lack of memory" if name == "SIGKILL" else "")
    return f"exit status {status[1]}"
