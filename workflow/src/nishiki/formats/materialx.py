"""MaterialX 1.39: a surface as a document with the node open_pbr_surface, and its textures as PNG beside it.

OpenPBR (Academy Software Foundation, 2024): specular_ior is the index whose reflectance along the normal is F0, and
specular_weight the share of that reflectance. Places in a texture count from the left and from the bottom.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nishiki.formats.picture_tiles import png_bytes
from nishiki.formats.textured_surface import SurfaceLook
from nishiki.packages import optional

INPUTS = {
    "colour": ("base_color", "color3"),
    "roughness": ("specular_roughness", "float"),
    "specular": ("specular_weight", "float"),
    "normals": ("geometry_normal", "vector3"),
}
"""Of each texture the input of the surface that it feeds, and the type of its values."""


def write_materialx(path: Path, look: SurfaceLook, *, facts: Mapping[str, Any]) -> list[str]:
    """Write the document and its textures; the names of the files, relative to the document's folder.

    facts: what the document says of its making.

    Raises
    ------
    UserError
        Where the package materialx is not installed.
    RuntimeError
        Where MaterialX finds the document invalid.
    """
    optional("materialx")
    import MaterialX

    document = MaterialX.createDocument()
    libraries = MaterialX.createDocument()
    MaterialX.loadLibraries(MaterialX.getDefaultDataLibraryFolders(), MaterialX.getDefaultDataSearchPath(), libraries)
    document.setDataLibrary(libraries)
    document.setColorSpace("lin_rec709")
    told = ", ".join(f"{name} {value}" for name, value in facts.items())
    document.setDocString(f"Made by Nishiki ({told}). Places in the textures as in its USD and glTF files.")
    surface = document.addNode("open_pbr_surface", "open_pbr_surface", "surfaceshader")
    _set(surface, "base_weight", 1.0)
    _set(surface, "specular_ior", look.index)
    if not isinstance(look.roughness, np.ndarray):
        _set(surface, "specular_roughness", look.roughness)
    files = []
    graph = document.addNodeGraph("textures")
    for texture, picture in look.pictures().items():
        files.append(f"{texture}.png")
        (path.parent / files[-1]).write_bytes(png_bytes(picture))
        _connect(graph, surface, texture)
    document.addMaterialNode("material", surface)
    valid, report = document.validate()
    if not valid:
        raise RuntimeError(f"MaterialX finds its own document invalid: {report}")
    MaterialX.writeToXmlFile(document, str(path))
    return [path.name, *files]


def _connect(graph: Any, surface: Any, texture: str) -> None:
    """An image that feeds an input of the surface."""
    name, kind = INPUTS[texture]
    image = graph.addNode("image", texture, kind)
    file = image.addInput("file", "filename")
    file.setValueString(f"{texture}.png")
    if texture == "colour":
        file.setColorSpace("srgb_texture")
    for side in ("uaddressmode", "vaddressmode"):
        image.addInput(side, "string").setValueString("clamp")
    if texture == "normals":
        turned = graph.addNode("normalmap", "turned", kind)
        turned.addInput("in", kind).setConnectedNode(image)
        image = turned
    output = graph.addOutput(f"{texture}_out", kind)
    output.setConnectedNode(image)
    surface.addInput(name, kind).setConnectedOutput(output)


def _set(surface: Any, name: str, value: float) -> None:
    surface.addInput(name, "float").setValueString(f"{value:.9g}")
