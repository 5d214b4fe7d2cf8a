"""Estimate memory, time and threads of each job for the scheduler, on this machine."""

import math
from collections.abc import Iterable, Mapping
from functools import cache
from itertools import islice
from pathlib import Path

from nishiki.artifacts.provenance import place_above
from nishiki.engine.plan import Plan, PlannedStage
from nishiki.formats.files import machine_memory
from nishiki.stages.table import CHAIN
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


SHORT_SECONDS = 120
"""Jobs that are expected to take less than this share one job of a cluster with their neighbours."""
TIME_MARGIN = 4
"""Time limit over expected time."""
PART_SECONDS, MOST_PARTS = 900, 64
"""scatter: auto makes parts that take about this time, and at most so many."""
PARTS = ".parts"
"""Folder of the results that holds the parts of divided stages until they are joined."""


class Scheduling:
    """Costs, groups and parts of the jobs of all plans; a part of `nishiki.engine.workflow.Workflow`."""

    plans: Mapping[str, Plan]
    results: str

    def stage(self, scene: str, stage: str, key: str) -> PlannedStage:
        """Return the planned stage of a scene that has this key."""
        raise NotImplementedError

    def memory_mb(self, scene: str, stage: str, attempt: int = 1, *, beside: int = 0) -> int:
        """Memory that a stage, or a part of it, may take, in MiB; half as much again at each further attempt.

        beside: memory of what runs beside the stage in its job.
        """
        plan = self.plans[scene]
        pixels, samples = self._size(scene, stage)
        tile = min(plan.scene.settings.ingest.tile_mib, samples * plan.facts.channels * 4 / 2**20)
        memory = CHAIN[stage].cost(plan.facts).memory_mb(pixels, samples, tile_mib=tile)
        return math.ceil((memory + beside) * 1.5 ** (attempt - 1))

    def seconds(self, scene: str, stage: str, share: float = 1.0) -> float:
        """Processor time that a share of a stage's work is expected to take, in seconds."""
        pixels, samples = self._size(scene, stage)
        return CHAIN[stage].cost(self.plans[scene].facts).processor_seconds(pixels * share, samples * share)

    def minutes(self, scene: str, stage: str, attempt: int = 1, share: float = 1.0) -> int:
        """Time limit for a scheduler, in minutes: slower machines and waiting for disks are allowed for."""
        return math.ceil((2 + TIME_MARGIN * self.seconds(scene, stage, share) / 60) * 2 ** (attempt - 1))

    def parts(self, scene: str, stage: str) -> int:
        """Return the number of parts of a stage; 1: it is not divided."""
        scatter = self.plans[scene].scene.settings.scatter
        if not CHAIN[stage].scatter or scatter == "none":
            return 1
        if scatter == "auto":
            return min(MOST_PARTS, max(1, round(self.seconds(scene, stage) / PART_SECONDS)))
        return scatter.get(stage, 1)

    def part_paths(self, scene: str, stage: str, key: str) -> list[str]:
        """Folders of the parts that a stage is joined from; none where it is not divided."""
        total = self.parts(scene, stage)
        folder = f"{self.results}/{PARTS}/{scene}/{stage}/{key}"
        return [f"{folder}/{number}-of-{total}" for number in range(1, total + 1)] if total > 1 else []

    def group(self, scene: str, stage: str, key: str, *, part: bool = False) -> str | None:
        """Name of the group of short jobs that a cluster runs as one; None for a long one.

        A group holds the short jobs between two long ones, so that no way leaves a group and comes back to it.
        part: of the parts of a divided stage; the stage itself then only joins them.
        """
        divided, long = self.parts(scene, stage) > 1, self._is_long(scene, stage)
        if long and (part or not divided):
            return None
        return f"level{self._level(scene, stage, key) + (long and not part)}"

    def _is_long(self, scene: str, stage: str) -> bool:
        """Whether the stage, or a part of it where it is divided, is a job of its own."""
        return self.seconds(scene, stage, 1 / self.parts(scene, stage)) > SHORT_SECONDS

    @cache  # noqa: B019  one Workflow a process
    def _level(self, scene: str, stage: str, key: str) -> int:
        """Count the long stages on the longest way from the capture to a stage."""
        levels = [0]
        for name, above in self.stage(scene, stage, key).upstream.items():
            of, upstream = place_above(scene, name)
            if upstream in CHAIN:  # the fields of a mosaic are jobs of their own
                levels.append(self._level(of, upstream, above) + (of != scene or self._is_long(of, upstream)))
        return max(levels)

    def _size(self, scene: str, stage: str) -> tuple[int, int]:
        """Pixels of a photograph that the stage sees, and samples of all photographs: ingest decodes whole ones."""
        facts = self.plans[scene].facts
        pixels = facts.pixels if stage == "ingest" else facts.kept_pixels or facts.pixels
        return pixels, pixels * facts.observations
