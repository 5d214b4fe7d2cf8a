"""Give the rules paths, inputs, parameters, memory, time and threads of every job, without importing Snakemake."""

import math
import os
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import islice
from pathlib import Path

from nishiki.artifacts import provenance
from nishiki.artifacts.artifact import MANIFEST
from nishiki.engine import plan as planning
from nishiki.engine.project import CONFIGURATION, SWEEPS, Scene, load_project, scene_facts, scene_with_exports
from nishiki.errors import UserError, describe_machine_error, require, unknown_scene
from nishiki.formats.files import machine_memory
from nishiki.stages.base import SceneFacts
from nishiki.stages.table import CHAIN
from nishiki.threads import threads

SHARE_OF_MEMORY = 0.9
"""Share of the machine's memory for stages; the rest is for the system and the workflow."""


def memory_arguments() -> list[str]:
    """Return Snakemake's arguments that run stages side by side only as far as their expected memory fits the machine.

    A stage that is expected to need more than there is runs alone. Another option has to follow: --resources takes all
    words up to the next.
    """
    return ["--resources", f"mem_mb={int(machine_memory() * SHARE_OF_MEMORY / 2**20)}"]


def thread_arguments(cores: str | None, scenes: Iterable[Iterable[Path]]) -> list[str]:
    """Return Snakemake's arguments for one thread a stage, where unfinished scenes can keep every processor at work.

    Parts of every stage have one thread only: scenes side by side use processors better than threads of one scene do.
    cores: as on the command line. scenes: manifests of all artifacts of each scene.
    """
    processors = int(cores) if cores and cores.isdecimal() else threads()
    unfinished = (True for manifests in scenes if not all(path.is_file() for path in manifests))
    return ["--max-threads", "1"] if sum(islice(unfinished, processors)) == processors else []


SHORT_SECONDS = 120
"""Jobs that are expected to take less than this share one job of a cluster with their neighbours."""
TIME_MARGIN = 4
"""Ratio of a job's time limit to its expected time."""
PART_SECONDS, MOST_PARTS = 900, 64
"""scatter: auto makes parts that take about this time, and at most so many."""
PARTS = ".parts"
"""Folder of the results that holds the parts of divided stages until they are joined."""


class Scheduling:
    """Costs, groups and parts of the jobs of all plans; a part of `nishiki.engine.workflow.Workflow`."""

    plans: Mapping[str, planning.Plan]
    results: str

    def stage(self, scene: str, stage: str, key: str) -> planning.PlannedStage:
        """Return the planned stage of a scene that has this key."""
        raise NotImplementedError

    def memory_mb(self, scene: str, stage: str, attempt: int = 1, *, beside: int = 0) -> int:
        """Estimate the memory of a stage, or of a part of it, in MiB; half as much again at each further attempt.

        beside: memory of what runs beside the stage in its job.
        """
        plan = self.plans[scene]
        pixels, samples = self._size(scene, stage)
        tile = min(plan.scene.settings.ingest.tile_mib, samples * plan.facts.channels * 4 / 2**20)
        memory = CHAIN[stage].cost(plan.facts).memory_mb(pixels, samples, tile_mib=tile)
        return math.ceil((memory + beside) * 1.5 ** (attempt - 1))

    def seconds(self, scene: str, stage: str, share: float = 1.0) -> float:
        """Estimate the processor time of a share of a stage's work, in seconds."""
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
        """List the folders of the parts that a stage is joined from; none where it is not divided."""
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
        """Return whether the stage, or a part of it where it is divided, is a job of its own."""
        return self.seconds(scene, stage, 1 / self.parts(scene, stage)) > SHORT_SECONDS

    @cache  # noqa: B019  one Workflow a process
    def _level(self, scene: str, stage: str, key: str) -> int:
        """Count the long stages on the longest way from the capture to a stage."""
        levels = [0]
        for name, above in self.stage(scene, stage, key).upstream.items():
            of, upstream = provenance.place_above(scene, name)
            if upstream in CHAIN:  # the fields of a mosaic are jobs of their own
                levels.append(self._level(of, upstream, above) + (of != scene or self._is_long(of, upstream)))
        return max(levels)

    def _size(self, scene: str, stage: str) -> tuple[int, int]:
        """Count the pixels of a photograph for a stage, and samples of all photographs: ingest decodes whole ones."""
        facts = self.plans[scene].facts
        pixels = facts.pixels if stage == "ingest" else facts.kept_pixels or facts.pixels
        return pixels, pixels * facts.observations


LEAVE_OUT = "NISHIKI_LEAVE_OUT_REFUSED"
"""Environment variable: Snakemake leaves out scenes that cannot be planned; the command line has named them."""


class Plans(Mapping):
    """Plans by scene, each made when it is first asked for: a job of one scene among thousands needs one."""

    def __init__(self, names: list[str], make: Callable[[str], planning.Plan]):
        self._names: dict[str, planning.Plan | None] = dict.fromkeys(names)
        self._make = make

    def __getitem__(self, name: str) -> planning.Plan:
        plan = self._names[name]
        if plan is None:
            plan = self._names[name] = self._make(name)
        return plan

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def take_out_refused(self) -> dict[str, str]:
        """Make all plans; scenes that cannot be planned are taken out and returned with the reason."""
        refused = {}
        for name in list(self._names):
            try:
                self[name]
            except UserError as error:
                refused[name] = str(error)
            except OSError as error:
                message = describe_machine_error(error)
                if message is None:
                    raise
                refused[name] = f"scene {name!r}: {message}"
        for name in refused:
            del self._names[name]
        return refused


class Workflow(Scheduling):
    """All plans of a configuration, and the paths, inputs and parameters of the rules."""

    def __init__(
        self,
        configuration: dict | None = None,
        *,
        only: Sequence[str] = (),
        lazy: bool = False,
        file: str | Path = CONFIGURATION,
        leave_out_refused: bool = False,
    ):
        """Plan all scenes, or `only` some of them.

        lazy: each when it is first asked for; file: where the configuration stands, for messages; leave_out_refused:
        scenes that cannot be planned are left out and noted in `refused`, as long as another one can. Raises UserError
        for bad input.
        """
        self.project = load_project(configuration, path=Path(file))
        self.results = str(self.project.results)
        for name in only:
            if name not in self.project.scenes:
                raise UserError(unknown_scene(name, self.project.scenes))
        self.sweep: planning.PlannedSweep | None = None
        self._swept: dict[tuple[str, str, str], planning.PlannedStage] = {}
        self._known_facts: dict[tuple[Path, Path | None], SceneFacts] = {}
        scenes = [self.project.scenes[name] for name in only or self.project.scenes]
        names = dict.fromkeys(each.name for scene in scenes for each in scene.with_fields)
        plans = Plans(list(names), self._plan)
        self.plans: Mapping[str, planning.Plan] = plans
        self.refused: dict[str, str] = {}
        if self.project.configuration.sweep:
            # a scene's own plan is that of its first variant, the scene as it is configured
            self.sweep = planning.plan_sweep(self.project.configuration.sweep, self.project, self._facts)
            self.plans = {swept.scene: swept.variants[0].plan for swept in self.sweep.scenes}
            for swept in self.sweep.scenes:
                for variant in swept.variants:
                    self._swept |= {
                        (swept.scene, name, planned.key): planned for name, planned in variant.plan.stages.items()
                    }
        elif leave_out_refused:
            self.refused = plans.take_out_refused()
            if not plans:
                raise UserError("\n".join(self.refused.values()))
        elif not lazy:
            dict(plans)

    def _facts(self, scene: Scene) -> SceneFacts:
        place = (scene.capture, scene.truth)
        if place not in self._known_facts:  # scenes may share a capture
            self._known_facts[place] = scene_facts(scene)
        return self._known_facts[place]

    def _plan(self, name: str) -> planning.Plan:
        scene = self.project.scenes[name]
        facts = self._facts(scene)
        if formats := self.project.configuration.exports.get(name):
            scene = scene_with_exports(scene, facts.geometry, formats)
        return planning.make_plan(
            scene, facts, {field: self.plans[provenance.scene_of_field(name, field)] for field in facts.fields}
        )

    def can_be_planned(self, scene: str) -> bool:
        """Return whether a lazy plan can be made; asked only where scenes that cannot are to be left out."""
        if LEAVE_OUT not in os.environ:
            return True
        try:
            return bool(self.plans[scene])
        except (UserError, OSError):
            return False

    def stage(self, scene: str, stage: str, key: str) -> planning.PlannedStage:
        """Return the planned stage of a scene that has this key, in any of the scene's plans."""
        plan = self.plans.get(scene)
        planned = plan.stages.get(stage) if plan else None
        if planned is None or planned.key != key:
            planned = self._swept.get((scene, stage, key))
        if planned is None:
            raise UserError(f"{self.results}/{scene}/{stage}/{key}: not part of the present configuration")
        return planned

    def list_planned(self, sweeps: Sequence[str] = ()) -> set[tuple[str, str, str]]:
        """Return (scene, stage, key) of everything that the configuration requires.

        It covers its scenes, its blocks of sweeps, and these sweeps with files of their own.
        """
        places = set(self._swept)
        for scene, plan in self.plans.items():
            places |= {(scene, name, stage.key) for name, stage in plan.stages.items()}
        for named in (*self.project.configuration.sweeps, *sweeps):
            for swept in planning.plan_sweep(named, self.project, self._facts).scenes:
                for variant in swept.variants:
                    places |= {(swept.scene, name, stage.key) for name, stage in variant.plan.stages.items()}
        return places

    def path(self, scene: str, stage: str, key: str) -> str:
        """Return the path of an artifact's manifest."""
        return f"{self.results}/{scene}/{stage}/{key}/{MANIFEST}"

    def artifact(self, scene: str, stage: str) -> str:
        """Return the path of the manifest of a stage's artifact."""
        return self.path(scene, stage, self.plans[scene].stages[stage].key)

    def artifacts(self, scene: str) -> list[str]:
        """List the manifests of all stages of a scene."""
        return [self.artifact(scene, stage) for stage in self.plans[scene].stages]

    def inputs(self, scene: str, stage: str, key: str) -> list[str]:
        """List the manifests of the artifacts that a stage reads."""
        return list(self.above(scene, self.stage(scene, stage, key)).values())

    def above(self, scene: str, planned: planning.PlannedStage) -> dict[str, str]:
        """Map the names under which a stage of a scene reads artifacts to their manifests."""
        return {
            name: self.path(*provenance.place_above(scene, name), key)
            for name, key in planned.upstream.items()
            if name != "capture"
        }

    def source(self, scene: str, stage: str) -> str:
        """Return the arguments for inputs outside the results: the capture, the truth."""
        of = self.plans[scene].scene
        if stage == "ingest":
            return shlex.join(["--capture", _no_option(of.capture)])
        if CHAIN[stage].asked_as == "evaluate" and of.truth:
            return shlex.join(["--truth", _no_option(of.truth)])
        return ""

    @cache  # noqa: B019  one Workflow a process
    def code(self, stage: str) -> str:
        """Return the digest of a stage's code."""
        return provenance.code_digest(provenance.program_of(stage))

    def libraries(self, scene: str, stage: str, key: str) -> str:
        """Return the versions of the libraries that a stage loads in this scene."""
        return provenance.canonical(
            {name: provenance.library_version(name) for name in self.stage(scene, stage, key).packages}
        )

    def stages_text(self, scene: str) -> str:
        """Write the stages and keys of a scene as canonical JSON."""
        return provenance.canonical({name: planned.key for name, planned in self.plans[scene].stages.items()})

    def sweep_path(self, name: str) -> str:
        """Return the path of a file of the sweep's results."""
        return f"{self.results}/{SWEEPS}/{self.sweep.name if self.sweep else '-'}/{name}"

    def timing(self, scene: str, stage: str, key: str, number: int | str) -> str:
        """Return the path of the record of one repeat of a stage."""
        return f"{self.results}/{SWEEPS}/{planning.TIMINGS}/{scene}/{stage}/{key}/{number}.json"

    def timings(self, swept: planning.SceneSweep, variant: planning.PlannedVariant) -> dict[str, list[str]]:
        """List the records of all repeats of the counted stages of a variant, by stage."""
        numbers = range(1, require(self.sweep).settings.repeats + 1)
        planned = variant.plan.stages
        return {
            name: [self.timing(swept.scene, name, planned[name].key, number) for number in numbers]
            for name in swept.counted
            if name in planned
        }

    def evaluation(self, swept: planning.SceneSweep, variant: planning.PlannedVariant) -> str:
        """Return the manifest of the evaluation of a variant."""
        return self.path(swept.scene, swept.evaluation, variant.plan.stages[swept.evaluation].key)

    def sweep_inputs(self) -> list[str]:
        """List the files that the page of the sweep is made from."""
        pairs = [(swept, variant) for swept in self.sweep.scenes for variant in swept.variants] if self.sweep else []
        inputs = [self.evaluation(*pair) for pair in pairs]
        inputs += [path for pair in pairs for paths in self.timings(*pair).values() for path in paths]
        return list(dict.fromkeys(inputs))

    def sweep_text(self) -> str:
        """Return the dependencies of the sweep's page beside its inputs: settings, names and keys of the variants."""
        if self.sweep is None:
            return ""
        variants = {
            swept.scene: [[variant.names, self.evaluation(swept, variant)] for variant in swept.variants]
            for swept in self.sweep.scenes
        }
        return provenance.canonical({"settings": self.sweep.settings.model_dump(mode="json"), "variants": variants})


def _no_option(path: Path) -> str:
    """Return a path as an argument that cannot be taken for an option."""
    return f"./{path}" if str(path).startswith("-") else str(path)
