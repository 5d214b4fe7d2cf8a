"""A textured mesh and a dielectric as formats of scenes know them: what glTF, USD and MaterialX write of a surface.

Light is reflected diffusely by a base under a lobe of Trowbridge and Reitz with alpha = roughness^2. Its reflectance is
F0 along the normal and 1 at grazing light, so that an index of refraction n = (1 + sqrt F0) / (1 - sqrt F0) says it.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TexturedMesh:
    """Triangles with places in a texture.

    Attributes
    ----------
    positions, normals : (n, 3) ndarray
        Of the vertices, metres and unit vectors.
    texture : (n, 2) ndarray
        Places in the texture, 0 to 1, from its left and its top.
    triangles : (t, 3) ndarray
        Numbers of vertices, counter-clockwise seen from outside.
    """

    positions: np.ndarray
    normals: np.ndarray
    texture: np.ndarray
    triangles: np.ndarray


@dataclass(frozen=True)
class SurfaceLook:
    """Textures and constants of one material; rows of textures from the top.

    Attributes
    ----------
    colour : (rows, columns, 3) uint8 ndarray
        Colour of the base, sRGB.
    roughness : float or (rows, columns) uint8 ndarray
        0 to 1; of a texture 255 is 1.
    reflectance : float
        F0, 0 to below 1; where there are weights, of weight 1.
    weight : (rows, columns) uint8 ndarray or None
        Share of the reflectance, 255 is all.
    normals : (rows, columns, 3) uint8 ndarray or None
        Tangent space, y up, (n + 1) / 2.
    """

    colour: np.ndarray
    roughness: float | np.ndarray
    reflectance: float
    weight: np.ndarray | None = None
    normals: np.ndarray | None = None

    @property
    def index(self) -> float:
        """Index of refraction of the reflectance."""
        return index_of(self.reflectance)

    @property
    def mean_index(self) -> float:
        """Index of refraction of the reflectance with the mean of its weights."""
        return self.index if self.weight is None else index_of(self.reflectance * float(self.weight.mean()) / 255)

    def pictures(self) -> dict[str, np.ndarray]:
        """The textures that there are, (rows, columns, 3), by the name of their file without suffix.

        Single values are repeated in three channels: programs read pictures of one channel differently.
        """
        named = {"colour": self.colour, "roughness": self.roughness, "specular": self.weight, "normals": self.normals}
        given = {name: values for name, values in named.items() if isinstance(values, np.ndarray)}
        return {
            name: values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=-1)
            for name, values in given.items()
        }


def index_of(reflectance: float) -> float:
    """Index of refraction of a dielectric with this reflectance along the normal, at most 199."""
    root = min(float(np.sqrt(reflectance)), 0.99)
    return (1 + root) / (1 - root)
