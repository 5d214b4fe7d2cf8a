"""Copies of the project share compiled kernels."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[2] / "workflow/src"
CALL = """
import numpy as np
from nishiki import kernel_cache
kernel_cache.PATIENCE_S = 0.01
from nishiki.simulate.painting.relief import lit_share
lit_share(0.5, 0.4, 0.02)
print(sum(lit_share.stats.cache_hits.values()), sum(lit_share.stats.cache_misses.values()))
"""


@pytest.mark.slow
def test_a_copy_of_the_package_uses_the_kernels_of_the_first(tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(SOURCE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    hits, told = [], []
    for source in (SOURCE, copy):
        environment = {
            **os.environ,
            "PYTHONPATH": str(source),
            "NUMBA_CACHE_DIR": str(tmp_path / "kernels"),
            "NUMBA_CACHE_LOCATOR_CLASSES": "nishiki.kernel_cache.ByModule,UserProvidedCacheLocator",
        }
        done = subprocess.run([sys.executable, "-c", CALL], env=environment, capture_output=True, text=True, check=True)
        hits.append(done.stdout.split())
        told.append("compiling" in done.stderr)
    assert hits == [["0", "1"], ["1", "0"]]
    assert told == [True, False], "compilation is told of, and only where it happens"
    assert "simulate.painting.relief" in {path.name for path in (tmp_path / "kernels").iterdir()}
