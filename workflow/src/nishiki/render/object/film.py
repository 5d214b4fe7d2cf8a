"""Frames of the object turning."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nishiki.geometry.camera_path import scaled
from nishiki.render.display import developed
from nishiki.render.object.coverage import reduced
from nishiki.render.object.renderer import ObjectRenderer
from nishiki.render.object.shots import lit_by


def places(views: int, frames_per_step: int, *, closed: bool) -> list[tuple[int, float]]:
    """(view, fraction of the way to the next) of each frame: once round, or there and back where the turn is open."""
    steps = views if closed else views - 1
    forth = [(k // frames_per_step, k % frames_per_step / frames_per_step) for k in range(steps * frames_per_step)]
    if closed or views < 2:
        return forth or [(0, 0.0)]
    return [*forth, (views - 2, 1.0), *forth[:0:-1]]


def frames(
    renderer: ObjectRenderer,
    *,
    frames_per_step: int,
    columns: int,
    supersampling: int = 2,
    lights: tuple[tuple[int, float], ...] = ((0, 1.0),),
    background: float = 0.0,
) -> Iterator[np.ndarray]:
    """(rows, columns, 3) uint8 sRGB frames along the turn, each the mean of supersampling² samples a pixel."""
    width = min(columns, renderer.cameras[0].columns)
    factor = width * supersampling / renderer.cameras[0].columns

    def scale(camera):
        return scaled(camera, factor)

    along = places(len(renderer.cameras), frames_per_step, closed=renderer.turn.closed)
    shots = (lit_by(renderer.between(view, fraction, scale=scale), lights) for view, fraction in along)
    for picture in renderer.render(shots):
        linear, alpha = reduced(picture.linear, picture.covered, supersampling)
        yield developed(linear, alpha, background=background).pixels
