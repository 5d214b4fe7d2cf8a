"""Mistakes in settings are told by the keys that the user wrote, with what would be right."""

import pytest
from pydantic import ValidationError
from refusals import refused

from nishiki.artifacts.declaration import faults, parse
from nishiki.engine.project import Configuration
from nishiki.errors import UserError

FAULTS = {
    "a kind of value": ({"hold_out": "ring1"}, [("wrong-value", "hold_out", "ring1")]),
    "a word or a block": ({"scatter": "all"}, [("wrong-value", "scatter", "all")]),
    "a key of such a block": ({"scatter": {"height": 2}}, [("wrong-value", "scatter.height", "height")]),
    "a value of such a block": ({"scatter": {"normals": 0}}, [("wrong-value", "scatter.normals", 0)]),
    "a block that is none": ({"normals": 3}, [("wrong-value", "normals", 3)]),
    "a word or a number": ({"separate": {"lights": "x"}}, [("wrong-value", "separate.lights", "x")]),
    "items of a list": ({"hold_out": ["a", 1]}, [("wrong-value", "hold_out.1", 1)]),
    "a list too short": ({"separate": {"keep": [0.1]}}, [("missing-key", "separate.keep.1", None)]),
    "inside a list of blocks": (
        {"render": {"pictures": [{"nam": 1}]}},
        [("missing-key", "render.pictures.0.name", None), ("unknown-key", "render.pictures.0.nam", None)],
    ),
    "blocks of several kinds": (
        {"render": {"pictures": [{"name": "a", "view": {"kind": "x"}}]}},
        [("wrong-value", "render.pictures.0.view.kind", "x")],
    ),
    "one of a few words": ({"normals": {"solver": "x"}}, [("wrong-value", "normals.solver", "x")]),
    "an unknown product": ({"products": ["weave", "fabric"]}, [("wrong-value", "products.1", "fabric")]),
    "a key that is near": ({"heigth": {}}, [("unknown-key", "heigth", None)]),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_reported(name):
    values, expected = FAULTS[name]
    with pytest.raises(ValidationError) as caught:
        Configuration.model_validate(values)
    found = faults(Configuration, values, caught.value)
    assert [(fault.kind, fault.key, fault.value) for fault in found] == expected
    with refused(UserError, *(fault.key for fault in found)):
        parse(Configuration, values, "c.yaml")


def test_the_nearest_key_is_named():
    with refused(UserError, "heigth", "height"):
        parse(Configuration, {"heigth": {}}, "c.yaml")
