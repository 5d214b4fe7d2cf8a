"""Scene files of Mitsuba 3 (XML): written from the nested dictionaries that its function `load_dict` takes.

A dictionary with the key `type` is an object; numbers, texts and arrays are its properties: 3 numbers are a vector
(`position`: a point), 4 x 4 a transform, dictionaries of type rgb colours. `Parameter` stands for a number that
`mitsuba -D NAME=VALUE` sets. https://mitsuba.readthedocs.io/en/stable/src/key_topics/scene_format.html
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

VERSION = "3.0.0"
PLUGINS = {
    **dict.fromkeys(("principled", "diffuse", "blendbsdf", "normalmap", "twosided"), "bsdf"),
    **dict.fromkeys(("point", "directional", "constant"), "emitter"),
    **dict.fromkeys(("perspective", "orthographic"), "sensor"),
    **{"bitmap": "texture", "ply": "shape", "path": "integrator", "hdrfilm": "film", "box": "rfilter"},
    "independent": "sampler",
}
"""Kind of each type of object that our scenes have."""


@dataclass(frozen=True)
class Parameter:
    """A property that the caller of `mitsuba` may set; name: of a default of the scene; kind: float, integer, ..."""

    name: str
    kind: str


def write_scene(
    path: Path,
    objects: Mapping[str, Any],
    *,
    defaults: Mapping[str, float | int | str] | None = None,
    include: str | None = None,
    remark: str = "",
) -> None:
    """Write a scene of named objects; defaults: of its parameters; include: another scene file, relative to it.

    Raises
    ------
    TypeError
        Where a value has no form in XML.
    """
    scene = ElementTree.Element("scene", version=VERSION)
    if remark:
        scene.append(ElementTree.Comment(f" {re.sub('-(?=-)', '- ', remark)} "))
    for name, value in (defaults or {}).items():
        ElementTree.SubElement(scene, "default", name=name, value=_text(value))
    for name, values in objects.items():
        _append(scene, name, values)
    if include:
        ElementTree.SubElement(scene, "include", filename=include)
    ElementTree.indent(scene)
    ElementTree.ElementTree(scene).write(path, encoding="utf-8", xml_declaration=True)


def _append(parent: ElementTree.Element, name: str, value: Any) -> None:
    if isinstance(value, Mapping):
        kind = value["type"]
        if kind == "rgb":
            ElementTree.SubElement(parent, "rgb", name=name, value=_text(value["value"]))
            return
        element = ElementTree.SubElement(parent, PLUGINS[kind], type=kind, name=name)
        for inner, each in value.items():
            if inner != "type":
                _append(element, inner, each)
    elif isinstance(value, Parameter):
        ElementTree.SubElement(parent, value.kind, name=name, value=f"${value.name}")
    elif isinstance(value, list | tuple | np.ndarray):
        _append_array(parent, name, value)
    else:
        ElementTree.SubElement(parent, _kind(value), name=name, value=_text(value))


def _append_array(parent: ElementTree.Element, name: str, value: Any) -> None:
    if len(value) == 3:
        axes = {
            axis: f"${each.name}" if isinstance(each, Parameter) else _text(each)
            for axis, each in zip("xyz", value, strict=True)
        }
        ElementTree.SubElement(parent, "point" if name == "position" else "vector", {"name": name, **axes})
        return
    transform = ElementTree.SubElement(parent, "transform", name=name)
    ElementTree.SubElement(transform, "matrix", value=_text(np.asarray(value, np.float64).reshape(16)))


def _kind(value: Any) -> str:
    for kind, of in ((bool, "boolean"), (int, "integer"), (float, "float"), (str, "string")):
        if isinstance(value, kind):
            return of
    raise TypeError(f"expected a number, a text or an array, found {type(value).__name__}")


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return value
    if np.ndim(value):
        return " ".join(_text(each) for each in value)
    return f"{value:.9g}"
