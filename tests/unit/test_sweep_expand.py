"""Sweeps: from the block to its variants, and bad blocks."""

import pytest

from nishiki.artifacts.declaration import parse
from nishiki.errors import UserError
from nishiki.stages.table import CHAIN
from nishiki.sweep.variants import AS_CONFIGURED, SweepSettings, expand, nest_settings


def variants(**block):
    return expand(parse(SweepSettings, {"stage": "normals", **block}, "x.yaml"), stages=CHAIN, where="x.yaml")


def test_a_grid_is_all_combinations_in_the_order_of_its_keys():
    found = variants(vary={"solver": ["lobe", "least_squares"], "separate.method": ["refit", "none"]})
    assert [variant.name for variant in found] == [
        AS_CONFIGURED,
        "solver=lobe, separate.method=refit",
        "solver=lobe, separate.method=none",
        "solver=least_squares, separate.method=refit",
        "solver=least_squares, separate.method=none",
    ]
    assert found[2].overrides == {"normals": {"solver": "lobe"}, "separate": {"method": "none"}}


def test_named_variants_change_several_settings_at_once():
    found = variants(
        variants={"paper": {"separate.method": "threshold", "solver": "least_squares", "separate.w1": 1.3}}
    )
    assert found[1].overrides == {
        "separate": {"method": "threshold", "w1": 1.3},
        "normals": {"solver": "least_squares"},
    }


def test_the_stage_s_own_prefix_is_left_out_of_names_and_values_are_reported():
    found = variants(vary={"normals.refine": [None], "separate.keep": [[0.2, 0.8]], "normals.x": [True]})
    assert found[1].name == "refine=none, separate.keep=0.2/0.8, x=yes"


def test_a_name_with_a_value_is_a_setting_and_with_a_block_a_stage():
    assert nest_settings({"reflectance": "mean"}, "normals", CHAIN, "x") == {"normals": {"reflectance": "mean"}}
    assert nest_settings({"goniometer_samples": {"window_px": 8}}, "normals", CHAIN, "x") == {
        "goniometer_samples": {"window_px": 8}
    }
    assert nest_settings({"view.rows": 65}, "cloth_render", CHAIN, "x") == {"cloth_render": {"view": {"rows": 65}}}


@pytest.mark.parametrize(
    ("block", "message"),
    [
        ({}, "vary"),
        ({"vary": {"solver": []}}, "vary.solver"),
        ({"vary": {"solver": "lobe"}}, "vary.solver"),
        (
            {"variants": {"a": {"solver": "lobe"}}, "paper": "b"},
            "'b'",
        ),
        ({"variants": {"a": {"solver": "lobe"}}, "peers": ["c"]}, "'c'"),
        ({"vary": {"solver": ["lobe"]}, "variants": {"solver=lobe": {}}}, "'solver=lobe'"),
        ({"variants": {"a": {"solver": "lobe", "normals.solver": "least_squares"}}}, "normals.solver"),
        ({"variants": {"a": {"solver": "lobe", "solver.x": 1}}}, "solver"),
        ({"variants": {"a": {"solver": "lobe"}}, "repeat": 2}, "'repeats'"),
        ({"variants": {"a": {"solver": "lobe"}}, "repeats": 0}, "repeats"),
        ({"variants": {"a": {"solver": "lobe"}}, "error": [{"path": "x", "better": "more"}]}, "error.0"),
        ({"variants": {"a": {"solver": "lobe"}}, "axis": "hours"}, "axis"),
    ],
)
def test_bad_blocks_are_told_with_file_and_key(block, message):
    with pytest.raises(UserError, match=r"x\.yaml") as told:
        variants(**block)
    assert message in str(told.value)
