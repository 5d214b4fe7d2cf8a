"""Commands for a project and its installation: init, add, status, install, test, compile, completion."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from nishiki.capture.mosaic import MosaicCapture, is_capture
from nishiki.commands.capturing import convert_source, examine, seal_folder
from nishiki.commands.declare import CONFIGURATION, any_scene_argument, command, option, with_configuration
from nishiki.errors import UserError, unknown_scene
from nishiki.formats.problems import group_problems
from nishiki.installation import INSTALLED, PROJECT

CAPTURES = Path("captures")
HEADER = """\
# One scene a row, columns separated by tabs. products and settings may be empty.
scene\tcapture\ttruth\tproducts\tsettings
"""
IN_THE_LIST = ("encoding-assumed", "lights-in-order", "cameras-in-order")
"""Kinds of warnings that the list of assumptions contains in its own lines."""


@command("init", "init my-project")
@click.argument("folder", default=".", help="folder of the project, which may exist")
def init(folder: str) -> None:
    """Make a project: a configuration, and a scene table without scenes."""
    made = make_project(Path(folder))
    if not made:
        raise UserError(f"{Path(folder, CONFIGURATION)}: there is a project already. Remedy: ./nishiki status")
    print(f"{made}: a project. Next, in that folder: ./nishiki run PHOTOGRAPHS/")


@command("add captures/altarpiece", "add captures/altarpiece left-wing")
@click.argument("capture", help="capture folder, as convert or a rig made it")
@click.argument("name", required=False, help="name of the scene (default: name of the capture)")
@with_configuration
def add(capture: str, name: str | None, configfile: str) -> int:
    """Add a capture to the scene table, after a check of its tables and headers."""
    if not is_capture(Path(capture)):
        raise UserError(f"{capture}: no capture folder. Remedy: ./nishiki run {capture} or ./nishiki convert makes one")
    if examine(capture, quick=True):
        return 2
    print(f"{_add_scene(configfile, name or scene_name(Path(capture)), Path(capture))}: added to the scene table")
    return 0


@command("status", "status altarpiece")
@any_scene_argument
@with_configuration
def status(scene: str | None, configfile: str) -> None:
    """Show each scene: whether it is finished, what comes next, and where its page is."""
    from nishiki.commands.inspecting import planned_workflow
    from nishiki.commands.results import card_of

    flow = planned_workflow(configfile, scene, leave_out_refused=True)
    cards = {name: card_of(flow, name, "") for name in flow.plans}
    rows = [(name, cards[name].state, cards[name].detail or cards[name].page) for name in cards]
    rows += [(name, "refused", why) for name, why in flow.refused.items()]
    width = max(len(row[0]) for row in rows)
    for name, state, detail in rows:
        page = f"{flow.results}/{detail}" if state == "finished" and detail else detail
        print(f"{name:{width}}  {state:10}  {page}".rstrip())
    finished = sum(row[1] == "finished" for row in rows)
    print(f"{finished} of {len(rows)} scenes are finished")


def make_project(folder: Path) -> Path | None:
    """Make the configuration of a project and an empty scene table; None where there is a configuration."""
    configuration = folder / CONFIGURATION
    if configuration.exists():
        return None
    configuration.parent.mkdir(parents=True, exist_ok=True)
    table = configuration.with_name("scenes.tsv")
    if not table.exists():
        table.write_text(HEADER, encoding="utf-8")
    configuration.write_text((PROJECT / CONFIGURATION).read_text(encoding="utf-8"), encoding="utf-8")
    return configuration


def find_scenes(words: Sequence[str], configfile: str, *, name: str | None, given: dict) -> list[str]:
    """Return the scenes that words of the command line mean: names, captures, or photographs, which are converted.

    Raises UserError where a word means nothing, and where a check finds an error; the table is unchanged then.
    """
    used = sorted(option for option, value in given.items() if value)
    folders = [word for word in words if Path(word).exists()]
    if name and len(words) != 1:
        raise UserError(f"--name {name}: expected one folder to name, found {len(words)}. Remedy: name one folder")
    for word in words:
        if "/" in word and not Path(word).exists():
            raise UserError(f"{word}: no such folder. Remedy: correct the path; scenes are named without /")
    assumed = []
    if folders and configfile == CONFIGURATION and make_project(Path()):
        assumed.append(("project", f"this folder; {CONFIGURATION} was made", "init FOLDER"))
    scenes = _captures_of(configfile) if words else {}
    found = []
    for word in words:
        path = Path(word)
        if word in scenes and not name:
            found.append(word)
        elif not path.exists():
            raise UserError(f"no such folder, and {unknown_scene(word, scenes)}")
        elif is_capture(path):
            if examine(word):
                raise UserError(f"{word}: cannot be used, for the errors above. Remedy: mend them and run again")
            found.append(_add_scene(configfile, name or scene_name(path), path))
        else:
            found.append(_from_photographs(path, configfile, name or scene_name(path), (given, used), assumed))
            continue
        if used:
            raise UserError(f"{word}: no folder of photographs, which {_flags(used)} need. Remedy: omit them")
    if used and not words:
        raise UserError(f"{_flags(used)}: expected a folder of photographs to convert. Remedy: name it")
    return found


def scene_name(source: Path) -> str:
    """Return the name of a scene after that of a file or folder: letters, digits, - and _ only."""
    text = unicodedata.normalize("NFKD", source.resolve().stem if source.is_file() else source.resolve().name)
    text = text.replace("ß", "ss")
    return re.sub(r"[^A-Za-z0-9_]+", "-", text.encode("ascii", "ignore").decode()).strip("-")[:100] or "scene"


def _from_photographs(source: Path, configfile: str, name: str, options: tuple[dict, list[str]], assumed: list) -> str:
    """Convert photographs into captures/NAME, or find that this was done before; the scene that was added."""
    given, used = options
    capture, scenes = CAPTURES / name, _captures_of(configfile)
    if name in scenes and scenes[name].resolve() != capture.resolve():
        raise UserError(f"{source}: the scene {name} is made of {scenes[name]}. Remedy: --name with another name")
    if capture.exists():
        if used:
            why = f"{capture} exists, so that {_flags(used)} would change nothing"
        elif not _holds_photographs(capture, source):
            why = f"{capture} exists and was made of other photographs"
        else:
            print(f"{source}: converted before, as {capture}", file=sys.stderr)
            return _add_scene(configfile, name, capture)
        raise UserError(f"{source}: {why}. Remedy: --name with another name, or remove {capture} first")
    print(f"{source}: reading, comparing and copying the photographs into {capture}", file=sys.stderr, flush=True)
    CAPTURES.mkdir(exist_ok=True)
    made = convert_source(source, capture, given, checked=True)
    seal_folder(capture)
    things = "measurements" if made.geometry == "goniometer" else "photographs"
    print(f"{source}: {made.photographs} {things} ({made.layout}). What was assumed, and the option that changes it:")
    rows = [*assumed, ("scene", f"{name}, from {capture}", "--name"), *list_assumptions(made, given)]
    for label, value, flag in rows:
        print(f"  {label:13}{value:51} {flag}".rstrip())
    for problem in group_problems(problem for problem in made.warnings if problem.kind not in IN_THE_LIST):
        print(f"  doubtful: {problem}")
    assumed.clear()
    return _add_scene(configfile, name, capture)


def list_assumptions(made, given: dict) -> list[tuple[str, str, str]]:
    """List what a conversion assumed: label, value, option of `run` and `convert` that changes it."""
    from nishiki.capture.folder import load_capture
    from nishiki.capture.goniometer import GoniometerFile
    from nishiki.capture.turntable_layouts import TURN

    capture = load_capture(made.folder)
    described: Any = capture.settings
    kinds = {problem.kind for problem in made.warnings}
    rows = [("title", described.title, "--title")]
    if isinstance(capture, MosaicCapture):
        stated = sum(field.position_mm is not None for field in capture.fields)
        rows.append(("fields", f"{len(capture.fields)}, {stated} with a position", "fields.csv"))
    if isinstance(described, GoniometerFile):
        values, azimuths = described.goniometer.values, described.goniometer.azimuths
        return [*rows, ("values", str(values), "--values"), ("azimuths", f"of the view from {azimuths}", "--azimuths")]
    name, stated = described.camera.encoding, "assumed" if "encoding-assumed" in kinds else "as stated"
    encoding = "as each file states" if name == "file" else f"{name} ({stated})"
    rows.append(("encoding", encoding, f"--encoding {'srgb' if name == 'linear' else 'linear'}"))
    order = "in the order of the photographs' names" if kinds & set(IN_THE_LIST[1:]) else "by file name"
    order = "measured on the mirror balls" if made.layout == "mirror balls" else order
    if described.geometry == "turntable":
        mask = "none: outlines are taken from the photographs"
        options = "--turn, --camera-of"
        if made.layout == TURN:
            order, options = "estimated from the photographs, once round in the order of their names", "--height-mm MM"
        rows += [("cameras", order, options), ("outlines", given["mask"] or mask, "--mask FOLDER")]
        return [*rows, ("white board", given["white"] or "none: colours are relative", "--white FOLDER")]
    kind = described.lights.kind.replace("_mm", "s in mm")
    width = getattr(described, "pixel_pitch_mm", None)
    region = getattr(described, "region_of_interest", None)
    rows += [
        ("lamps", f"{kind}, {order}", "--lights, --lights-order, --lights-axes"),
        ("scale", f"{width:g} mm a pixel" if width else "none: lengths are in pixels", "--width-mm MM"),
        ("object", getattr(described, "mask", None) or "the whole picture: no mask", "--mask FILE"),
        ("part", " ".join(map(str, region)) if region else "the whole picture", "--roi"),
        ("white board", given["white"] or "none: colours are relative", "--white FOLDER"),
        ("dark frames", given["dark"] or "none", "--dark FOLDER"),
        ("room light", given["ambient"] or "no photograph of it", "--ambient FILE"),
    ]
    return rows


def _flags(options: Sequence[str]) -> str:
    """Return options as they are written, by the names of their values."""
    flags = {each.name: each.opts[0] for each in click.get_current_context().command.params}
    return ", ".join(flags[option] for option in options)


def _captures_of(configfile: str) -> dict[str, Path]:
    """Return the capture folder of each scene of the table, which may be empty."""
    from nishiki.engine.project import load_project, load_yaml

    values = load_yaml(Path(configfile))
    project = load_project(values, path=Path(configfile), may_be_empty=True)
    return {name: scene.capture for name, scene in project.scenes.items()}


def _add_scene(configfile: str, name: str, capture: Path) -> str:
    """Add a row to the scene table, unless it is there; the name. UserError where another scene has the name."""
    from nishiki.engine.project import load_project, load_yaml

    scenes = _captures_of(configfile)
    if name in scenes:
        if scenes[name].resolve() != capture.resolve():
            raise UserError(f"{capture}: the scene {name} is made of {scenes[name]}. Remedy: give another name")
        return name
    table = Path(load_project(load_yaml(Path(configfile)), may_be_empty=True).configuration.scenes)
    text = table.read_text(encoding="utf-8-sig")
    header = next(line for line in text.splitlines() if line.strip() and not line.startswith("#")).split("\t")
    row = "\t".join({"scene": name, "capture": str(capture)}.get(column, "") for column in header)
    table.write_text(f"{text.rstrip(chr(10))}\n{row}\n", encoding="utf-8")
    return name


def _holds_photographs(capture: Path, source: Path) -> bool:
    """Return whether the photographs of a sealed capture are those of a folder, by their digests."""
    from nishiki.artifacts.provenance import file_digest

    manifests = sorted(capture.rglob("manifest-sha256.txt"))
    lines = [line for path in manifests for line in path.read_text(encoding="utf-8").splitlines()]
    kept = {line.split()[0] for line in lines if "data/frames/" in line}
    files = [path for path in sorted(source.rglob("*")) if path.is_file()] if source.is_dir() else [source]
    return bool(kept) and kept <= {file_digest(path) for path in files}


TINY = {"plane": "tiny", "turntable": "object-tiny", "goniometer": "satin-tiny"}
"""A small simulated scene for each geometry."""
SMALL_PICTURES = """\
scenes: scenes.tsv
render: {sequences: [{name: moving-light, frames: 2, columns: 48}]}
object_render: {views: 4, between: 1, film: {frames_per_step: 1, columns: 48, supersampling: 1}}
cloth_render: {view: {rows: 48, columns: 48}, supersampling: 1}
"""
"""Configuration of runs that only compile kernels."""


@command("install", "install --extras rig export", "install --all")
@option("--extras EXTRA...", "raw, video, mesh, rig, export, slurm; beside what is installed")
@option("--least", "install no extras")
@option("--all", "install every extra but slurm, and the tools for tests and documentation", "everything")
def install(**options) -> None:
    """Install the packages of a checkout again, or add extras."""
    how = "pip install 'nishiki[EXTRA]'" if INSTALLED else f"{PROJECT / 'nishiki'} install"
    raise UserError(f"the launcher of a checkout installs, or pip. Remedy: {how}")


@command("test --quick", "test tests/unit -k spectra", passed_on=True)
@option("--quick", "leave out the tests that are marked slow or long")
@option("--long", "also run long fuzzing, the campaign of faults, Slurm and many scenes")
@click.argument("rest", nargs=-1, type=click.UNPROCESSED, metavar="[PYTEST ARGUMENT]...")
def test(quick: bool, long: bool, rest: tuple[str, ...]) -> int:
    """Run the tests of a checkout with pytest."""
    if quick and long:
        raise click.UsageError("--quick and --long are not allowed together; choose one.")
    if INSTALLED:
        raise UserError("an installed package has no tests. Remedy: call the launcher of a checkout of the project")
    try:
        import pytest  # noqa: F401
    except ImportError:
        raise UserError("pytest is not installed; remove .venv and call ./nishiki test again") from None
    install_for_meshlab()
    tier = [option for option, given in (("--quick", quick), ("--long", long)) if given]
    words = rest or ("-n", str(min(os.cpu_count() or 1, 4)), "--dist", "loadfile", "--no-loadscope-reorder")
    return subprocess.run([sys.executable, "-m", "pytest", *tier, *words], cwd=PROJECT, check=False).returncode


@command("compile", name="compile")
@option("--plane", "only what paintings need")
def compile_kernels(plane: bool) -> int:
    """Compile all kernels ahead, by running tiny simulated scenes in a temporary folder; two to three minutes."""
    from nishiki.installation import is_installed

    # The simulated object needs the extra mesh; whoever installs without it digitises no objects.
    scenes = {name: preset for name, preset in TINY.items() if name != "turntable" or is_installed("scikit-image")}
    scenes = {"plane": "tiny"} if plane else scenes
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = "".join(f"{scene}\t{scene}\t{scene}-truth\n" for scene in scenes)
        (folder / "scenes.tsv").write_text("scene\tcapture\ttruth\n" + rows)
        (folder / "config.yaml").write_text(SMALL_PICTURES)
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
        for arguments in (
            *(
                ["simulate", "--output", scene, "--truth", f"{scene}-truth", "--preset", preset]
                for scene, preset in scenes.items()
            ),
            # Compilation has one thread, stages ask for two: as many at a time as there are processors.
            ["run", "--configfile", "config.yaml", "--cores", str(2 * (os.cpu_count() or 1))],
        ):
            done = subprocess.run(
                [sys.executable, "-m", "nishiki", *arguments],
                cwd=folder,
                env=environment,
                capture_output=True,
                text=True,
                check=False,
            )
            if done.returncode:
                print(done.stdout + done.stderr, file=sys.stderr)
                return 1
    return 0


@command("completion bash >> ~/.bashrc", "completion fish > ~/.config/fish/completions/nishiki.fish")
@click.argument("shell", type=click.Choice(("bash", "zsh", "fish")), help="the shell")
def completion(shell: str) -> None:
    """Print the script with which a shell completes commands, options and names of scenes."""
    from click.shell_completion import BashComplete, FishComplete, ZshComplete

    root = click.get_current_context().find_root().command
    form = {"bash": BashComplete, "zsh": ZshComplete, "fish": FishComplete}[shell]
    print(form(root, {}, "nishiki", "_NISHIKI_COMPLETE").source())


def install_for_meshlab() -> None:
    """Install the system libraries that pymeshlab's filters need, where that is allowed: as root on Debian or Ubuntu.

    Elsewhere, or where it fails, a message names the command; the tests that need the filters are then skipped.
    """
    from nishiki.geometry.scans import APT_LINE, missing_filters

    if not missing_filters():
        return
    apt = shutil.which("apt-get")
    if apt and hasattr(os, "geteuid") and os.geteuid() == 0:
        environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
        for arguments in (["update"], APT_LINE.split()[1:]):
            command = [apt, "-qq", "-y", *arguments]
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return
        print(f"{APT_LINE} failed: {done.stderr.strip()}", file=sys.stderr)
    print(f"pymeshlab lacks filters, tests of range scans are skipped. Remedy: {APT_LINE}", file=sys.stderr)
