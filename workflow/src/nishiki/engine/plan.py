"""Plan a scene, and the variants of a sweep: which stages run under which keys, and what is omitted and why.

What `PARTS` does not name (the photographs that a fit needs, their white boards and dark frames, tables, spectra,
masks) is always read.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from nishiki.artifacts.declaration import Closed, parse
from nishiki.artifacts.provenance import canonical, differences, key_of_text
from nishiki.engine.project import Project, Scene, Shared, load_yaml, scene_with
from nishiki.errors import UserError
from nishiki.installation import EXTRAS
from nishiki.observations.region import LIGHT
from nishiki.stages.base import SceneFacts, SceneSettings, Stage
from nishiki.stages.table import CHAIN, chain_of
from nishiki.sweep.variants import AS_CONFIGURED, SweepSettings, Variant, expand, nest_settings

PARTS = {
    "check": "photographs under check lights",
    "flat": "flat frames",
    "states": "photographs through the other polariser states",
    "white_states": "white boards through polarisers",
    "photographs": "photographs of the object",
    "calibration": "pictures of the calibration board",
    "silhouettes": "silhouettes",
    "mesh": "the mesh file",
    "scans": "range scans",
    "oblique": "photographs with the light away from the normal",
}
"""Every part that can be left out, by its name in the setting `ingest.without`."""


def idle_reason(stage: Stage, package: str, facts: SceneFacts, settings: SceneSettings) -> str | None:
    """Return why a stage does not load one of its libraries in this scene; None where it does."""
    reason = stage.unused_packages.get(package)
    return reason(facts, settings) if reason else None


UNREAD = "no stage of the plan looks at them"
HOLD_OUT_FROM = 16
"""From this number of lights or views, some are held out where nothing else can check the result."""


@dataclass(frozen=True)
class PlannedStage:
    """One stage of a scene's plan: its key decides where the artifact lies."""

    name: str
    key: str
    settings: dict[str, Any]
    upstream: dict[str, str]
    # those of its libraries that it loads in this scene; only their versions can change its result
    packages: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plan:
    """Stages of a scene in the order of the flow, and what is left out with the reason."""

    scene: Scene
    facts: SceneFacts
    stages: dict[str, PlannedStage]
    left_out: dict[str, str] = field(default_factory=dict)
    held_out: tuple[str, ...] = ()
    # of each stage, those of its libraries that it loads in this scene
    packages: dict[str, tuple[str, ...]] = field(default_factory=dict)
    unused_packages: dict[str, str] = field(default_factory=dict)  # heavy packages that none does

    def folder(self, stage: str) -> str:
        """Return the path of a stage's artifact below the results folder."""
        return f"{self.scene.name}/{stage}/{self.stages[stage].key}"


def make_plan(scene: Scene, facts: SceneFacts, fields: Mapping[str, Plan] = MappingProxyType({})) -> Plan:
    """Plan a scene: the stages that its products reach and its capture can feed; fields: plans of a mosaic's, by name.

    Raises UserError where a product that was asked for by name cannot be made, with the reason.
    """
    if facts.fields:
        expect_of_mosaic(scene)
    chain = chain_of(facts.geometry)
    held_out = held_out_of(scene.settings.hold_out, scene, facts)
    settings: dict[str, Closed] = {}
    decided = {"hold_out": held_out, "truth_sha256": facts.truth_sha256, "positions_mm": dict(facts.fields)}
    for name in chain:
        given = getattr(scene.settings, name)
        update = {key: value for key, value in decided.items() if key in type(given).model_fields}
        settings[name] = given.model_copy(update=update | CHAIN[name].filled(given, scene.settings))
    left_out: dict[str, str] = {}
    needed: set[str] = set()
    joined = {  # stages of the fields, and the stage in which later ones find them
        each: name
        for name, stage in chain.items()
        for each in stage.stands_for
        if all(each in plan.stages for plan in fields.values())
    }
    for product in scene.products:
        stage = next((name for name in chain if product in (name, chain[name].product)), joined.get(product))
        if stage is None:
            left_out[product] = f"captures of a {facts.geometry} have no such stage"
        else:
            _reach(stage, facts, settings, needed, left_out, joined)
    if not needed:
        raise UserError(
            f"scene {scene.name!r}: nothing to make: {'; '.join(f'{name}: {why}' for name, why in left_out.items())}"
        )
    for name in chain:
        if name not in needed and name not in left_out:
            left_out[name] = "no product asked for needs it"
    if "ingest" in needed:
        settings["ingest"], reasons = _read_by_ingest(scene, facts, settings, needed, held_out)
        left_out |= reasons
    packages = {
        name: tuple(each for each in stage.libraries if idle_reason(stage, each, facts, settings) is None)
        for name, stage in chain.items()
        if name in needed
    }
    loaded = {package for names in packages.values() for package in names}
    unused: dict[str, str] = {}  # optional packages of the chain, with reasons
    for each in chain.values():
        for package in each.libraries:
            if package in EXTRAS and package not in loaded and package not in unused:
                why = idle_reason(each, package, facts, settings) if each.name in packages else None
                unused[package] = why or f"{each.name} is not in the plan"
    keys = {"capture": facts.capture_digest}
    stages: dict[str, PlannedStage] = {}
    for name in packages:
        if chain[name].asked_as == "report":
            reasons_shown = left_out | {f"package {package}": why for package, why in unused.items()}
            settings[name] = settings[name].model_copy(update={"left_out": reasons_shown})
        values = settings[name].model_dump(mode="json")
        named = (*CHAIN[name].requires, *CHAIN[name].optional_inputs(settings[name]), *CHAIN[name].uses)
        reads = {joined.get(other, other) for other in named}
        before = ["capture"] if name == "ingest" else [other for other in CHAIN if other in reads and other in stages]
        upstream = {other: keys[other] for other in before}
        for part, plan in fields.items():
            upstream |= {f"{part}/{each}": plan.stages[each].key for each in joined if joined[each] == name}
        keys[name] = key_of_text(name, CHAIN[name].version, canonical(values), upstream)
        stages[name] = PlannedStage(name, keys[name], values, upstream, packages[name])
    return Plan(scene, facts, stages, left_out, held_out, packages, unused)


def expect_of_mosaic(scene: Scene) -> None:
    """Raise UserError where settings ask of a mosaic what fields alone can give."""
    asked, own = scene.settings, "give the capture of a field a scene of its own"
    relight = "export" in scene.products and "relight" in asked.export.formats
    for wrong, what, remedy in (
        (asked.normals.given, "normals.given: one picture cannot hold the normals of every field", "leave it out"),
        (
            asked.hold_out not in ("auto", "none"),
            "hold_out: joined maps leave no lights out",
            f"leave it out, or {own}",
        ),
        (relight, "export.formats: relight is fitted to photographs, which fields have", f"take it out, or {own}"),
    ):
        if wrong:
            raise UserError(f"scene {scene.name!r}, a mosaic: {what}. Remedy: {remedy}")


def _read_by_ingest(
    scene: Scene, facts: SceneFacts, settings: dict[str, Closed], needed: set[str], held_out: tuple[str, ...]
) -> tuple[Closed, dict[str, str]]:
    """Set the channels and the parts of the capture that ingest reads by the needs of the stages."""
    ingest: Any = settings["ingest"]
    reasons: dict[str, str] = {}
    if ingest.channels == "auto":
        colour = any(CHAIN[name].needs_colour for name in needed) and facts.channels > 1
        ingest = ingest.model_copy(update={"channels": "all" if colour else "luminance"})
        if not colour and facts.channels > 1:
            reasons["colour"] = "no product asked for needs more than luminance: one channel is decoded and kept"
    looked = {part for stage in needed for part in CHAIN[stage].capture_parts(facts, settings, scene.products)}
    without = tuple(part for part in PARTS if facts.parts.get(part) and part not in looked)
    named = [f"{facts.parts[part]} {PARTS[part]}" for part in without]
    if held_out and facts.geometry == "plane" and not {"evaluate", "export"} & needed:
        without += tuple(f"{LIGHT}{name}" for name in held_out)
        named.append(f"{len(held_out)} photographs under the lights held out")
    return ingest.model_copy(update={"without": without}), reasons | dict.fromkeys(named, UNREAD)


def held_out_of(choice: str | tuple[str, ...], scene: Scene, facts: SceneFacts) -> tuple[str, ...]:
    """List the lights, or views of a turntable, that are kept from every fit and predicted instead.

    auto: a tenth of at least 16 lights, a twelfth of at least 16 views, where neither truth nor check lights exist.
    """
    if choice == "none" or facts.fields:
        return ()
    series, what = facts.series, "view" if facts.geometry == "turntable" else "light"
    if choice == "auto":
        if "evaluate" not in scene.products or facts.truth_sha256 or facts.check_lights:
            return ()
        every = 12 if what == "view" else 10
        return series[5::every] if len(series) >= HOLD_OUT_FROM else ()
    unknown = [name for name in choice if name not in series]
    if unknown:
        raise UserError(f"scene {scene.name!r}: hold_out names {what} {unknown[0]!r}; {what}s: {', '.join(series)}")
    if len(series) - len(choice) < 3:
        raise UserError(f"scene {scene.name!r}: hold_out leaves {len(series) - len(choice)} {what}s; 3 are needed")
    return tuple(choice)


def _reach(
    name: str, facts: SceneFacts, settings: dict, needed: set[str], left_out: dict[str, str], joined: dict[str, str]
) -> bool:
    """Add a stage and what it needs to the plan; False, with the reason noted, where the capture cannot feed it."""
    name = joined.get(name, name)
    if name in needed:
        return True
    known = name in settings
    reason = (
        CHAIN[name].missing_inputs(facts, settings[name])
        if known
        else f"captures of a {facts.geometry} have no such stage"
    )
    if reason:
        left_out[name] = reason
        return False
    for upstream in CHAIN[name].requires:
        if not _reach(upstream, facts, settings, needed, left_out, joined):
            left_out[name] = f"it needs {upstream}, which is left out: {left_out[upstream]}"
            return False
    for upstream in CHAIN[name].optional_inputs(settings[name]):
        _reach(upstream, facts, settings, needed, left_out, joined)
    needed.add(name)
    return True


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
    """Plan all variants of all scenes of a sweep. Raises UserError naming the sweep, the variant and the remedy."""
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
    common = shared | nest_settings(rest, sweep.stage, CHAIN, f"{named}: settings")
    below = scene_with(scene, common, f"{named}: settings")
    facts = facts_of(scene)
    if facts.fields:
        remedy = f"Remedy: name one of its fields under scenes: {scene.fields[0].name}"
        raise UserError(f"{named}: scene {scene.name!r} is a mosaic, of which variants cannot be compared. {remedy}")
    plans: dict[str, Plan] = {}
    for variant in variants:
        where = f"{named}: variant {variant.name!r}"
        changed = replace(scene_with(below, variant.overrides, where), products=("evaluate",))
        try:
            plans[variant.name] = make_plan(changed, facts)
        except UserError as error:
            raise UserError(
                f"{where}: scene {scene.name!r} has no evaluation, so that there is no error to compare ({error}). "
                "Remedy: give it a truth, check lights or check views, or hold_out"
            ) from None
    stages = next(iter(plans.values())).stages
    evaluation = next(name for name in stages if CHAIN[name].asked_as == "evaluate")
    reference = plans[sweep.default or AS_CONFIGURED]
    # variants with the same evaluation key are one: all that it was made from is the same
    names: dict[str, list[str]] = {}
    for name, plan in plans.items():
        names.setdefault(plan.stages[evaluation].key, []).append(name)
    merged = []
    for group in names.values():
        plan = plans[group[0]]
        before, after = ({name: stage.settings for name, stage in made.stages.items()} for made in (reference, plan))
        merged.append(PlannedVariant(tuple(group), plan, tuple(differences(before, after))))
    counted = _list_varied_stages(named, sweep, plans, evaluation)
    return SceneSweep(scene.name, facts, tuple(merged), evaluation, counted)


def _list_varied_stages(named: str, sweep: SweepSettings, plans: dict[str, Plan], evaluation: str) -> tuple[str, ...]:
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
    """List the stages that a stage reads, directly or not."""
    stages: set[str] = set()
    queue = [stage]
    while queue:
        for upstream in plan.stages[queue.pop()].upstream:
            if upstream in CHAIN and upstream not in stages:
                stages.add(upstream)
                queue.append(upstream)
    return stages


def _flow(names: set[str]) -> list[str]:
    """Sort stages into the order of the flow."""
    return [name for name in CHAIN if name in names]
