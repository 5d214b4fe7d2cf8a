"""The plans of a sweep: a plan for every variant of every scene, and which stages' time counts."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from nishiki.artifacts.closed import parse
from nishiki.artifacts.provenance import differences
from nishiki.engine.plan import Plan, make_plan
from nishiki.engine.project import Project, Scene, Shared, load_yaml, scene_with
from nishiki.errors import UserError
from nishiki.stages.base import SceneFacts
from nishiki.stages.table import CHAIN
from nishiki.sweep.settings import AS_CONFIGURED, SweepSettings, Variant, expand, nested

FILE_KEYS = ("configuration",)
"""What a sweep's file holds besides the sweep: the configuration with its scenes."""
TIMINGS = "timings"


@dataclass(frozen=True)
class PlannedVariant:
    """A variant of a scene. names: its own, and those of variants that come to the same artifacts."""

    names: tuple[str, ...]
    plan: Plan
    changes: tuple[str, ...]

    @property
    def name(self) -> str:
        """The name that says most: of several, the first that is not `as configured`."""
        return next((name for name in self.names if name != AS_CONFIGURED), AS_CONFIGURED)


@dataclass(frozen=True)
class SceneSweep:
    """All variants of one scene, the stage whose figures are compared, and the stages whose time counts."""

    scene: str
    facts: SceneFacts
    variants: tuple[PlannedVariant, ...]
    evaluation: str
    counted: tuple[str, ...]


@dataclass(frozen=True)
class PlannedSweep:
    """A sweep with all its plans."""

    name: str
    settings: SweepSettings
    scenes: tuple[SceneSweep, ...]


def read_sweep(named: str, project: Project) -> tuple[str, SweepSettings]:
    """Name and settings of a sweep: a file, or a block of the configuration's `sweeps`.

    Raises UserError naming the file or block, the key, and what was expected.
    """
    path = Path(named)
    if path.suffix in (".yaml", ".yml"):
        values = {key: value for key, value in load_yaml(path).items() if key not in FILE_KEYS}
        name, settings = path.stem, parse(SweepSettings, values, named)
    elif named in project.configuration.sweeps:
        name, settings = named, project.configuration.sweeps[named]
    else:
        known = ", ".join(project.configuration.sweeps) or "none"
        raise UserError(f"no sweep {named!r}: name a .yaml file, or a block of `sweeps` in the configuration ({known})")
    if name == TIMINGS or not name.isascii() or not name.replace("-", "").replace("_", "").isalnum():
        raise UserError(f"{named}: a sweep's name is made of letters, digits, - and _, and is not {TIMINGS!r}")
    return name, settings


def configuration_of(path: Path) -> str | None:
    """Return the configuration that a sweep's file names, relative to the working folder, or None."""
    name = load_yaml(path).get("configuration")
    if name is not None and not isinstance(name, str):
        raise UserError(f"{path}: configuration: expected the path of a configuration, found {name!r}")
    return name


def plan_sweep(named: str, project: Project, facts_of: Callable[[Scene], SceneFacts]) -> PlannedSweep:
    """Plans of all variants of all scenes of a sweep. Raises UserError naming the sweep, the variant and the remedy."""
    name, sweep = read_sweep(named, project)
    unknown = [scene for scene in sweep.scenes if scene not in project.scenes]
    if unknown:
        raise UserError(f"{named}: no scene {unknown[0]!r} in the scene table; scenes: {', '.join(project.scenes)}")
    if sweep.stage not in CHAIN:
        raise UserError(f"{named}: stage: unknown stage {sweep.stage!r}; stages: {', '.join(CHAIN)}")
    variants = expand(sweep, stages=CHAIN, where=named)
    every = [name for name, scene in project.scenes.items() if not scene.fields]  # variants of mosaics are not compared
    scenes = [project.scenes[scene] for scene in sweep.scenes or every]
    return PlannedSweep(name, sweep, tuple(_scene_sweep(named, sweep, variants, scene, facts_of) for scene in scenes))


def _scene_sweep(
    named: str, sweep: SweepSettings, variants: list[Variant], scene: Scene, facts_of: Callable[[Scene], SceneFacts]
) -> SceneSweep:
    shared = {key: value for key, value in sweep.settings.items() if key in Shared.model_fields}
    rest = {key: value for key, value in sweep.settings.items() if key not in shared}
    common = shared | nested(rest, sweep.stage, CHAIN, f"{named}: settings")
    below = scene_with(scene, common, f"{named}: settings")
    facts = facts_of(scene)
    if facts.fields:
        remedy = f"Remedy: name one of its fields under scenes: {scene.fields[0].name}"
        raise UserError(f"{named}: scene {scene.name!r} is a mosaic, of which variants cannot be compared. {remedy}")
    plans: dict[str, Plan] = {}
    for variant in variants:
        where = f"{named}: variant {variant.name!r}"
        changed = replace(scene_with(below, variant.overrides, where), products=("evaluate",))
        plans[variant.name] = _evaluated(changed, facts, where)
    stages = next(iter(plans.values())).stages
    evaluation = next(name for name in stages if CHAIN[name].asked_as == "evaluate")
    reference = plans[sweep.default or AS_CONFIGURED]
    return SceneSweep(
        scene.name, facts, _merged(plans, evaluation, reference), evaluation, _counted(named, sweep, plans, evaluation)
    )


def _evaluated(scene: Scene, facts: SceneFacts, where: str) -> Plan:
    try:
        return make_plan(scene, facts)
    except UserError as error:
        raise UserError(
            f"{where}: scene {scene.name!r} has no evaluation, so that there is no error to compare ({error}). Remedy: "
            "give it a truth, check lights or check views, or hold_out"
        ) from None


def _merged(plans: dict[str, Plan], evaluation: str, reference: Plan) -> tuple[PlannedVariant, ...]:
    """Variants with the same evaluation key are one: all that it was made from is the same."""
    names: dict[str, list[str]] = {}
    for name, plan in plans.items():
        names.setdefault(plan.stages[evaluation].key, []).append(name)
    variants = []
    for group in names.values():
        plan = plans[group[0]]
        before, after = ({name: stage.settings for name, stage in made.stages.items()} for made in (reference, plan))
        variants.append(PlannedVariant(tuple(group), plan, tuple(differences(before, after))))
    return tuple(variants)


def _counted(named: str, sweep: SweepSettings, plans: dict[str, Plan], evaluation: str) -> tuple[str, ...]:
    """List the stages that lead to the evaluation and differ between variants.

    The evaluation itself counts only where nothing else differs. A sweep may name its own stages.
    """
    known = {name for plan in plans.values() for name in plan.stages}
    if sweep.counted:
        wrong = [name for name in sweep.counted if name not in known]
        if wrong:
            raise UserError(
                f"{named}: counted names {wrong[0]!r}, which no variant runs; stages: {', '.join(_flow(known))}"
            )
        return tuple(_flow(set(sweep.counted)))
    leading = {name for plan in plans.values() for name in _before(plan, evaluation)}
    keys = {name: {plan.stages[name].key if name in plan.stages else "" for plan in plans.values()} for name in known}
    changed = [name for name in _flow(leading) if len(keys[name]) > 1]
    if not changed and len(keys[evaluation]) == 1:
        raise UserError(
            f"{named}: all variants come to the same results: the evaluation ({evaluation}) does not depend on these "
            f"settings of {sweep.stage}. Remedy: vary settings of {', '.join(_flow(leading)) or evaluation}"
        )
    return tuple(changed) or (evaluation,)


def _before(plan: Plan, stage: str) -> set[str]:
    """Stages that a stage reads, directly or not."""
    stages: set[str] = set()
    queue = [stage]
    while queue:
        for upstream in plan.stages[queue.pop()].upstream:
            if upstream in CHAIN and upstream not in stages:
                stages.add(upstream)
                queue.append(upstream)
    return stages


def _flow(names: set[str]) -> list[str]:
    """Stages in the order of the flow."""
    return [name for name in CHAIN if name in names]
