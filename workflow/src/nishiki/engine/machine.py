"""What a run on this machine may use: its memory, its processors, and how many threads a stage takes of them."""

from collections.abc import Iterable
from itertools import islice
from pathlib import Path

from nishiki.formats.bounds import machine_memory
from nishiki.threads import threads

SHARE_OF_MEMORY = 0.9
"""Of the machine's memory, for stages; the rest is the system's and the workflow's."""


def memory_arguments() -> list[str]:
    """Snakemake's arguments with which stages run side by side only as far as their expected memory fits the machine.

    A stage that is expected to need more than there is runs alone. Another option has to follow: --resources takes all
    words up to the next.
    """
    return ["--resources", f"mem_mb={int(machine_memory() * SHARE_OF_MEMORY / 2**20)}"]


def thread_arguments(cores: str | None, scenes: Iterable[Iterable[Path]]) -> list[str]:
    """Snakemake's arguments for one thread a stage, where enough scenes are unfinished to keep every processor at work.

    Parts of every stage have one thread only: scenes side by side use processors better than threads of one scene do.
    cores: as on the command line. scenes: manifests of all artifacts of each scene.
    """
    processors = int(cores) if cores and cores.isdecimal() else threads()
    unfinished = (True for manifests in scenes if not all(path.is_file() for path in manifests))
    return ["--max-threads", "1"] if sum(islice(unfinished, processors)) == processors else []
