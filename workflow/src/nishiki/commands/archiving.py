"""Commands for the archive of results: verify."""

import argparse
import json
import sys
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from nishiki.archive.audit import AuditTargets, Counts, audit, find_artifacts
from nishiki.archive.crate_audit import CrateAudit, audit_crate, is_crate
from nishiki.archive.damage import Damage, shown
from nishiki.errors import UserError
from nishiki.progress import Progress
from nishiki.threads import threads as given_threads


def verify(options: argparse.Namespace, rest: list[str]) -> int:
    """Verify every artifact below the folders; exit status 1 where anything is damaged, missing or foreign."""
    folders = [Path(folder) for folder in options.folders or ["results"]]
    if not options.folders and options.capture and not folders[0].is_dir():
        folders = []  # the capture alone is asked for
    for folder in folders:
        if not folder.is_dir() and not is_crate(folder):
            raise UserError(f"{folder}: neither a folder nor a ZIP file. Remedy: name the folder of the results")
    counts = Counts()
    threads = options.threads or given_threads()
    targets = find_artifacts(folder for folder in folders if not is_crate(folder))
    crates = [*(folder for folder in folders if is_crate(folder)), *targets.crates]
    for crate in crates:
        counts.problems += _verify_crate(crate, threads, options.json)
    if crates and not targets.artifacts and not options.capture:
        return 1 if counts.problems else 0
    if folders and not crates and targets.empty and not options.capture:
        what = "neither an artifact nor a crate in it"
        raise UserError(f"{', '.join(map(str, folders))}: {what}. Remedy: name results, a scene or a stage")
    unsound = _print_damages(audit(targets, counts, threads=threads, tell=Progress("verify")), options.json)
    for capture in options.capture:
        from nishiki.capture.seal import verify_seal
        from nishiki.formats.problems import group_problems

        problems = list(verify_seal(Path(capture)))
        for problem in group_problems(problems):
            _print_damage(Damage(Path(capture), "damaged", str(problem)), options.json)
        counts.problems += len(problems)
        if not options.json:
            print(f"{shown(Path(capture))}: {amount(len(problems), 'problem') if problems else 'as it was sealed'}")
    if folders or options.json:
        _summary(targets, counts, options.json)
    if options.set_aside:
        _set_aside(unsound)
    return 1 if counts.problems else 0


def _verify_crate(path: Path, threads: int, as_json: bool) -> int:
    """Verify a packed scene; the number of problems."""
    audited = CrateAudit(path)
    problems = 0
    for damage in audit_crate(audited, threads=threads, tell=Progress(f"verify {shown(path.name)}")):
        problems += 1
        _print_damage(damage, as_json)
    if as_json:
        print(json.dumps({**asdict(audited), "root": str(path), "problems": problems, "sound": not problems}))
        return problems
    raw = "with its photographs" if audited.photographs else "without its photographs"
    state = amount(problems, "problem") if problems else "sound"
    print(
        f"{shown(path)}: scene {shown(audited.scene)}, {len(audited.stages)} results from capture "
        f"{audited.capture[:12]} ({raw}), {audited.files} files, {audited.bytes / 1e9:.3f} GB: {state}; "
        f"digest {audited.digest}"
    )
    return problems


def _print_damages(damages: Iterable[Damage], as_json: bool) -> set[Path]:
    """Tell each damage; folders of the artifacts that have one."""
    unsound = set()
    for damage in damages:
        _print_damage(damage, as_json)
        if damage.artifact is not None:
            unsound.add(damage.artifact)
    return unsound


def _print_damage(damage: Damage, as_json: bool) -> None:
    if as_json:
        print(json.dumps({name: str(value or "") for name, value in asdict(damage).items()}))
    else:
        print(damage)


def _summary(targets: AuditTargets, counts: Counts, as_json: bool) -> None:
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
    """A number of things in words."""
    return f"{count} {thing}{'s' * (count != 1)}"


def _set_aside(unsound: set[Path]) -> None:
    from nishiki.engine.soundness import set_aside

    for folder in sorted(unsound):
        if folder.is_dir() and not folder.is_symlink() and "." not in folder.name:
            print(f"set aside: {shown(folder)} as {shown(set_aside(folder).name)}", file=sys.stderr)
