"""The digest of a sealed capture: what the keys of all its stages start from."""

from pathlib import Path

from nishiki.errors import UserError
from nishiki.provenance import file_digest

MANIFEST = "manifest-sha256.txt"


def capture_digest(folder: Path) -> str:
    """SHA-256 of the manifest of a sealed capture (decision record 0003).

    Raises UserError where the folder is missing or not sealed, with the command that seals it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"{folder}: capture folder not found; ./nishiki convert makes one from photographs")
    manifest = folder / MANIFEST
    if not manifest.is_file():
        raise UserError(f"{folder}: the capture is not sealed ({MANIFEST} is missing). Remedy: ./nishiki seal {folder}")
    return file_digest(manifest)
