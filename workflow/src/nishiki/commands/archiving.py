"""Commands for the archive of results: verify, pack, prune."""

import json
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from nishiki.commands.declare import (
    CONFIGURATION,
    command,
    option,
    scene_argument,
    with_configuration,
    with_gone,
    with_json,
)
from nishiki.commands.inspecting import planned_workflow
from nishiki.errors import UserError, printable
from nishiki.installation import PROJECT
from nishiki.progress import Progress

if TYPE_CHECKING:
    from nishiki.archive.audit import AuditTargets, Counts, Damage
    from nishiki.archive.prune import Item, Place, Pruning
    from nishiki.artifacts.artifact import Artifact
    from nishiki.artifacts.packed import PackedScene
    from nishiki.engine.plan import Plan
    from nishiki.engine.workflow import Workflow


@command("verify", "verify results/altarpiece", "verify altarpiece-crate.zip", "verify --capture captures/altarpiece")
@click.argument("folders", nargs=-1, help="results, scene, stage, artifact or crate (default: results)")
@option("--capture FOLDER", "a sealed capture to verify as well", "captures", multiple=True)
@with_json
@option("--threads N", "threads that read files (default: one per processor)", type=int, default=0, show_default=False)
@option("--set-aside", "rename each damaged artifact, so that the next run makes it again")
def verify(folders, captures, as_json, threads, set_aside) -> int:
    """Recompute every digest, and name each damaged, missing or foreign file.

    Exit status 1 where anything is damaged, missing or foreign.
    """
    from nishiki.archive.audit import Counts, audit, find_artifacts
    from nishiki.archive.crate_audit import is_crate
    from nishiki.threads import threads as given_threads

    places = [Path(folder) for folder in folders or ["results"]]
    if not folders and captures and not places[0].is_dir():
        places = []  # the capture alone is asked for
    for folder in places:
        if not folder.is_dir() and not is_crate(folder):
            raise UserError(f"{folder}: neither a folder nor a ZIP file. Remedy: name the folder of the results")
    counts = Counts()
    threads = threads or given_threads()
    targets = find_artifacts(folder for folder in places if not is_crate(folder))
    crates = [*(folder for folder in places if is_crate(folder)), *targets.crates]
    for crate in crates:
        counts.problems += _verify_crate(crate, threads, as_json)
    if crates and not targets.artifacts and not captures:
        return 1 if counts.problems else 0
    if places and not crates and targets.empty and not captures:
        what = "neither an artifact nor a crate in it"
        raise UserError(f"{', '.join(map(str, places))}: {what}. Remedy: name results, a scene or a stage")
    unsound = set()
    for damage in audit(targets, counts, threads=threads, tell=Progress("verify")):
        _print_damage(damage, as_json)
        if damage.artifact is not None:
            unsound.add(damage.artifact)
    for capture in map(Path, captures):
        counts.problems += _verify_capture(capture, as_json)
    if places or as_json:
        _summary(targets, counts, as_json)
    if set_aside:
        from nishiki.engine.finished import set_aside as rename_aside

        for folder in sorted(unsound):
            if folder.is_dir() and not folder.is_symlink() and "." not in folder.name:
                print(f"set aside: {printable(str(folder))} as {printable(rename_aside(folder).name)}", file=sys.stderr)
    return 1 if counts.problems else 0


def _verify_capture(capture: Path, as_json: bool) -> int:
    """Verify a sealed capture; the number of problems."""
    from nishiki.archive.audit import Damage
    from nishiki.capture.seal import verify_seal
    from nishiki.formats.problems import group_problems

    problems = list(verify_seal(capture))
    for problem in group_problems(problems):
        _print_damage(Damage(capture, "damaged", str(problem)), as_json)
    if not as_json:
        print(f"{printable(str(capture))}: {amount(len(problems), 'problem') if problems else 'as it was sealed'}")
    return len(problems)


def _verify_crate(path: Path, threads: int, as_json: bool) -> int:
    """Verify a packed scene; the number of problems."""
    from nishiki.archive.crate_audit import CrateAudit, audit_crate

    audited = CrateAudit(path)
    problems = 0
    for damage in audit_crate(audited, threads=threads, tell=Progress(f"verify {printable(path.name)}")):
        problems += 1
        _print_damage(damage, as_json)
    if as_json:
        print(json.dumps({**asdict(audited), "root": str(path), "problems": problems, "sound": not problems}))
        return problems
    raw = "with its photographs" if audited.photographs else "without its photographs"
    state = amount(problems, "problem") if problems else "sound"
    fields = audited.capture.split(", ")
    capture = f"capture {audited.capture[:12]}" if len(fields) == 1 else f"{len(fields)} captures"
    print(
        f"{printable(str(path))}: scene {printable(audited.scene)}, {len(audited.stages)} results from {capture} "
        f"({raw}), {audited.files} files, {audited.bytes / 1e9:.3f} GB: {state}; "
        f"digest {audited.digest}"
    )
    return problems


def _print_damage(damage: "Damage", as_json: bool) -> None:
    if as_json:
        print(json.dumps({name: str(value or "") for name, value in asdict(damage).items()}))
    else:
        print(damage)


def _summary(targets: "AuditTargets", counts: "Counts", as_json: bool) -> None:
    if as_json:
        others = {"unfinished": len(targets.unfinished), "set_aside": len(targets.aside)}
        print(json.dumps({**asdict(counts), **others, "sound": not counts.problems}))
        return
    state = amount(counts.problems, "problem") if counts.problems else "sound"
    size = f"{counts.files} files, {counts.bytes / 1e9:.3f} GB"
    print(f"{amount(counts.artifacts, 'artifact')} verified, {size}: {state}")
    if targets.unfinished or targets.aside:
        unfinished, aside = len(targets.unfinished), len(targets.aside)
        print(f"not audited: {unfinished} unfinished folders, {aside} set aside; see ./nishiki prune")


def amount(count: int, thing: str) -> str:
    """Format a number of things in words."""
    return f"{count} {thing}{'s' * (count != 1)}"


@command(
    "pack altarpiece --output altarpiece-crate", "pack altarpiece --output altarpiece-crate --zip --without-capture"
)
@scene_argument
@option("--output FOLDER", "folder to make; must not exist", required=True)
@option("--without-capture", "leave the photographs out, and keep their names and digests")
@option("--zip", "also write the folder as a ZIP file beside it", "zipped")
@with_configuration
def pack(scene: str, output: str, without_capture: bool, zipped: bool, configfile: str) -> None:
    """Pack a finished scene, with all that it was made from, as an RO-Crate."""
    from nishiki.archive import pack as packing

    target = Path(output)
    flow = planned_workflow(configfile, scene)
    expect_outside(target, Path(flow.results))
    packed = replace(_scene(flow, scene, flow.plans[scene]), with_capture=not without_capture)
    tell = Progress(f"pack {scene}")
    digest = packing.pack(packed, PROJECT, target, tell=tell)
    print(f"{printable(str(target))}: {len(packed.artifacts)} results; digest {digest}")
    if zipped:
        archive = target.with_name(f"{target.name}.zip")
        packing.write_zip(target, archive)
        print(printable(str(archive)))


def expect_outside(target: Path, results: Path) -> None:
    """Raise a UserError where a crate would lie inside the results or a sealed capture, which nothing may change."""
    for parent in target.resolve().parents:
        if parent == results.resolve():
            raise UserError(f"{target}: inside the results ({results}). Remedy: another folder")
        if (parent / "bagit.txt").is_file():
            raise UserError(f"{target}: inside the sealed capture {parent}. Remedy: another folder")


def _scene(flow: "Workflow", name: str, plan: "Plan") -> "PackedScene":
    from nishiki.archive.crate import capture_method
    from nishiki.artifacts.packed import PackedScene
    from nishiki.capture.folder import load_capture
    from nishiki.capture.schema import ABOUT
    from nishiki.stages.table import CHAIN
    from nishiki.version import PROJECT_VERSION

    capture = plan.scene.capture
    described = load_capture(capture).settings
    artifacts = _artifacts(flow, plan)
    stages = {
        stage: {"key": planned.key, "settings": planned.settings, "upstream": planned.upstream}
        for stage, planned in plan.stages.items()
    }
    return PackedScene(
        name=name,
        version=PROJECT_VERSION,
        artifacts=artifacts,
        capture=capture,
        digest=plan.facts.capture_digest,
        about={key: getattr(described, key) for key in ABOUT},
        facts={
            "products": list(plan.scene.products),
            "stages": stages,
            "left_out": dict(plan.left_out),
            "held_out": list(plan.held_out),
            "truth_sha256": plan.facts.truth_sha256,
        },
        does={each.stage: CHAIN[each.stage].does for each in artifacts},
        method=capture_method(described),
    )


def _artifacts(flow: "Workflow", plan: "Plan") -> "list[Artifact]":
    """List the artifacts of a scene and of its fields, each made from those before it.

    Raises UserError where a run has to come first.
    """
    from nishiki.artifacts.artifact import open_artifact

    artifacts: dict[str, Artifact] = {}
    for scene in plan.scene.with_fields:
        for stage, planned in flow.plans[scene.name].stages.items():
            path = flow.artifact(scene.name, stage)
            try:
                artifacts[path] = open_artifact(Path(path))
            except UserError as error:
                raise UserError(f"{scene.name} is not finished: {error}") from None
            for above, other in flow.above(scene.name, planned).items():
                if artifacts[other].digest != artifacts[path].manifest["upstream"][above].get("digest"):
                    raise UserError(f"{artifacts[path].folder}: made from another {above}. Remedy: ./nishiki run first")
    return list(artifacts.values())


@command("prune", "prune --delete")
@option("--configfile FILE", f"configuration (repeatable; default: {CONFIGURATION})", "configfiles", multiple=True)
@option("--sweep FILE", "file of a sweep whose results are kept (repeatable)", "sweeps", multiple=True)
@option("--unnamed", "also scenes, and results of sweeps, that no given configuration names")
@option("--delete", "remove what is listed")
@with_json
@with_gone
def prune(configfiles, sweeps, unnamed, delete, as_json, gone) -> int:
    """List results that no configuration references; --delete removes them.

    Exit status 1 where something that was to be removed could not be.
    """
    from nishiki.archive.prune import decide
    from nishiki.engine.running_lock import records, refuse_while_running, register_run

    status = 0
    for results, planned, known in _list_references(configfiles or (CONFIGURATION,), sweeps):
        if not results.is_dir():
            raise UserError(f"{results}: folder not found; there is nothing to prune")
        _refuse_unknown_sweeps(results, known, unnamed)
        decision = {"unnamed": unnamed, "hosts": gone}
        if not delete:
            for record in records(results):
                if record.state in ("alive", "elsewhere"):
                    _note(f"{results}: a run may be alive, --delete would refuse: {record}")
            _tell(decide(results, planned, **decision), as_json)
            continue
        refuse_while_running(results, "nothing is removed")
        scenes = [path.name for path in results.iterdir() if path.is_dir() and not path.name.startswith(".")]
        with register_run(results, scenes, gone=gone, tell=_note) as held:
            status = max(status, _delete(decide(results, planned, **decision), as_json))
            # What a killed run may have torn is for the next run to look at, not forgotten here.
            held.ended = "pruned" if held.unclean else "done"
    return status


def _list_references(
    configurations: tuple[str, ...], sweeps: tuple[str, ...]
) -> "list[tuple[Path, set[Place], set[str]]]":
    """List results folders, the artifacts that all configurations and sweeps name, and the names of the sweeps."""
    from nishiki.engine.plan import configuration_of, read_sweep
    from nishiki.engine.project import load_yaml
    from nishiki.engine.workflow import Workflow

    files: dict[str, list[str]] = {name: [] for name in configurations}
    for sweep in sweeps:
        named = configuration_of(Path(sweep)) or configurations[0]
        files.setdefault(named, []).append(sweep)
    referenced: dict[Path, tuple[Path, set[Place], set[str]]] = {}
    for name, files_of in files.items():
        flow = Workflow(load_yaml(Path(name)))
        results = Path(flow.results)
        _, planned, known = referenced.setdefault(results.resolve(), (results, set(), set()))
        planned |= flow.list_planned(files_of)
        known |= {read_sweep(sweep, flow.project)[0] for sweep in (*flow.project.configuration.sweeps, *files_of)}
    return list(referenced.values())


def _refuse_unknown_sweeps(results: Path, known: set[str], unnamed: bool) -> None:
    """Refuse an unknown sweep, whose artifacts nothing else names: nothing is guessed."""
    from nishiki.engine.plan import TIMINGS
    from nishiki.engine.project import SWEEPS

    folder = results / SWEEPS
    if unnamed or not folder.is_dir():
        return
    pages = {path.name for path in folder.iterdir() if path.is_dir()}
    unknown = sorted(pages - known - {TIMINGS})
    if unknown:
        remedy = "Remedy: --sweep with its file keeps what it needs; --unnamed lists that for removal"
        raise UserError(f"{folder / unknown[0]}: a sweep that no given configuration names. {remedy}")


def _note(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _tell(pruning: "Pruning", as_json: bool) -> None:
    for what, items in (("remove", pruning.remove), ("keep", pruning.keep), ("left alone", pruning.left_alone)):
        for item in items:
            _tell_item(what, item, as_json)
    total = sum(item.bytes for item in pruning.remove)
    if as_json:
        print(json.dumps({"folders": len(pruning.remove), "bytes": total, "removed": False}))
    else:
        print(f"in all {len(pruning.remove)} folders, {_size(total)}. Nothing was removed; --delete removes them")


def _tell_item(what: str, item: "Item", as_json: bool) -> None:
    if as_json:
        print(json.dumps({"what": what, "path": str(item.folder), "bytes": item.bytes, "why": item.why}))
    else:
        print(f"{what:10} {_size(item.bytes):>10}  {printable(str(item.folder))}  ({printable(item.why)})")


def _delete(pruning: "Pruning", as_json: bool) -> int:
    from nishiki.archive.prune import remove

    total, failed = remove(pruning.remove, lambda item: _tell_item("removed", item, as_json))
    for folder, why in failed:
        _note(f"could not be removed: {printable(str(folder))} ({why})")
    count = len(pruning.remove) - len(failed)
    if as_json:
        print(json.dumps({"folders": count, "bytes": total, "removed": True, "failed": len(failed)}))
    else:
        print(f"removed {count} folders, {_size(total)}")
    return 1 if failed else 0


def _size(number: int) -> str:
    """Format bytes in units of 1000."""
    value, units = float(number), ["B", "kB", "MB", "GB", "TB"]
    while value >= 1000 and len(units) > 1:
        value /= 1000
        units.pop(0)
    return f"{value:.0f} {units[0]}" if units[0] == "B" else f"{value:.1f} {units[0]}"
