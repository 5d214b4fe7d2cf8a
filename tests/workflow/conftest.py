"""Small scenes run through the workflow in a copy of the project, so that code can be edited without harm."""

import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from contextlib import chdir, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from threading import Thread

import pytest
import yaml
from viewer_pages import opened, painting_page

PROJECT = Path(__file__).resolve().parents[2]
ALLOWED = ("file:", "data:", "blob:", "about:")
COPIED = ("Snakefile", "workflow", "scripts", "config", "envs")
SMALL_RENDER = {
    "pictures": [{"name": "daylight"}],
    "sequences": [{"name": "moving-light", "frames": 3, "columns": 64}],
}
SMALL_CLOTH_RENDER = {"view": {"rows": 72, "columns": 72}, "supersampling": 1}
SMALL_OBJECT_RENDER = {"views": 6, "between": 1, "film": {"frames_per_step": 1, "columns": 64, "supersampling": 1}}
SMALL = {
    "plane": {"render": SMALL_RENDER},
    "turntable": {"object_render": SMALL_OBJECT_RENDER},
    "goniometer": {"cloth_render": SMALL_CLOTH_RENDER},
}


@dataclass
class Site:
    """A copy of the project with one tiny simulated scene, named tiny."""

    folder: Path
    geometry: str = "plane"

    def nishiki(self, *arguments: str, check: bool = True) -> subprocess.CompletedProcess:
        """Run the command line inside the copy."""
        environment = {**os.environ, "PYTHONPATH": str(self.folder / "workflow/src"), "PYTHONWARNINGS": "default"}
        done = subprocess.run(
            [sys.executable, "-m", "nishiki", *arguments],
            cwd=self.folder,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert not check or done.returncode == 0, done.stdout + done.stderr
        return done

    def ask(self, *arguments: str) -> str:
        """Call the command line inside this process, for questions about a configuration; what it prints."""
        from nishiki.cli import main

        with chdir(self.folder), redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit) as ended:
            main(list(arguments))
        assert not ended.value.code, printed.getvalue()
        return printed.getvalue()

    def start(self, *arguments: str) -> subprocess.Popen:
        """Start the command line inside the copy, in a process group of its own; run.log receives what it prints.

        A shell starts what stands before & with interrupts ignored, and whatever that starts inherits it: the tests
        may have been started so, but what they interrupt must not be.
        """
        with open(self.folder / "run.log", "w") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "nishiki", *arguments],
                cwd=self.folder,
                env={**os.environ, "PYTHONPATH": str(self.folder / "workflow/src")},
                stdout=log,
                stderr=log,
                start_new_session=True,
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            )

    def configure(self, **settings) -> None:
        """Write the configuration: small pictures, and these settings over them."""
        values = {"scenes": "config/scenes.tsv", **SMALL[self.geometry], **settings}
        (self.folder / "config/config.yaml").write_text(yaml.safe_dump(values))

    def restore_configuration(self) -> None:
        """Write the configuration and the scene table as they were at first."""
        row = "tiny\tcaptures/tiny\tcaptures/tiny-truth\n"
        (self.folder / "config/scenes.tsv").write_text("scene\tcapture\ttruth\n" + row)
        self.configure()

    def planned(self) -> list[str]:
        """Stages that a run would make now, in the order of the flow, as the plan tells; but for the publication."""
        plans = map(json.loads, self.ask("plan", "--json").splitlines())
        return [each["stage"] for plan in plans for each in plan["stages"] if each["state"] == "run"]

    def would_run(self) -> list[str]:
        """Stages that a run would make now, in the order of the flow, as Snakemake sees it."""
        text = self.nishiki("run", "--dry-run").stdout
        known = (*self.stages(), "publish")
        lines = [line.split() for line in text.splitlines()]
        return [
            name for name in known if any(len(line) == 2 and line[0] == name and line[1].isdigit() for line in lines)
        ]

    def stages(self) -> tuple[str, ...]:
        """Stages of the scene's chain."""
        from nishiki.stages.table import chain_of

        return tuple(chain_of(self.geometry))

    def usual_stages(self) -> set[str]:
        """Stages of the default products: exports and viewers are made where they are asked for."""
        from nishiki.stages.table import chain_of

        on_request = ("export", "viewer")
        return {name for name, stage in chain_of(self.geometry).items() if stage.asked_as not in on_request}

    def run_facts(self) -> dict[str, tuple[str, str]]:
        """Key and time of the last run of each stage."""
        current = self.folder / "results/tiny/current"
        return {
            stage: (os.readlink(current / stage), json.loads((current / stage / "run.json").read_text())["finished"])
            for stage in self.stages()
            if (current / stage).exists()
        }


@pytest.fixture(scope="session")
def new_site():
    """Make a copy of the project in a folder, without results."""
    return copied


def copied(folder: Path, geometry: str) -> Site:
    """A copy of the project in `folder`, with the bytecode that Python keeps; not what it is writing just now."""
    for name in COPIED:
        source = PROJECT / name
        ignore = shutil.ignore_patterns("*.pyc.*")
        shutil.copytree(source, folder / name, ignore=ignore) if source.is_dir() else shutil.copy2(
            source, folder / name
        )
    site = Site(folder, geometry)
    site.restore_configuration()
    return site


def finished(folder: Path, geometry: str, preset: str) -> Site:
    """A copy of the project in `folder`, with a scene simulated and run once."""
    site = copied(folder, geometry)
    site.nishiki("simulate", "--output", "captures/tiny", "--truth", "captures/tiny-truth", "--preset", preset)
    site.nishiki("run")
    return site


@pytest.fixture(scope="session")
def finished_site(tmp_path_factory) -> Site:
    """A painting, simulated and run once."""
    return finished(tmp_path_factory.mktemp("site"), "plane", "tiny")


@pytest.fixture(scope="session")
def finished_object(tmp_path_factory) -> Site:
    """An object on a turntable, simulated and run once."""
    return finished(tmp_path_factory.mktemp("object"), "turntable", "object-tiny")


@pytest.fixture(scope="session")
def finished_cloth(tmp_path_factory) -> Site:
    """A cloth on a gonioreflectometer, simulated and run once."""
    return finished(tmp_path_factory.mktemp("cloth_brdf"), "goniometer", "satin-tiny")


@pytest.fixture
def site(finished_site):
    """The finished painting; configuration, code and results are put back afterwards."""
    yield from put_back(finished_site)


@pytest.fixture
def asked(finished_site, monkeypatch, capsys):
    """The finished painting, and a call of the command line inside this process: for questions about a configuration.

    Only the configuration is put back afterwards.
    """
    from nishiki.cli import main

    def ask(*arguments: str) -> tuple[int, str, str]:
        """Exit status, standard output and standard error."""
        with pytest.raises(SystemExit) as ended:
            main(list(arguments))
        return ended.value.code, *capsys.readouterr()

    monkeypatch.chdir(finished_site.folder)
    yield finished_site, ask
    finished_site.restore_configuration()


@pytest.fixture
def object_site(finished_object):
    """The finished object; configuration, code and results are put back afterwards."""
    yield from put_back(finished_object)


@pytest.fixture
def cloth_site(finished_cloth):
    """The finished cloth; configuration, code and results are put back afterwards."""
    yield from put_back(finished_cloth)


LENT = ("workflow", "config", "results", ".snakemake")


def put_back(finished_site: Site):
    """Lend a finished scene, and undo what was done to its configuration, code and results: tests in any order.

    A thread deletes what was lent, which takes seconds on a busy disk.
    """
    saved = finished_site.folder / "saved"
    for name in LENT:
        shutil.copytree(finished_site.folder / name, saved / name, symlinks=True)
    yield finished_site
    used = tempfile.mkdtemp(prefix="used-", dir=finished_site.folder)
    for name in LENT:
        shutil.move(finished_site.folder / name, used)
        shutil.move(saved / name, finished_site.folder / name)
    saved.rmdir()
    Thread(target=shutil.rmtree, args=(used,)).start()


@pytest.fixture(scope="module")
def viewed(finished_site):
    """The finished painting with its viewer and report, for all tests of a module."""
    lent = put_back(finished_site)
    site = next(lent)
    site.configure(products=["report", "viewer"])
    site.nishiki("run")
    yield site
    next(lent, None)


@pytest.fixture(scope="module")
def index(finished_site, tmp_path_factory):
    """The page of the finished painting, made without a run."""
    current = finished_site.folder / "results/tiny/current"
    with painting_page(current, tmp_path_factory.mktemp("page")) as page:
        yield page


@pytest.fixture(scope="module")
def browser(index):
    """One browser for all tests of a module: a start takes longer than a test."""
    with opened(index, width=900, height=640) as page:
        yield page


@pytest.fixture
def shown(browser, index):
    """The page of the painting, opened anew; nothing may be written to the console or asked of a network."""
    browser.page.set_viewport_size({"width": 900, "height": 640})
    browser.page.goto("about:blank")
    browser.page.goto(index.resolve().as_uri())
    browser.page.wait_for_function("window.nishiki")
    browser.page.evaluate("nishiki.idle()")
    yield browser
    assert browser.messages == []
    assert not [address for address in browser.requests if not address.startswith(ALLOWED)]
