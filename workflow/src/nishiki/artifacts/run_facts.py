"""Facts of one run of a stage: what cannot be the same in the next one, and is no part of the result."""

import os
import platform
import resource
import time
from pathlib import Path
from typing import Any

from nishiki.packages import loaded
from nishiki.threads import threads


class RunFacts:
    """Clocks and counters from the moment that a stage's imports are done."""

    def __init__(self) -> None:
        self.clock, self.cpu, self.read = time.perf_counter(), time.process_time(), bytes_read()

    def finish(self, capture: Path | None) -> dict[str, Any]:
        """All facts, at the end of the run.

        start_cpu_seconds: until the imports were done; bytes_read: since then, of files and from the cache of the
        operating system alike; packages: heavy ones that were loaded; threads: that the job was given.
        """
        usage = resource.getrusage(resource.RUSAGE_SELF)
        read = bytes_read()
        return {
            "seconds": round(time.perf_counter() - self.clock, 3),
            "cpu_seconds": round(time.process_time() - self.cpu, 3),
            "start_cpu_seconds": round(self.cpu, 3),
            "process_cpu_seconds": round(usage.ru_utime + usage.ru_stime, 3),
            "peak_memory_mib": round(peak_memory_kib() / 1024, 1),
            "bytes_read": None if read is None or self.read is None else read - self.read,
            "packages": list(loaded()),
            "finished": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "host": platform.node(),
            "platform": platform.platform(),
            "python": platform.python_version(),
            "cpus": os.cpu_count(),
            "threads": threads(),
            "capture": str(capture or ""),
        }


def bytes_read() -> int | None:
    """Bytes that this process has asked the operating system for; None where that is not told."""
    try:
        lines = Path("/proc/self/io").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) for line in lines if line.startswith("rchar:")), None)


def peak_memory_kib() -> int:
    """Peak of the resident memory of this program.

    ru_maxrss also counts the process that started this one, up to the moment at which it became this program: a small
    stage would show the memory of the workflow engine.
    """
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
