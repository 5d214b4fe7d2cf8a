"""The three tiers of the tests, which random cases they draw, and where the measured data are.

./nishiki test --quick    no test marked slow or long; meant to take less than 3 minutes on two processors
./nishiki test            no test marked long: what continuous integration runs; meant to take at most 12 minutes
./nishiki test --long     all tests: also much fuzzing, the campaign of faults, Slurm and ten thousand scenes

Pytest itself takes the same two options. Mark a test slow where it takes more than one or two seconds or starts the
workflow, and long where it takes more than half a minute or repeats what another test checks, only with more cases.
"""

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from _project import use_kernel_cache
from nishiki.threads import ALONE

use_kernel_cache()
for name, value in ALONE.items():  # for the workers, too, beside which threads of OpenBLAS would wait busily
    os.environ.setdefault(name, value)
# The same cases at every run, so that a failure belongs to a change; HYPOTHESIS_PROFILE=search draws new ones.
# No test fails because the machine is busy, or because its first case compiles a kernel.
PATIENT = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}
settings.register_profile("same", derandomize=True, **PATIENT)
settings.register_profile("search", derandomize=False, print_blob=True, **PATIENT)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))
LONG_FILES = {
    *("test_arrangement", "test_capture_convert", "test_corrections", "test_ingest_pairs", "test_ingest_store"),
    *("test_object_brdf", "test_turn_estimate", "test_turntable_coherence", "test_weave_fit", "test_weave_yarns"),
}
"""Files of unit tests that take more than ten seconds: the last ones would keep one of two workers waiting."""
PROJECT = Path(__file__).resolve().parents[1]


def data_folder() -> Path:
    """Folder of measured data: $NISHIKI_DATA, else ../shared/data beside the project."""
    return Path(os.environ.get("NISHIKI_DATA") or PROJECT.parent / "shared" / "data")


def pytest_addoption(parser):
    """The two options that choose a tier."""
    tiers = parser.getgroup("tiers")
    tiers.addoption("--quick", action="store_true", help="leave out tests marked slow")
    tiers.addoption("--long", action="store_true", help="also run tests marked long")


def pytest_configure(config):
    """Refuse two tiers at once."""
    if config.getoption("quick") and config.getoption("long"):
        raise pytest.UsageError("--quick leaves tests out and --long adds tests. Remedy: give one of them")


def pytest_collection_modifyitems(config, items):
    """Leave out what does not belong to the chosen tier, and begin with the files that take longest."""
    left_out = {"slow", "long"} if config.getoption("quick") else set() if config.getoption("long") else {"long"}
    chosen, others = [], []
    for item in items:
        (others if left_out & {mark.name for mark in item.iter_markers()} else chosen).append(item)
    config.hook.pytest_deselected(items=others)
    items[:] = sorted(chosen, key=lambda item: (item.path.parent.name != "workflow", item.path.stem not in LONG_FILES))


@pytest.fixture(scope="session")
def data() -> Path:
    """The measured data; the test is skipped where they are absent."""
    folder = data_folder()
    if not folder.is_dir():
        pytest.skip(f"measured data not found at {folder}; set NISHIKI_DATA to their folder")
    return folder
