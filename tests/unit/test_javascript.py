"""Functions of the viewer that need no browser, tested by node; types and style of its modules are checked in CI."""

import shutil
import subprocess
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1] / "javascript"


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
def test_functions_of_the_viewer():
    command = ["node", "--import", str(FOLDER / "modules.js"), "--test", str(FOLDER / "viewer.test.js")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "# fail 0" in done.stdout
    assert "# pass 0" not in done.stdout
