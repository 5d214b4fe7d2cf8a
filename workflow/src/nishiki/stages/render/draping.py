"""What the settings of the pictures describe: the draped surface with its weft, the lamps, the room."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nishiki.errors import UserError
from nishiki.geometry.mesh import Mesh
from nishiki.render.cloth.scene import Surface
from nishiki.render.cloth.studio import Lighting, linear_colour
from nishiki.render.cloth.surfaces import from_direction, from_texture, read_drape, read_surface, sheet
from nishiki.stages.render import ClothRenderSettings, MeshSettings

FINEST_SIDE = 193
"""Points along a side of the drawn cloth, half as many again as the shipped surface has."""
AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}


@dataclass(frozen=True)
class DrapedCloth:
    """A draped surface; uv (v, 2): texture coordinates, u along the weft, or None; about: what is to be said of it."""

    surface: Surface
    uv: np.ndarray | None
    about: dict


def draped_cloth(settings: ClothRenderSettings) -> DrapedCloth:
    """Return the cloth over the ball, or the surface of the file."""
    if settings.mesh is not None:
        return surface_from_file(settings.mesh)
    side = min(FINEST_SIDE, max(settings.view.rows, settings.view.columns) + 1)  # no more points than pixels
    surface, uv = sheet(read_drape(), side=side)
    return DrapedCloth(surface, uv, {"kind": "ball", **_sizes(surface.mesh)})


def surface_from_file(wanted: MeshSettings) -> DrapedCloth:
    """Return the surface of a file, with its weft. UserError where it cannot be used."""
    read = read_surface(Path(wanted.file), sha256=wanted.sha256, smooth=wanted.smooth)
    mesh, turn, uv = read.mesh, np.radians(wanted.turned_deg), None
    if wanted.weft == "texture":
        if read.uv is None:
            raise UserError(
                f"{wanted.file}: expected texture coordinates, one pair a vertex, found none. Remedy: set "
                "mesh.weft to x, y or z, the axis along which the weft is laid on"
            )
        field = from_texture(mesh.vertices, mesh.triangles, mesh.normals, read.uv, turn=turn)
        uv = read.uv if turn == 0 else None
    else:
        axis = np.array(AXES[wanted.weft], float)
        field = from_direction(mesh.vertices, mesh.triangles, mesh.normals, axis, turn=turn)
    about = {"transported": int(field.filled.sum()), "arbitrary": field.arbitrary, "sha256": read.sha256}
    return DrapedCloth(Surface(mesh, field.weft), uv, {"kind": "file", **_sizes(mesh), **about})


def _sizes(mesh: Mesh) -> dict:
    return {"vertices": len(mesh.vertices), "triangles": len(mesh.triangles)}


def lights_of(settings: ClothRenderSettings) -> list[Lighting]:
    """Return the lamps."""
    lights = []
    for lamp in settings.lights.values():
        red, green, blue = (lamp.intensity * value for value in linear_colour(lamp.colour))
        elevation, azimuth, radius = np.radians((lamp.elevation_deg, lamp.azimuth_deg, lamp.radius_deg))
        lights.append(Lighting(elevation, azimuth, (red, green, blue), radius))
    return lights


def room(settings: ClothRenderSettings) -> dict:
    """Return light from around, and the paper."""
    return {"level": settings.around, "reflectance": settings.paper}
