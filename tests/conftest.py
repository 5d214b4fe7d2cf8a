"""Where the measured data are, a clear skip where they are not, and which random cases are drawn."""

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


@pytest.fixture(scope="session")
def data() -> Path:
    """The measured data; the test is skipped where they are absent."""
    folder = data_folder()
    if not folder.is_dir():
        pytest.skip(f"measured data not found at {folder}; set NISHIKI_DATA to their folder")
    return folder
