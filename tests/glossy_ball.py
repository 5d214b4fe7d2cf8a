"""A glossy ball with four cameras and a lamp beside each, as the stage `object_export` has objects."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from unit.test_patches_atlas import atlas_of
from unit.test_patches_charts import around, ball

from nishiki.brdf.texels.model import CaptureLamps
from nishiki.stages.export.object_look import ObjectLook, texture_atlas

PLACE = (0.3, 0.2, 0.1)  # of the lamp, in the camera's frame


def glossy_ball() -> tuple[ObjectLook, dict[str, np.ndarray], SimpleNamespace]:
    """Its look, textures of the model as `model_textures` gives them, and a context whose unit is the millimetre."""
    mesh = ball(4, noise=0.001)
    atlas = atlas_of(mesh, around(4))
    layout = texture_atlas(atlas)
    y, x = np.mgrid[: layout.shape[0], : layout.shape[1]] / 20
    kd = np.stack([0.4 + 0.2 * np.sin(x), 0.3 + 0.1 * np.cos(y), 0.2 + 0 * x], axis=-1).astype(np.float32)
    ks = np.repeat((0.3 + 0.1 * np.sin(x + y))[..., None], 3, axis=-1).astype(np.float32)
    sigma = (0.2 + 0.05 * np.cos(x - y))[..., None].astype(np.float32)
    cameras = [replace(camera, name=f"{k} é") for k, camera in enumerate(around(4))]
    decoded = SimpleNamespace(
        mesh=mesh, cameras=cameras, views=[camera.name for camera in cameras], lights=["lamp"],
        lighting=CaptureLamps("position", (PLACE,)),
    )  # fmt: skip
    grey = (64 + 100 * (np.sin(x) + 1) / 2).astype(np.uint8)
    look = ObjectLook(decoded, layout, np.rint(255 * kd).astype(np.uint8), grey, grey[::-1], 3.0, 1.5, 0.0)
    context = SimpleNamespace(inputs={"mesh": SimpleNamespace(diagnostics={"unit": "mm"})})
    return look, {"kd": kd, "ks": ks, "sigma": sigma}, context
