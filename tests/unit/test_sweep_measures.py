"""Sweeps: figures found by their paths."""

import pytest

from nishiki.errors import UserError
from nishiki.sweep.variants import NORMALS, MeasureSettings, as_measure, average_common, candidates, paths_in, values_of

DIAGNOSTICS = {
    "a": {"b": 2.0, "text": "x", "yes": True},
    "regions": {"x": {"m": {"15": 1.0, "30": 3.0}}, "y": {"m": {"15": 5.0}}},
}


def value(path, sources=(DIAGNOSTICS,), settings=None):
    found = values_of(MeasureSettings(path=path), list(sources), settings or {})
    return average_common({"variant": found})["variant"]


def test_paths_stars_and_settings():
    assert value("a.b") == 2.0
    assert value("regions.*.m.15") == 3.0
    assert value("regions.x.m.*") == 2.0
    assert value("regions.*.{cloth_brdf.model}.*", settings={"cloth_brdf": {"model": "m"}}) == 3.0


@pytest.mark.parametrize("path", ["a.c", "a", "a.text", "a.yes", "a.b.c", "none"])
def test_what_is_not_there_or_no_number_is_none(path):
    assert value(path) is None


def test_variants_are_compared_on_what_all_of_them_have():
    found = {"a": {("15",): 1.0, ("30",): 3.0}, "b": {("0",): 0.0, ("15",): 2.0, ("30",): 4.0}}
    assert average_common(found) == {"a": 2.0, "b": 3.0}
    assert average_common({**found, "c": {}}) == {"a": 2.0, "b": 3.0, "c": None}
    assert average_common({"a": {("15",): 1.0}, "b": {("0",): 1.0}}) == {"a": None, "b": None}


def test_the_first_source_that_has_it_counts_and_lists_are_numbered():
    rows = {"rows": [{"e": 1.0}, {"e": 2.0}], "a": {"b": 9.0}}
    assert value("a.b", [DIAGNOSTICS, rows]) == 2.0
    assert value("rows.1.e", [DIAGNOSTICS, rows]) == 2.0
    assert value("rows.*.e", [DIAGNOSTICS, rows]) == 1.5


def test_values_that_are_not_finite_are_none():
    assert value("a", [{"a": float("nan")}]) is None


def test_a_setting_that_the_variant_lacks_is_reported():
    with pytest.raises(UserError, match=r"cloth_brdf\.model"):
        value("{cloth_brdf.model}")


def test_usual_measures():
    assert as_measure("normals_mean_deg") is NORMALS
    assert as_measure("x.y") == MeasureSettings(path="x.y")
    assert candidates("normals", "plane")[0] is NORMALS
    assert candidates("spectra", "plane")[0].path == "reflectance_rmse_mean"
    assert candidates("residual", "turntable")[0].better == "higher"
    assert paths_in(DIAGNOSTICS)[0] == "a.b"
    assert "regions.y.m.15" in paths_in(DIAGNOSTICS)
