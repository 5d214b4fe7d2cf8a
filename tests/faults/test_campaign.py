"""A short form of the campaign of faults: one small scene, few faults of the kinds that need no second machine."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

CAMPAIGN = Path(__file__).resolve().parent / "campaign.py"
KINDS = ("killed run", "flipped bit", "deleted file", "changed capture")


@pytest.mark.slow
def test_every_fault_is_noticed_and_mended_and_nothing_is_lost():
    arguments = ["--seed", "1", "--kills", "2", "--amount", "1", "--scenes", "plane", "--kinds", *KINDS]
    done = subprocess.run([sys.executable, CAMPAIGN, *arguments], capture_output=True, text=True, check=False)
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, done.stdout + done.stderr
    whole = lines[-1]
    assert whole["tried"] == whole["detected"] == whole["recovered"] > 20
    assert whole["lost"] == whole["wrong"] == 0
    assert {line["kind"] for line in lines[:-1]} == set(KINDS)
