"""What the rules ask of the plans: keys to paths, inputs, parameters and resources. Knows nothing of Snakemake."""

import os
import shlex
from functools import cache
from pathlib import Path

from nishiki.artifact import MANIFEST
from nishiki.errors import UserError
from nishiki.facts import scene_facts
from nishiki.plan import Plan, PlannedStage, make_plan
from nishiki.project import load_project
from nishiki.provenance import canonical, code_digest, library_version
from nishiki.stages import CHAIN


class Workflow:
    """All plans of a configuration, and what follows from them for the rules."""

    def __init__(self, configuration: dict | None = None, *, folder: str | Path = ".", only: str | None = None):
        self.folder = Path(folder)
        self.project = load_project(configuration)
        self.results = str(self.project.results)
        if only and only not in self.project.scenes:
            raise UserError(f"no scene {only!r} in the scene table; scenes: {', '.join(self.project.scenes)}")
        self.plans: dict[str, Plan] = {
            name: make_plan(scene, scene_facts(scene))
            for name, scene in self.project.scenes.items()
            if only in (None, name)
        }

    def stage(self, scene: str, stage: str, key: str) -> PlannedStage:
        """The planned stage of a scene that has this key."""
        planned = self.plans[scene].stages.get(stage) if scene in self.plans else None
        if planned is None or planned.key != key:
            raise UserError(f"{self.results}/{scene}/{stage}/{key}: not part of the present configuration")
        return planned

    def artifact(self, scene: str, stage: str) -> str:
        """Path of the manifest of a stage's artifact."""
        return f"{self.results}/{self.plans[scene].folder(stage)}/{MANIFEST}"

    def artifacts(self, scene: str) -> list[str]:
        """Manifests of all stages of a scene."""
        return [self.artifact(scene, stage) for stage in self.plans[scene].stages]

    def inputs(self, scene: str, stage: str, key: str) -> list[str]:
        """Manifests of the artifacts that a stage reads."""
        planned = self.stage(scene, stage, key)
        return [self.artifact(scene, upstream) for upstream in planned.upstream if upstream in CHAIN]

    def source(self, scene: str, stage: str) -> str:
        """Arguments that name what lies outside the results: the capture, the truth."""
        of = self.plans[scene].scene
        if stage == "ingest":
            return f"--capture {shlex.quote(str(of.capture))}"
        if CHAIN[stage].asked_as == "evaluate" and of.truth:
            return f"--truth {shlex.quote(str(of.truth))}"
        return ""

    @cache  # noqa: B019  one Workflow a process
    def code(self, stage: str) -> str:
        """Digest of a stage's code."""
        return code_digest(self.folder / "scripts" / f"{stage}.py")

    @cache  # noqa: B019
    def libraries(self, stage: str) -> str:
        """Versions of the libraries that a stage uses."""
        return canonical({name: library_version(name) for name in CHAIN[stage].libraries})

    def stages_text(self, scene: str) -> str:
        """Stages and keys of a scene, as canonical JSON."""
        return canonical({name: planned.key for name, planned in self.plans[scene].stages.items()})

    def memory_mb(self, scene: str, stage: str) -> int:
        """Memory that a stage may take, from its cost model."""
        facts = self.plans[scene].facts
        return CHAIN[stage].memory_mb(facts.pixels, facts.observations)

    def minutes(self, scene: str, stage: str) -> int:
        """Minutes that a stage may take, from its cost model."""
        facts = self.plans[scene].facts
        return CHAIN[stage].minutes(facts.pixels, facts.observations)

    def relative_results(self) -> str:
        """Results folder relative to the working folder, for messages."""
        return os.path.relpath(self.results)
