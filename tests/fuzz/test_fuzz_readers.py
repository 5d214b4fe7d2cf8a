"""Fuzzing without instrumentation: seeded mutations, the same at every run, in a process of its own with low bounds."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[2]
COUNTS = {"manifest": 400, "lights": 400, "tables": 400, "images": 600, "yaml": 400, "meshes": 300, "stores": 100}


LONG = 40
"""How many times as many mutations the long tier makes."""
TIMES = [pytest.param(1, marks=pytest.mark.slow), pytest.param(LONG, marks=pytest.mark.long)]


@pytest.fixture(scope="module", params=TIMES)
def counted(request):
    """How many times as many mutations were made, and what was counted for each reader."""
    seed = os.environ.get("NISHIKI_FUZZ_SEED", "1")
    counts = [f"{target}={number * request.param}" for target, number in COUNTS.items()]
    command = [sys.executable, str(PROJECT / "tests/fuzz/short.py"), seed, *counts]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False, timeout=3600)
    lines = [line for line in done.stdout.splitlines() if line.startswith('{"target"')]
    assert len(lines) == len(COUNTS), f"ended with {done.returncode} after {lines[-1:]}: {done.stderr[-1500:]}"
    return request.param, {line["target"]: line for line in map(json.loads, lines)}


@pytest.mark.parametrize("target", COUNTS)
def test_a_reader_reads_or_refuses(counted, target):
    times, results = counted
    result = results[target]
    assert result["misbehaviour"] is None
    assert result["read"] >= result["seeds"] - 1, "the files that the changes start from are read"
    assert result["read"] + result["refused"] == result["seeds"] + times * COUNTS[target]
    assert result["refused"] > 0
