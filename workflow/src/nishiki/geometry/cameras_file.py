"""The file of calibrated views, `cameras.json`."""

from __future__ import annotations

import json
from pathlib import Path

from nishiki.errors import UserError
from nishiki.geometry.camera import Camera


def save_cameras(
    path: Path,
    cameras: list[Camera],
    *,
    unit: str,
    full_turn: bool,
    source: str,
    reprojection_px: list[float | None],
    mirror: tuple[int, int, int] | None = None,
) -> None:
    """Write the views in the order of the turn; reprojection_px: root mean square of each view, None if unmeasured.

    source: matrices | boards | correspondences. mirror: factors that were put on the world's axes (see
    `nishiki.geometry.matrices`); coordinates of the capture's own world have to be multiplied by them.
    """
    views = [
        {**camera.as_dict(), "reprojection_px": error} for camera, error in zip(cameras, reprojection_px, strict=True)
    ]
    document = {"unit": unit, "full_turn": full_turn, "source": source, "mirror": mirror, "views": views}
    Path(path).write_text(json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n")


def read_cameras(path: Path) -> dict:
    """The whole document: unit, full_turn, source, mirror, views. UserError where it is missing or not one."""
    try:
        document = json.loads(Path(path).read_text())
        document["views"][0]["intrinsics"]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise UserError(f"{path}: not a file of cameras ({error}). Remedy: run the stage cameras again") from None
    return document


def load_cameras(path: Path) -> list[Camera]:
    """The cameras alone, in the order of the turn. UserError as `read_cameras`."""
    return [Camera.from_dict(values) for values in read_cameras(path)["views"]]
