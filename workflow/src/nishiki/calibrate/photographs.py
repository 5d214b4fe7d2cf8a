"""Photographs that a calibration reads: files or folders, as codes, all of one size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nishiki.capture.layouts import photographs_in
from nishiki.errors import UserError
from nishiki.formats.image_headers import read_header


def list_photographs(names: Sequence[str], *, least: int = 1, what: str = "photographs") -> list[Path]:
    """Files as given, folders replaced by the photographs in them in natural order; masks in folders are left out.

    UserError where a name is no file, two are called alike, they are fewer than `least`, or sizes differ.
    """
    paths: list[Path] = []
    for name in names:
        path = Path(name)
        if path.is_dir():
            paths += photographs_in(path)
        elif path.is_file():
            paths.append(path)
        else:
            raise UserError(f"{name}: no such file or folder. Remedy: correct the path of the {what}")
    if len(paths) < least:
        raise UserError(f"{what}: expected at least {least}, found {len(paths)}")
    headers = [read_header(path) for path in paths]
    sizes = {(h.rows, h.columns, h.channels, h.sample) for h in headers}
    if len(sizes) > 1:
        raise UserError(
            f"{what}: expected one size, depth and number of channels, found "
            f"{'; '.join(f'{c} x {r}, {n} channels of {s}' for r, c, n, s in sorted(sizes))}. Remedy: give the "
            "photographs of one camera with one setting"
        )
    return paths
