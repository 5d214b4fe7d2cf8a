"""The command that removes results which no configuration references."""

import argparse
import json
import sys
from pathlib import Path

from nishiki.archive.damage import shown
from nishiki.archive.inventory import PRUNED, Item, Place, Pruning
from nishiki.archive.prune import decide
from nishiki.archive.removal import remove
from nishiki.engine.project import SWEEPS
from nishiki.engine.running_lock import records, refuse_while_running, registered
from nishiki.engine.sweep_plan import TIMINGS
from nishiki.errors import UserError


def prune(options: argparse.Namespace, rest: list[str]) -> int:
    """List what no configuration references, and remove it where --delete says so. Exit status 1 where something that
    was to be removed could not be."""
    status = 0
    for results, planned, sweeps in _referenced(options):
        if not results.is_dir():
            raise UserError(f"{results}: folder not found; there is nothing to prune")
        _refuse_unknown_sweeps(results, sweeps, options.unnamed)
        if not options.delete:
            _tell_runs(results)
            _tell(_decide(results, planned, sweeps, options), options.json)
            continue
        refuse_while_running(results, "nothing is removed")
        scenes = [path.name for path in results.iterdir() if path.is_dir() and not path.name.startswith(".")]
        with registered(results, scenes, gone=options.host_is_gone, tell=_note) as held:
            status = max(status, _delete(_decide(results, planned, sweeps, options), options.json))
            # What a killed run may have torn is for the next run to look at, not forgotten here.
            held.ended = "pruned" if held.unclean else "done"
    return status


def _decide(results: Path, planned: set[Place], sweeps: set[str], options: argparse.Namespace) -> Pruning:
    return decide(results, planned, sweeps=sweeps, unnamed=options.unnamed, hosts=options.host_is_gone)


def _referenced(options: argparse.Namespace) -> list[tuple[Path, set[Place], set[str]]]:
    """Results folders with what all configurations and sweeps ask for, and the names of the sweeps."""
    from nishiki.engine.project import load_yaml
    from nishiki.engine.sweep_plan import configuration_of, read_sweep
    from nishiki.engine.workflow import Workflow

    configurations = options.configfile or ["config/config.yaml"]
    files: dict[str, list[str]] = {name: [] for name in configurations}
    for sweep in options.sweep:
        named = configuration_of(Path(sweep)) or configurations[0]
        files.setdefault(named, []).append(sweep)
    referenced: dict[Path, tuple[Path, set[Place], set[str]]] = {}
    for name, sweeps in files.items():
        flow = Workflow(load_yaml(Path(name)))
        results = Path(flow.results)
        _, planned, known = referenced.setdefault(results.resolve(), (results, set(), set()))
        planned |= flow.planned(sweeps)
        known |= {read_sweep(sweep, flow.project)[0] for sweep in (*flow.project.configuration.sweeps, *sweeps)}
    return list(referenced.values())


def _refuse_unknown_sweeps(results: Path, known: set[str], unnamed: bool) -> None:
    """A sweep that is not given may need artifacts that nothing else names: nothing is guessed."""
    folder = results / SWEEPS
    if unnamed or not folder.is_dir():
        return
    pages = {path.name for path in folder.iterdir() if path.is_dir() and not path.name.endswith(PRUNED)}
    unknown = sorted(pages - known - {TIMINGS})
    if unknown:
        remedy = "Remedy: --sweep with its file keeps what it needs; --unnamed lists it and that for removal"
        raise UserError(f"{folder / unknown[0]}: a sweep that no given configuration names. {remedy}")


def _tell_runs(results: Path) -> None:
    for record in records(results):
        if record.state in ("alive", "elsewhere"):
            _note(f"{results}: a run may be alive, --delete would refuse: {record}")


def _note(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _tell(pruning: Pruning, as_json: bool) -> None:
    for what, items in (("remove", pruning.remove), ("keep", pruning.keep), ("left alone", pruning.left_alone)):
        for item in items:
            _tell_item(what, item, as_json)
    total = sum(item.bytes for item in pruning.remove)
    if as_json:
        print(json.dumps({"folders": len(pruning.remove), "bytes": total, "removed": False}))
    else:
        print(f"in all {len(pruning.remove)} folders, {_size(total)}. Nothing was removed; --delete removes them")


def _tell_item(what: str, item: Item, as_json: bool) -> None:
    if as_json:
        print(json.dumps({"what": what, "path": str(item.folder), "bytes": item.bytes, "why": item.why}))
    else:
        print(f"{what:10} {_size(item.bytes):>10}  {shown(item.folder)}  ({shown(item.why)})")


def _delete(pruning: Pruning, as_json: bool) -> int:
    total, failed = remove(pruning.remove, lambda item: _tell_item("removed", item, as_json))
    for folder, why in failed:
        _note(f"could not be removed: {shown(folder)} ({why})")
    count = len(pruning.remove) - len(failed)
    if as_json:
        print(json.dumps({"folders": count, "bytes": total, "removed": True, "failed": len(failed)}))
    else:
        print(f"removed {count} folders, {_size(total)}")
    return 1 if failed else 0


def _size(number: int) -> str:
    """Bytes for a reader, in units of 1000."""
    value, units = float(number), ["B", "kB", "MB", "GB", "TB"]
    while value >= 1000 and len(units) > 1:
        value /= 1000
        units.pop(0)
    return f"{value:.0f} {units[0]}" if units[0] == "B" else f"{value:.1f} {units[0]}"
