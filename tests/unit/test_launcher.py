"""The launcher ./nishiki: what it installs, when, and what it leaves alone; its installer notes what it is told."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]
UV = """#!/bin/sh
echo "$@" >>"{log}"
mkdir -p "{home}/.venv/bin"
printf '#!/bin/sh\\necho "ran $*"\\n' >"{home}/.venv/bin/python"
chmod +x "{home}/.venv/bin/python"
"""


class Home:
    """A folder with the launcher, a lock, and an installer that only notes what it was asked for."""

    def __init__(self, folder: Path):
        self.folder, self.log = folder, folder / "log"
        shutil.copy2(PROJECT / "nishiki", folder / "nishiki")
        (folder / "uv.lock").write_text("one")
        uv = folder / ".uv/bin/uv"
        uv.parent.mkdir(parents=True)
        uv.write_text(UV.format(log=self.log, home=folder))
        uv.chmod(0o755)

    def call(self, *arguments: str, **environment: str) -> subprocess.CompletedProcess:
        inherited = {name: value for name, value in os.environ.items() if name != "NISHIKI_EXTRAS"}
        command = [str(self.folder / "nishiki"), *arguments]
        return subprocess.run(command, env=inherited | environment, capture_output=True, text=True, check=False)

    @property
    def installed(self) -> list[set[str]]:
        """Extras and groups of every installation so far."""
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        words = [line.split() for line in lines]
        assert all(line[:4] == ["sync", "--locked", "--quiet", "--no-default-groups"] for line in words)
        return [{word for word in line[4:] if not word.startswith("--")} for line in words]


@pytest.fixture
def home(tmp_path):
    return Home(tmp_path)


USUAL = {"raw", "video", "mesh"}


def test_the_first_call_installs_the_usual_extras_once(home):
    done = home.call("plan")
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("-m nishiki plan\n")
    assert home.call("plan").stdout.endswith("-m nishiki plan\n")
    assert home.installed == [USUAL]


@pytest.mark.parametrize("command", ["install", "test"])
def test_kernels_are_compiled_ahead_for_tests_and_where_an_installation_is_asked_for(home, command):
    assert "-m nishiki compile\n" in home.call(command).stdout
    assert "compile" not in home.call("plan").stdout


def test_the_first_call_can_be_told_by_the_environment(home):
    home.call("plan", NISHIKI_EXTRAS="raw")
    home.call("plan")
    assert home.installed == [{"raw"}]


def test_none_of_the_extras_then_one_beside_another(home):
    home.call("install", "--least")
    assert home.installed == [set()]
    home.call("install", "--extras", "raw")
    home.call("install", "--extras", "mesh", "slurm")
    assert home.installed == [set(), {"raw"}, {"raw", "mesh", "slurm"}]
    home.call("plan")
    assert len(home.installed) == 3


def test_extras_at_the_first_call_are_the_only_ones(home):
    home.call("install", "--extras", "video")
    assert home.installed == [{"video"}]


def test_tests_bring_their_tools_and_they_stay(home):
    home.call("install", "--extras", "raw")
    home.call("test", "tests/unit")
    home.call("plan")
    assert home.installed == [{"raw"}, {*USUAL, "rig", "dev"}]


def test_all_is_what_tests_types_and_documentation_need(home):
    home.call("install", "--all")
    home.call("test")
    assert home.installed == [{*USUAL, "rig", "export", "dev", "docs", "types"}]


def test_another_lock_installs_the_same_extras_again(home):
    home.call("install", "--extras", "raw")
    (home.folder / "uv.lock").write_text("two")
    assert home.call("plan").stdout.endswith("-m nishiki plan\n")
    assert home.installed == [{"raw"}, {"raw"}]


def test_an_environment_that_says_nothing_of_extras_is_left_alone(home):
    home.call("install", "--all")
    (home.folder / ".venv/.nishiki-extras").unlink()
    home.call("plan")
    assert len(home.installed) == 1
    home.call("test")  # such an environment is older than the extra rig, which the tests need
    assert "rig" in home.installed[1]


@pytest.mark.parametrize("arguments", [["--extras", "meshes"], ["--extras"], ["--most"]])
def test_what_is_not_known_is_told_with_a_remedy(home, arguments):
    done = home.call("install", *arguments)
    assert done.returncode == 2
    assert "Remedy: ./nishiki install --extras" in done.stderr
    assert home.installed == []


@pytest.mark.parametrize("arguments", [["--help"], ["test", "--help"], ["install", "-h"]])
def test_help_installs_nothing(home, arguments):
    done = home.call(*arguments)
    assert (done.returncode, home.installed) == (0, [])
    assert "./nishiki install" in done.stdout
    home.call("plan")
    assert home.call(*arguments).stdout == f"ran -m nishiki {' '.join(arguments)}\n"
    assert home.installed == [USUAL]
