"""Capture runs that are killed, unplugged or out of disk end with the bytes of an undisturbed run."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

CAMPAIGN = Path(__file__).resolve().parent / "rig_campaign.py"


@pytest.mark.parametrize(
    ("seed", "trials"), [pytest.param(1, 6, marks=pytest.mark.slow), pytest.param(2, 60, marks=pytest.mark.long)]
)
def test_every_frame_is_there_once_and_nothing_is_lost(seed, trials):
    arguments = ["--seed", str(seed), "--trials", str(trials)]
    done = subprocess.run([sys.executable, CAMPAIGN, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    sums = json.loads(done.stdout.splitlines()[-1])
    assert sums["trials"] == trials
    assert sums["interruptions"] >= trials // 2
    assert sums["kill"] == sums["full disk"] == sums["unplugged"] == trials // 3
