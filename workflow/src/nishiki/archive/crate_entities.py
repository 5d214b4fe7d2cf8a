"""Words that all parts of a crate's description use: entities, references to them, formats of files."""

import re
from collections.abc import Iterable
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import quote

METADATA = "ro-crate-metadata.json"
BIOSCHEMAS = "https://bioschemas.org/profiles/"
PROJECT_LICENCE = "https://spdx.org/licenses/BSD-3-Clause"
FORMATS = {
    ".json": "application/json",
    ".jsonld": "application/ld+json",
    ".xml": "application/xml",
    ".csv": "text/csv",
    ".html": "text/html",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".svg": "image/svg+xml",
    ".exr": "image/x-exr",
    ".mp4": "video/mp4",
    ".webp": "image/webp",
    ".npz": "application/zip",
    ".ply": "model/ply",
    ".glb": "model/gltf-binary",
    ".usdz": "model/vnd.usdz+zip",
    ".md": "text/markdown",
    ".txt": "text/plain",
}
Entity = dict[str, Any]


def ids(names: Iterable[str]) -> list[Entity] | Entity:
    """References to entities; to a single one without a list, as the compact form has it."""
    references = [{"@id": name} for name in names]
    return references[0] if len(references) == 1 else references


def is_address(text: str | None) -> bool:
    """Whether a text, such as the rights in capture.yaml, is an address on the web and can identify what it says."""
    return bool(text and re.fullmatch(r"https?://[^\s<>\"]+", text))


def quoted(name: str) -> str:
    """A file's name as an identifier may hold it."""
    return quote(name, safe="/:@!$&'()*+,;=-._~")


def media_type(name: str) -> str:
    """Media type by the suffix of a name."""
    return FORMATS.get(PurePosixPath(name).suffix, "application/octet-stream")
