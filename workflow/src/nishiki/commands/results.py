"""Commands of results and campaigns: viewer, files for other programs, table of all scenes, sweeps of settings."""

import functools
import http.server
import importlib
import json
import os
import shutil
import sys
import urllib.parse
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from nishiki.commands import declare
from nishiki.commands.inspecting import expect_packages, planned_workflow
from nishiki.errors import UserError, require, unknown_scene
from nishiki.formats.files import put_file
from nishiki.installation import optional
from nishiki.processes import owner

if TYPE_CHECKING:
    from nishiki.engine.workflow import Workflow


FORMATS = """\
Formats of a painting: normals, height, albedo, relight, spectral, gltf, usd, materialx, mitsuba, merl, iiif
Formats of an object:  gltf, usd, materialx, mitsuba, iiif, kintsugi
Formats of a cloth:    gltf, mitsuba, bsdf
See docs/stages/export.md."""


@declare.command("export altarpiece normals relight", "export jar gltf --output for-the-web", epilog=FORMATS)
@declare.scene_argument
@click.argument("formats", nargs=-1, required=True, metavar="FORMAT...", help="what to write, see below")
@declare.option("--output FOLDER", "copy the files there, too; the folder must not exist")
@declare.with_configuration
@declare.with_cores
@declare.with_gone
def export(scene, formats, output, configfile, cores, gone) -> int:
    """Write a scene's results in formats of other programs; stages that these need run first."""
    from nishiki.commands.engine import call_engine

    if output and Path(output).exists():
        raise UserError(f"--output {output}: exists already. Remedy: name a folder that does not")
    asked = {scene: formats}
    flow = planned_workflow(configfile, scene, {"exports": asked})
    expect_packages(flow)
    stage = next(name for name in flow.plans[scene].stages if name.endswith("export"))
    target = flow.artifact(scene, stage)
    options = [*declare.profile_arguments("default", cores), "--config", f"exports={json.dumps(asked)}", "--", target]
    if call_engine(flow, options, configfile=configfile, gone=gone):
        return 1
    made = Path(target).parent / "exports"
    if output:
        shutil.copytree(made, output)
        made = Path(output)
    print(made)
    for path in sorted(made.iterdir()):
        print(f"    {path.name}{'/' if path.is_dir() else ''}")
    return 0


@declare.command("table campaign.csv", "table campaign.parquet")
@click.argument("file", help="file to write, .csv or .parquet (needs the extra export)")
@declare.with_configuration
def table(file: str, configfile: str) -> None:
    """Write the figures of all scenes as a table, one row per scene."""
    from nishiki.capture.taking import table_text
    from nishiki.engine.finished import campaign_rows, columns_of

    path = Path(file)
    if path.suffix not in (".csv", ".parquet"):
        raise UserError(f"{path}: expected a name that ends in .csv or .parquet")
    columns = columns_of(campaign_rows(planned_workflow(configfile, leave_out_refused=True)))
    if path.suffix == ".parquet":
        pyarrow = optional("pyarrow")
        parquet = importlib.import_module("pyarrow.parquet")
        parquet.write_table(pyarrow.table(columns), path)
    else:
        path.write_text(table_text([list(columns), *zip(*columns.values(), strict=True)]), encoding="utf-8")
    finished = sum(value is True for value in columns["finished"])
    print(f"{path}: {len(columns['scene'])} scenes, {finished} of them finished, {len(columns)} columns")


@declare.command("sweep config/sweeps/normals.yaml", passed_on=True)
@click.argument(
    "words",
    nargs=-1,
    required=True,
    type=click.UNPROCESSED,
    metavar="SWEEP... [SNAKEMAKE OPTION]...",
    help="files of sweeps, or names under `sweeps` in the configuration",
)
@declare.option(
    "--configfile FILE", "configuration (default: the one that the sweep's file names, else config/config.yaml)"
)
@declare.with_cores
@declare.with_profile
@declare.with_gone
def sweep(words, configfile, cores, profile, gone) -> int:
    """Run variants of settings, and plot their error against their run time.

    All variants are made and timed; then table, page and advice are written. Exit status 1 where a stage failed or a
    repeat gave other bytes than its first run.
    """
    count = next((i for i, word in enumerate(words) if word.startswith("-")), len(words))
    if not count:
        raise click.UsageError("expected a sweep before the options of Snakemake: a file, or a name.")
    return max(_one(named, configfile, (profile, cores), gone, words[count:]) for named in words[:count])


def _one(named: str, configfile: str | None, where: tuple, gone: tuple[str, ...], rest: tuple[str, ...]) -> int:
    from nishiki.commands.engine import LOOKS_ONLY, call_engine
    from nishiki.engine.plan import configuration_of

    path = Path(named)
    given = configuration_of(path) if path.suffix in (".yaml", ".yml") else None
    configfile = configfile or given or "config/config.yaml"
    flow = planned_workflow(configfile, changes={"sweep": named})
    planned = require(flow.sweep)
    for swept in planned.scenes:
        timed = sum(len(paths) for variant in swept.variants for paths in flow.timings(swept, variant).values())
        print(
            f"{planned.name}: {swept.scene}: {len(swept.variants)} variants, figures from {swept.evaluation}, "
            f"timed: {', '.join(swept.counted)} ({timed} runs)"
        )
    target = flow.sweep_path("sweep.json")
    options = [*declare.profile_arguments(*where), "--keep-going", *rest]
    options += ["--config", f"sweep={json.dumps(named)}", "--", target]
    status = call_engine(flow, options, configfile=configfile, gone=gone)
    if status or LOOKS_ONLY & set(rest):
        return 1 if status else 0
    path = Path(target)
    content = json.loads(path.read_text(encoding="utf-8"))
    status = 0  # 1 where a repeat gave other bytes
    for scene in content["scenes"]:
        for measure, lines in zip(scene["measures"], scene["advice"], strict=True):
            print(f"{scene['scene']}, {measure['label']}:")
            for line in lines:
                print(f"    {line}")
        for row in scene["rows"]:
            if not row["reproducible"]:
                status = 1
                print(
                    f"{scene['scene']}: {row['name']}: not reproducible: {', '.join(row['different'])}", file=sys.stderr
                )
    print(path.with_name("sweep.html"))
    return status


PAGE = "index.html"
"""The page of all scenes, in the folder of the results."""
NOTES = "annotations.json"
VIEWERS = ("viewer/index.html", "object_viewer/index.html", "cloth_viewer/index.html")
OPENED_FIRST = (*VIEWERS, "report.html")
"""Pages of a scene in its folder `current`; the first that exists is opened."""


@declare.command("view", "view altarpiece", "view altarpiece --beside icon", "view --serve 8000")
@declare.any_scene_argument
@declare.with_configuration
@declare.option(
    "--serve [PORT]",
    "through a server for this machine alone, until Ctrl-C (default port: any that is free)",
    "port",
    type=int,
    flag_value=0,
    is_flag=False,
)
@declare.option("--print", "print the address only; open nothing", "print_only")
@declare.option(
    "--beside OTHER",
    "another scene, or a folder of its viewer's results, on the left of a divider, under the same lamps",
    "other",
)
def view(scene, configfile, port, print_only, other) -> None:
    """Open a scene's interactive viewer, or the page of all scenes, in the browser."""
    flow = planned_workflow(configfile, lazy=bool(scene), leave_out_refused=not scene)
    page, query = page_of(flow, scene) if scene else write_index(flow), ""
    if other:
        page, query = beside(flow, page, scene, other)
        port = 0 if port is None and not print_only else port  # programs that open files drop what follows a ?
    if port is None:
        print(page.resolve().as_uri() + query if query else page)
        if not print_only:
            webbrowser.open(page.resolve().as_uri())
        return
    serve(Path(flow.results), page, port, open_browser=not print_only, query=query)


def beside(flow: "Workflow", page: Path, scene: str | None, other: str) -> tuple[Path, str]:
    """Return a viewer's page and the address with the other page, of --beside, left of its divider.

    Raises
    ------
    UserError
        Where no scene is named to put it beside, either of the two has no viewer, or they cannot be served together.
    """
    if not scene:
        raise UserError(f"--beside {other}: beside which scene? Remedy: ./nishiki view SCENE --beside OTHER")
    named = Path(other, PAGE)
    both = (page, named if named.is_file() else page_of(flow, other))
    for each in both:
        if each.name != PAGE:
            raise UserError(f"{each.parent}: no viewer is there. Remedy: add viewer to the scene's products, and run")
    stages = [_read(each.parent / "artifact.json").get("stage") for each in both]
    if stages[0] != stages[1]:
        raise UserError(f"{both[1]}: a page of {stages[1]}, expected one of {stages[0]}. Remedy: a scene of this kind")
    results = Path(flow.results)
    try:
        page, left = (results / each.resolve().relative_to(results.resolve()) for each in both)
    except ValueError:
        raise UserError(f"{both[1]}: not within {results}. Remedy: name a result of this configuration") from None
    address = Path(os.path.relpath(left, page.parent)).as_posix()
    return page, "?" + urllib.parse.urlencode({"beside": address})


def page_of(flow: "Workflow", scene: str, *, first: str = "") -> Path:
    """Return the page `first` of a scene, else its viewer, else its report.

    Raises
    ------
    UserError
        Where the scene table has no such scene, or nothing of it can be opened yet.
    """
    if scene not in flow.plans:
        raise UserError(unknown_scene(scene, flow.project.scenes))
    current = Path(flow.results, scene, "current")
    for name in (first, *OPENED_FIRST):
        if (current / name).is_file():
            return current / name
    raise UserError(f"{current}: neither viewer nor report of scene {scene!r} is there. Remedy: ./nishiki run")


def write_index(flow: "Workflow", why: Mapping[str, str] | None = None) -> Path:
    """Write the page of all scenes into the folder of the results.

    Parameters
    ----------
    flow : Workflow
        Its scenes, and those that it had to leave out.
    why : mapping of str to str, optional
        Why a scene failed in the run that just ended, by its name.

    Returns
    -------
    Path
        The page.
    """
    from nishiki.artifacts.artifact import INDEX
    from nishiki.report.page import SceneCard, campaign_page
    from nishiki.version import PROJECT_VERSION

    why = why or {}
    cards = {scene: card_of(flow, scene, why.get(scene, "")) for scene in flow.plans}
    cards |= {scene: SceneCard(scene, "refused", reason) for scene, reason in flow.refused.items()}
    in_order = [cards[scene] for scene in flow.project.scenes if scene in cards]
    in_order += [
        _card(flow.results, index.parts[-3], "finished", "not in the present scene table", _read(index))
        for index in sorted(Path(flow.results).glob(f"*/current/{INDEX}"))
        if index.parts[-3] not in flow.project.scenes
    ]
    html = campaign_page(f"Scenes in {Path(flow.results).resolve().name}", in_order, PROJECT_VERSION)
    page = Path(flow.results, PAGE)
    page.parent.mkdir(parents=True, exist_ok=True)
    partial = page.with_name(f".{PAGE}.{owner()}.partial")
    partial.write_text(html, encoding="utf-8")
    os.replace(partial, page)
    return page


def card_of(flow: "Workflow", scene: str, why: str):
    """Build the card of a planned scene (`nishiki.report.page.SceneCard`)."""
    from nishiki.artifacts.artifact import INDEX
    from nishiki.engine.finished import reason_to_run

    published = _read(Path(flow.results, scene, "current", INDEX))
    missing = [name for name in flow.plans[scene].stages if not Path(flow.artifact(scene, name)).is_file()]
    reason = f"next: {missing[0]}" if missing else reason_to_run(flow, scene)
    state = "failed" if why else "unfinished" if reason else "finished"
    return _card(flow.results, scene, state, why or reason, published)


def _card(results: str, scene: str, state: str, detail: str, published: dict):
    """Build a card from the published files of a scene."""
    from nishiki.report.page import Metric, SceneCard

    current = Path(results, scene, "current")
    there = {name: f"{scene}/current/{name}" for name in (*OPENED_FIRST, "thumbnail.jpg") if (current / name).is_file()}
    report = next((name for name in published.get("artifacts", {}) if name.endswith("report")), "")
    told = _read(current / report / "artifact.json").get("diagnostics", {}) if report else {}
    return SceneCard(
        scene,
        state,
        detail,
        title=told.get("title") or "",
        about=told.get("about") or "",
        page=there.get("report.html", ""),
        viewer=next((there[name] for name in VIEWERS if name in there), ""),
        thumbnail=there.get("thumbnail.jpg", ""),
        figures=[Metric(**entry) for entry in told.get("figures", ())],
    )


def _read(path: Path) -> dict:
    """Read a JSON file; empty where there is none, or none that can be read: the page has less then."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


class ResultsHandler(http.server.SimpleHTTPRequestHandler):
    """Serve results, and keep the notes of a viewer's page in results/SCENE/annotations.json."""

    def log_message(self, format: str, *arguments: object) -> None:
        """Print no requests."""

    def translate_path(self, path: str) -> str:
        """Return the file of an address: the notes of a scene belong to none of its results."""
        found = Path(super().translate_path(path))
        within = found.relative_to(self.directory).parts
        return str(Path(self.directory, within[0], NOTES) if found.name == NOTES and len(within) > 2 else found)

    def do_PUT(self) -> None:
        """Keep the notes that a page of this server sends."""
        place = Path(self.translate_path(self.path))
        content = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        own = self.headers.get("Host", "").startswith("127.0.0.1:")
        if not own or place.name != NOTES or not place.with_name("current").is_dir():
            return self.send_error(403)
        put_file(place, content)
        self.send_response(204)
        self.end_headers()


def serve(results: Path, page: Path, port: int, *, open_browser: bool, query: str = "") -> None:
    """Serve the results to this machine's browsers alone until interrupted (port 0: any that is free)."""
    handler = functools.partial(ResultsHandler, directory=str(results))
    try:
        server = http.server.ThreadingHTTPServer(("127.0.0.1", port), handler)
    except OSError as error:
        raise UserError(f"--serve {port}: {error.strerror}. Remedy: another port, or 0 for any that is free") from None
    with server:
        address = f"http://127.0.0.1:{server.server_port}/{page.relative_to(results).as_posix()}{query}"
        print(f"{address}   (Ctrl-C ends it)", flush=True)
        if open_browser:
            webbrowser.open(address)
        server.serve_forever()
