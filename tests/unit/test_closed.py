"""Mistakes in settings are told by the keys that the user wrote, with what would be right."""

import pytest

from nishiki.artifacts.closed import parse
from nishiki.engine.project import Configuration
from nishiki.errors import UserError
from nishiki.stages.table import PRODUCTS

PRODUCT_NAMES = f"{', '.join(map(repr, PRODUCTS[:-1]))} or {PRODUCTS[-1]!r}"
MESSAGES = {
    "a kind of value": ({"hold_out": "ring1"}, "hold_out: input should be 'auto' or 'none' or a list, found 'ring1'"),
    "a word or a block": (
        {"scatter": "all"},
        "scatter: input should be 'none' or 'auto' or a block of keys and values, found 'all'",
    ),
    "a key of such a block": (
        {"scatter": {"height": 2}},
        "scatter.height: input should be 'separate', 'normals' or 'spectra', found 'height'",
    ),
    "a value of such a block": (
        {"scatter": {"normals": 0}},
        "scatter.normals: input should be greater than or equal to 1, found 0",
    ),
    "a block that is none": ({"normals": 3}, "normals: input should be a block of keys and values, found 3"),
    "a word or a number": (
        {"separate": {"lights": "x"}},
        "separate.lights: input should be 'all' or 'auto' or an integer, found 'x'",
    ),
    "items of a list": (
        {"hold_out": ["a", 1]},
        "hold_out.1: input should be a valid string, found 1",
    ),
    "a list too short": ({"separate": {"keep": [0.1]}}, "key 'separate.keep.1' is missing"),
    "inside a list of blocks": (
        {"render": {"pictures": [{"nam": 1}]}},
        "key 'render.pictures.0.name' is missing; unknown key 'render.pictures.0.nam'; did you mean 'name'?",
    ),
    "blocks of several kinds": (
        {"render": {"pictures": [{"name": "a", "view": {"kind": "x"}}]}},
        "render.pictures.0.view.kind: input should be 'frontal' or 'pinhole', found 'x'",
    ),
    "one of a few words": (
        {"normals": {"solver": "x"}},
        "normals.solver: input should be 'default', 'lobe' or 'least_squares', found 'x'",
    ),
    "a stage by its former name": ({"fabric": {"oblique": 0}}, "unknown key 'fabric'; it is now called 'cloth_brdf'"),
    "a product by its former name": (
        {"products": ["weave", "reflection"]},
        f"products.1: input should be {PRODUCT_NAMES}, found 'reflection'; it is now called 'object_brdf'",
    ),
    "the only product by its former name": (
        {"products": ["fabric"]},
        f"products.0: input should be {PRODUCT_NAMES}, found 'fabric'; it is now called 'cloth_brdf'",
    ),
    "a key that is near": ({"heigth": {}}, "unknown key 'heigth'; did you mean 'height'?"),
}


@pytest.mark.parametrize("name", MESSAGES)
def test_what_is_reported(name):
    values, words = MESSAGES[name]
    with pytest.raises(UserError) as told:
        parse(Configuration, values, "c.yaml")
    assert str(told.value) == f"c.yaml: {words}"
