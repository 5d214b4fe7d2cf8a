"""Where packages of npm are that some tests ask for a second opinion."""

from __future__ import annotations

import os
from pathlib import Path


def npm_folder(*files: str) -> Path | None:
    """The first folder of NODE_PATH that has all these files below it; None where none has."""
    folders = [Path(folder) for folder in os.environ.get("NODE_PATH", "").split(os.pathsep) if folder]
    return next((folder for folder in folders if all((folder / file).is_file() for file in files)), None)
