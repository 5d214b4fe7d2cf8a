"""A short form of the campaign of faults: every kind for a painting, four kinds for an object and a cloth."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

CAMPAIGN = Path(__file__).resolve().parent / "campaign.py"
FEW = ["--kinds", "killed run", "flipped bit", "deleted file", "changed capture"]


@pytest.mark.long
@pytest.mark.parametrize(("scene", "kinds"), [("plane", []), ("turntable", FEW), ("goniometer", FEW)])
def test_every_fault_is_noticed_and_mended_and_nothing_is_lost(scene, kinds):
    arguments = ["--seed", "1", "--kills", "2", "--amount", "1", "--scenes", scene, *kinds]
    done = subprocess.run([sys.executable, CAMPAIGN, *arguments], capture_output=True, text=True, check=False)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, done.stdout + done.stderr
    total = lines[-1]
    assert total["tried"] == total["detected"] == total["recovered"] > 15
    assert total["lost"] == total["wrong"] == 0
    assert not kinds or {line["kind"] for line in lines[:-1]} == set(kinds[1:])
