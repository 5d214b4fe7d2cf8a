"""Track the progress of a run: jobs that wait, run and are done, and the time left."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

UNCOUNTED = ("all", "publish")
"""Rules that are not stages: the target of a run, and the links to a scene's artifacts."""
USUAL_SECONDS = 1.0
"""Expected processor seconds of a job without a cost model."""
PRIOR_SECONDS = 20.0
"""The expected speed weighs as much as the speed measured over this time."""
RUNNING_SHARE = 0.9
"""A running job counts as at most this share of its expected work."""


@dataclass
class Job:
    """A job that runs. started: seconds on the clock; note: what its stage last reported of its progress."""

    rule: str
    wildcards: Mapping[str, str]
    threads: int
    started: float
    note: str = ""

    @property
    def scene(self) -> str:
        """Scene that it belongs to; empty for the page of a sweep."""
        return self.wildcards.get("scene", "")

    @property
    def stage(self) -> str:
        """Stage that it makes, or makes a part or a repeat of."""
        return self.wildcards.get("stage", self.rule)

    @property
    def name(self) -> str:
        """Scene and stage, for reading."""
        if self.rule == "publish":
            return self.scene
        if self.rule == "part":
            return f"{self.scene}/{self.stage} part {self.wildcards['number']} of {self.wildcards['total']}"
        if self.rule == "repeat":
            return f"{self.scene}/{self.stage} repeat {self.wildcards['number']}"
        return f"{self.scene}/{self.stage}" if self.scene else self.rule


@dataclass
class RunProgress:
    """Counts of a run.

    Parameters
    ----------
    scenes, finished : int
        Scenes of the configuration, and those of them that were finished before the run. No scenes: they are not
        counted.
    seconds : mapping of str to float
        Processor seconds that a job is expected to take, by rule.
    clock : callable
        Time in seconds.
    """

    scenes: int = 0
    finished: int = 0
    seconds: Mapping[str, float] = field(default_factory=dict)
    clock: Callable[[], float] = time.monotonic
    cores: float = 1.0
    waiting: dict[str, int] = field(default_factory=dict)
    running: dict[int, Job] = field(default_factory=dict)
    done: dict[str, int] = field(default_factory=dict)
    _since: float | None = None

    def plan(self, jobs: Mapping[str, int]) -> None:
        """Note how many jobs each rule has; only the first call counts."""
        if not self.waiting:
            self.waiting = {rule: number for rule, number in jobs.items() if rule not in ("total", "all")}

    def start(self, number: int, job: Job) -> None:
        """Note that a job runs."""
        if self._since is None:
            self._since = job.started
        self.running[number] = job

    def finish(self, number: int) -> tuple[Job, float] | None:
        """Note that a job is done; the job and its wall-clock seconds, None where it is unknown."""
        job = self.running.pop(number, None)
        if job is None:
            return None
        self.done[job.rule] = self.done.get(job.rule, 0) + 1
        return job, self.clock() - job.started

    def stop(self, number: int) -> Job | None:
        """Note that a job ended without success."""
        return self.running.pop(number, None)

    def stages(self) -> tuple[int, int]:
        """Count the stages that are done, and all of this run."""
        done = sum(number for rule, number in self.done.items() if rule not in UNCOUNTED)
        return done, sum(number for rule, number in self.waiting.items() if rule not in UNCOUNTED)

    def scenes_done(self) -> int:
        """Count the scenes that are finished, before this run or by it."""
        return self.finished + self.done.get("publish", 0)

    def seconds_left(self) -> float | None:
        """Estimate the wall-clock seconds left of the run; None before a job has started.

        Expected work that is left over the speed: that of the work done so far, at first that of as many processors as
        the run has.
        """
        if self._since is None:
            return None
        now = self.clock()
        done = sum(number * self._expected(rule) for rule, number in self.done.items())
        for job in self.running.values():
            expected = self._expected(job.rule)
            done += min(RUNNING_SHARE * expected, (now - job.started) * job.threads)
        total = sum(number * self._expected(rule) for rule, number in self.waiting.items())
        speed = (done + PRIOR_SECONDS * self.cores) / (now - self._since + PRIOR_SECONDS)
        return max(0.0, total - done) / speed

    def _expected(self, rule: str) -> float:
        return self.seconds.get(rule, USUAL_SECONDS)

    def line(self, width: int = 1000) -> str:
        """Return the whole state on one line: as much of what runs as fits the width."""
        done, total = self.stages()
        counts = [f"scenes {self.scenes_done()}/{self.scenes}"] if self.scenes else []
        counts.append(f"stages {done}/{total}")
        left = self.seconds_left()
        if left is not None:
            counts.append(f"about {duration(left)} left")
        jobs = sorted(self.running.values(), key=lambda job: job.started)
        names = [job.name for job in jobs]
        noted = [f"{job.name} ({job.note})" if job.note else job.name for job in jobs]
        for shown in (noted[:2], names[:2], noted[:1], names[:1]):
            more = f" and {len(jobs) - len(shown)} more" if len(jobs) > len(shown) else ""
            line = ", ".join(counts) + (f": {', '.join(shown)}{more}" if shown else "")
            if len(line) <= width:
                break
        return line


def duration(seconds: float) -> str:
    """Format a time in seconds, minutes or hours, whichever reads best."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
