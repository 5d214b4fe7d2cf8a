"""The limits: every one has a reason and a remedy that names settings which exist; every figure is read somewhere."""

import re

import pytest
from refusals import refused

from nishiki.artifacts.declaration import Limit, at, check, limit_checks, limit_warnings
from nishiki.report.scene_page import conditions
from nishiki.stages.table import CHAIN, LIMITS

STATED = [(stage, limit) for stage, limits in LIMITS.items() for limit in limits if limit.stated]


@pytest.mark.parametrize(("stage", "limit"), STATED, ids=lambda value: getattr(value, "name", value))
def test_a_limit_has_a_reason_and_a_remedy_with_settings_that_exist(stage, limit):
    assert limit.why
    assert limit.remedy
    for other, setting in re.findall(r"\b([a-z_]+)\.([a-z]\w+)", limit.remedy):
        if other in CHAIN:
            assert setting in CHAIN[other].settings.model_fields, f"{other}.{setting}"


def test_names_are_unique_and_every_stage_exists():
    for stage, limits in LIMITS.items():
        assert stage in CHAIN
        assert len({limit.name for limit in limits}) == len(limits)


def test_the_setting_allow_knows_the_limits():
    for name, stage in CHAIN.items():
        known = tuple(limit.name for limit in LIMITS[name] if limit.stated)
        assert stage.settings(allow=known).allow == tuple(sorted(known))
        with refused(ValueError, "nothing"):
            stage.settings(allow=("nothing",))


def test_the_figures_of_a_registration_that_failed_stop_the_run():
    """Figures of six range scans of a simulated jar that a registration had put in the wrong place."""
    mesh = {"fit": {"iou_mean": 0.2635}, "area": 10377.8, "scans": {"residual": [0.0125, 0.0122]}}
    texels = {"visible_share": 0.0027, "silhouette_uncovered_share": 0.7363, "object_pixels": 5000}
    assert [each.limit.name for each in limit_checks(LIMITS["mesh"], mesh) if each.beyond] == ["silhouette_overlap"]
    assert [each.limit.name for each in limit_checks(LIMITS["texels"], texels) if each.beyond] == [
        "visible_share",
        "uncovered_share",
    ]
    check("texels", LIMITS["texels"], texels, ("visible_share", "uncovered_share"))


def test_what_the_outlines_or_the_bytes_do_not_bear_out_warns():
    mesh = {"genus": 3, "silhouettes": {"overruled": {"genus": 1}}}
    assert [each.limit.name for each in limit_checks(LIMITS["mesh"], mesh) if each.beyond] == ["unsure_handles"]
    assert limit_warnings("mesh", LIMITS["mesh"], mesh)
    assert not limit_warnings("mesh", LIMITS["mesh"], {**mesh, "genus": 1})
    assert not limit_warnings("mesh", LIMITS["mesh"], {**mesh, "silhouettes": {}})
    limits = LIMITS["object_evaluate"]
    for decoded, warned in ((22.3, True), (25.0, False), (33.7, False)):
        figures = {"jpeg2000": {"psnr_db": 26.8, "decoded_psnr_db": decoded}}
        assert bool(limit_warnings("object_evaluate", limits, figures)) == warned
        check("object_evaluate", limits, figures)
    assert not limit_warnings("object_evaluate", limits, {"jpeg2000": None})


def test_the_report_shows_every_figure_beside_its_limit():
    manifest = {"stage": "height", "settings": {"allow": ["convergence"]}, "diagnostics": {"residual": 0.5, "parts": 2}}
    rows = {meaning: rest for _, meaning, *rest in conditions(manifest, LIMITS["height"])}
    assert [row[0] for row in rows.values()] == ["0.5", "2"]
    assert ["0.001" in row[1] for row in rows.values()] == [True, False]


@pytest.mark.parametrize(("value", "warns", "stops"), [(0.97, False, False), (0.93, True, False), (0.8, False, True)])
def test_a_doubtful_figure_warns_and_one_beyond_stops(value, warns, stops):
    limit = Limit("overlap", "overlap", at("overlap"), least=0.9, doubt=0.95, remedy="look", why="so")
    figures = {"overlap": value}
    assert bool(limit_warnings("mesh", [limit], figures)) == warns
    assert limit_warnings("mesh", [limit], figures, ("overlap",)) == []
    assert [each.beyond for each in limit_checks([limit], figures)] == [stops]


@pytest.mark.parametrize(("stage", "limit"), STATED, ids=lambda value: getattr(value, "name", value))
def test_a_level_of_doubt_lies_on_the_sound_side(stage, limit):
    if limit.doubt is not None:
        assert not limit.beyond(limit.doubt)
        assert not limit.warns
