"""The three tiers of the tests, which random cases they draw, and where the measured data are.

./nishiki test --quick    no test marked slow or long: under three minutes on two processors
./nishiki test            no test marked long: what continuous integration runs
./nishiki test --long     all tests: also fuzzing, faults, Slurm and many scenes

Pytest itself takes the same two options. Mark a test slow where it takes more than two seconds or starts the workflow,
and long where it takes more than half a minute or repeats what another test checks, only with more cases.
"""

import os
from pathlib import Path

import pytest
from hypothesis import settings

from _project import use_kernel_cache

use_kernel_cache()
# The same cases at every run, so that a failure belongs to a change; HYPOTHESIS_PROFILE=search draws new ones.
settings.register_profile("same", derandomize=True)
settings.register_profile("search", derandomize=False, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))
PROJECT = Path(__file__).resolve().parents[1]


def data_folder() -> Path:
    """Folder of measured data: $NISHIKI_DATA, else ../shared/data beside the project."""
    return Path(os.environ.get("NISHIKI_DATA") or PROJECT.parent / "shared" / "data")


def pytest_addoption(parser):
    """The two options that choose a tier."""
    tiers = parser.getgroup("tiers")
    tiers.addoption("--quick", action="store_true", help="leave out tests marked slow")
    tiers.addoption("--long", action="store_true", help="also run tests marked long")


SITES = ("finished_site", "finished_object", "finished_fabric")
"""Fixtures that simulate a scene and run the workflow on it: tests of one such scene share a process."""


def pytest_configure(config):
    """Make the markers known that are not in pyproject.toml."""
    config.addinivalue_line("markers", "long: only in ./nishiki test --long")
    config.addinivalue_line("markers", "xdist_group(name): these tests share a process (pytest-xdist)")
    if config.getoption("quick") and config.getoption("long"):
        raise pytest.UsageError("--quick leaves tests out and --long adds tests. Remedy: give one of them")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Leave out what does not belong to the chosen tier; give every test its group, the longest groups first."""
    left_out = {"slow", "long"} if config.getoption("quick") else set() if config.getoption("long") else {"long"}
    chosen, others = [], []
    for item in items:
        (others if left_out & {mark.name for mark in item.iter_markers()} else chosen).append(item)
    config.hook.pytest_deselected(items=others)
    for item in chosen:
        item.add_marker(pytest.mark.xdist_group(group_of(item)))
    items[:] = sorted(chosen, key=lambda item: group_of(item) not in SITES)


def group_of(item) -> str:
    """The scene that a test of the workflow needs, so that each scene is made once; of other tests, their file."""
    values = getattr(getattr(item, "callspec", None), "params", {}).values()
    needed = {*getattr(item, "fixturenames", ()), *(value for value in values if isinstance(value, str))}
    return next((name for name in SITES if name in needed), item.path.stem)


@pytest.fixture(scope="session")
def data() -> Path:
    """The measured data; the test is skipped where they are absent."""
    folder = data_folder()
    if not folder.is_dir():
        pytest.skip(f"measured data not found at {folder}; set NISHIKI_DATA to their folder")
    return folder
