"""The installed package: the project's files are found, and its code digests are those of the checkout."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from captures import make_capture

from nishiki.archive.pack import CODE, Crate, _copy_code
from nishiki.artifacts.provenance import code_digest, program_of
from nishiki.capture.seal import seal
from nishiki.installation import PACKAGE, PACKAGES, PROJECT, cache_folder
from nishiki.stages.table import NAMES

PROGRAMS = (*NAMES, "publish", "sweep", "repeat")
LEFT_OUT = {"pyproject.toml", "uv.lock"}
"""Of a packed project; an installed package has none."""
DIGESTS = """
import json
from nishiki.artifacts.provenance import code_digest, program_of
print(json.dumps({name: code_digest(program_of(name)) for name in PROGRAMS}))
"""
PACKED = """
import json, pathlib, tempfile
from nishiki.archive.pack import Crate, _copy_code
from nishiki.installation import PROJECT
with tempfile.TemporaryDirectory() as folder:
    crate = Crate(pathlib.Path(folder))
    _copy_code(crate, PROJECT)
print(json.dumps(crate.files))
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with what the wheel holds, by the project file."""
    folder = tmp_path_factory.mktemp("site")
    wheel = tomllib.loads((PROJECT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    ignored = shutil.ignore_patterns("__pycache__")
    for name in wheel["packages"]:
        shutil.copytree(PROJECT / name, folder / Path(name).name, ignore=ignored)
    for name, target in wheel["force-include"].items():
        (folder / target).parent.mkdir(parents=True, exist_ok=True)
        if (PROJECT / name).is_dir():
            shutil.copytree(PROJECT / name, folder / target, ignore=ignored)
        else:
            shutil.copy2(PROJECT / name, folder / target)
    # What is known of the source files is shared, or all of them would be parsed again.
    (folder / "cache/nishiki").mkdir(parents=True)
    for known in cache_folder().glob("syntax-*.json"):
        shutil.copy(known, folder / "cache/nishiki")
    return folder


def call(site, *arguments, cwd):
    """Python with the installed package, from any folder."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA")}
    environment |= {"PYTHONPATH": str(site), "XDG_CACHE_HOME": str(site / "cache")}
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_code_digests_are_those_of_the_checkout(site, tmp_path):
    done = call(site, "-c", f"PROGRAMS = {PROGRAMS}\n{DIGESTS}", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {name: code_digest(program_of(name)) for name in PROGRAMS}


@pytest.mark.slow
def test_a_run_is_planned_from_any_folder(site, tmp_path):
    seal(make_capture(tmp_path / "plane"))
    (tmp_path / "scenes.tsv").write_text("scene\tcapture\nplane\tplane\n")
    (tmp_path / "config.yaml").write_text("scenes: scenes.tsv\n")
    done = call(site, "-m", "nishiki", "run", "--configfile", "config.yaml", "--dry-run", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert {"ingest", "normals", "report", "publish"} <= {line.split()[0] for line in done.stdout.splitlines() if line}


def test_a_folder_without_a_configuration_is_reported(site, tmp_path):
    done = call(site, "-m", "nishiki", "run", cwd=tmp_path)
    assert done.returncode == 2
    assert "config/config.yaml" in done.stderr
    assert "nishiki init" in done.stderr
    assert "./nishiki" not in done.stderr


def test_snakemake_finds_what_prints_a_run(site, tmp_path):
    registry = "from snakemake_interface_logger_plugins.registry import LoggerPluginRegistry as Registry"
    done = call(site, "-c", f"{registry}; print(Registry().is_installed('nishiki'))", cwd=tmp_path)
    assert done.stdout == "True\n", done.stderr


def test_tests_are_only_in_a_checkout(site, tmp_path):
    done = call(site, "-m", "nishiki", "test", cwd=tmp_path)
    assert done.returncode == 2
    assert "checkout" in done.stderr


def test_a_crate_holds_the_same_code(site, tmp_path):
    crate = Crate(tmp_path / "crate")
    _copy_code(crate, PROJECT)
    expected = {name: entry for name, entry in crate.files.items() if name.split("/")[1] not in LEFT_OUT}
    done = call(site, "-c", PACKED, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert {name: tuple(entry) for name, entry in json.loads(done.stdout).items()} == expected
    assert {name.split("/")[1] for name in expected} == set(CODE) - LEFT_OUT


def test_every_package_of_the_project_is_installed(site):
    assert {path.name for path in (PROJECT / "workflow/src").iterdir() if any(path.glob("*.py"))} == set(PACKAGES)
    assert all((site / name / "__init__.py").is_file() for name in PACKAGES)


def test_the_command_is_that_of_the_project_file():
    scripts = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts == {"nishiki": "nishiki.cli:main"}
    assert (PACKAGE / "cli.py").is_file()
