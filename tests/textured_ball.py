"""A bumpy ball with textures of colour, roughness and strength of the gloss, as the stage object_export has objects."""

from types import SimpleNamespace

import numpy as np
from unit.test_patches_atlas import atlas_of
from unit.test_patches_charts import around, ball

from nishiki.brdf.texels.model import CaptureLamps
from nishiki.formats.textured_surface import TexturedMesh
from nishiki.stages.export.object_look import ObjectLook, object_mesh, texture_atlas


def textured_ball(*, rows: int = 120, columns: int = 160) -> tuple[ObjectLook, TexturedMesh]:
    """The ball and its mesh, in metres; four views under a lamp above and beside the camera.

    Textures are smooth functions of the place on the ball, so that nothing depends on how a program interpolates; on
    one side the gloss is narrow, on the other broad.
    """
    mesh, cameras = ball(4), around(4, rows=rows, columns=columns)
    layout = texture_atlas(atlas_of(mesh, cameras))
    place = nearest_places(layout.corners.reshape(-1, 2), mesh.vertices[mesh.triangles].reshape(-1, 3), layout.shape)
    x, y, z = np.moveaxis(place, -1, 0)
    colour = np.stack([0.6 + 0.3 * x, 0.6 + 0.3 * y, 0.6 + 0.3 * np.cos(2 * z)], axis=-1)
    maps = (colour, 0.45 + 0.15 * y, 0.6 + 0.3 * np.sin(3 * x))
    pictures = (np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8) for values in maps)
    decoded = SimpleNamespace(
        mesh=mesh, cameras=cameras, lighting=CaptureLamps("position", ((1.5, 2.0, 0.5),)), views=["0", "1", "2", "3"]
    )
    look = ObjectLook(decoded, layout, *pictures, factor=1.4, scale=1.0, clipped=0.0)
    context = SimpleNamespace(inputs={"mesh": SimpleNamespace(diagnostics={"unit": "m"})})
    return look, object_mesh(context, look)


def nearest_places(corners: np.ndarray, positions: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(rows, columns, 3) position of the triangles' corner that is nearest to each texel, on texels beyond all too."""
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

    texels = np.stack(np.mgrid[: shape[0], : shape[1]], axis=-1)
    inside = LinearNDInterpolator(corners, positions)(texels)
    return np.where(np.isfinite(inside), inside, NearestNDInterpolator(corners, positions)(texels))
