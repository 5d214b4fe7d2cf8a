"""Files of artifacts as a page shows them: JSON, rendered pictures, films."""

from __future__ import annotations

import base64
import json
from typing import Any

from nishiki.artifacts.artifact import Artifact
from nishiki.report.page import Figure

FILMS = {".mp4": "video/mp4", ".webp": "image/webp", ".png": "image/png"}


def contents(artifact: Artifact | None, name: str | None) -> bytes | None:
    """A file that the artifact lists; None where there is none."""
    if artifact is None or name not in artifact.manifest["files"]:
        return None
    return artifact.path(name).read_bytes()


def read_json(artifact: Artifact | None, name: str) -> dict[str, Any] | None:
    """A JSON file that the artifact lists; None where there is none."""
    data = contents(artifact, name)
    return None if data is None else json.loads(data)


def film(artifact: Artifact, file: str, heading: str, caption: str, largest_mb: float) -> Figure | str:
    """A film of the artifact; a sentence that names it where it is too large for the page, or of another kind."""
    data = artifact.path(file).read_bytes()
    kind = next((mime for ending, mime in FILMS.items() if file.endswith(ending)), None)
    if kind is None or len(data) > largest_mb * 1e6:
        return f"{heading} is too large for this page: {artifact.stage}/{artifact.key}/{file}. {caption}"
    return Figure(heading, caption, video=f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}")
