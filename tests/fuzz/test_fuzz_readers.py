"""The short form of the fuzzing: seeded mutations, the same at every run, in a process of its own with low bounds."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]
COUNTS = {"manifest": 400, "lights": 400, "tables": 400, "images": 600, "yaml": 400, "meshes": 300, "stores": 100}


@pytest.fixture(scope="module")
def told():
    """What was counted for each reader."""
    seed = os.environ.get("NISHIKI_FUZZ_SEED", "1")
    command = [sys.executable, str(PROJECT / "tests/fuzz/short.py"), seed, *(f"{k}={n}" for k, n in COUNTS.items())]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False, timeout=600)
    lines = [line for line in done.stdout.splitlines() if line.startswith('{"target"')]
    assert len(lines) == len(COUNTS), f"ended with {done.returncode} after {lines[-1:]}: {done.stderr[-1500:]}"
    return {found["target"]: found for found in map(json.loads, lines)}


@pytest.mark.parametrize("target", COUNTS)
def test_a_reader_reads_or_refuses(told, target):
    found = told[target]
    assert found["misbehaviour"] is None
    assert found["read"] >= found["seeds"] - 1, "the files that the changes start from are read"
    assert found["read"] + found["refused"] == found["seeds"] + COUNTS[target]
    assert found["refused"] > 0
