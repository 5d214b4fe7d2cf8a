"""Sweeps: rows from the records of repeats, drawings, table and page."""

import csv
import io
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import pytest

from nishiki.sweep.front import VariantPoint, axis_over, plot
from nishiki.sweep.page import render_sweep, scene_content, sweep_content, table_rows
from nishiki.sweep.variants import MeasureSettings, Spread, SweepSettings, variant_row

ERROR = MeasureSettings(path="deg", label="angle", unit="°")


def record(stage, seconds, *, cpu=None, memory=100.0, same=True):
    return {
        "stage": stage, "seconds": seconds, "cpu_seconds": cpu or seconds, "peak_memory_mib": memory, "bytes": 1000,
        "same": same, "different": [] if same else ["maps.zarr/x"], "load_before": 0.1, "processor": "P", "cpus": 4,
        "python": "3",
    }  # fmt: skip


def row(name, error, records, **roles):
    roles = {"default": False, "paper": False, "peer": False, **roles}
    row = variant_row(name, (name,), (), (error,), records, keys={stage: "k" for stage in records})
    return replace(row, **roles)


def test_times_of_stages_are_added_repeat_by_repeat():
    records = {
        "separate": [record("separate", 1.0), record("separate", 3.0), record("separate", 2.0)],
        "normals": [record("normals", 5.0, memory=300), record("normals", 1.0, memory=200), record("normals", 1.5)],
    }
    made = row("a", 1.0, records)
    assert made.times["seconds"] == Spread(4.0, 3.5, 6.0)
    assert made.stages["normals"]["seconds"] == Spread(1.5, 1.0, 5.0)
    assert (made.peak_memory_mib, made.bytes, made.repeats, made.reproducible) == (200, 2000, 3, True)


def test_a_stage_left_out_costs_nothing():
    assert row("a", 1.0, {}).times["cpu_seconds"] == Spread(0.0, 0.0, 0.0)


def scene(**changes):
    rows = [
        row("plain <a>", 4.0, {"normals": [record("normals", 10.0), record("normals", 11.0)]}, default=True),
        row("quick", 5.0, {"normals": [record("normals", 2.0), record("normals", 2.2, same=False)]}, paper=True),
        row("bad", 6.0, {"normals": [record("normals", 20.0), record("normals", 20.0)]}, peer=True),
    ]
    return scene_content("cat", rows, [ERROR], axis="seconds", counted=["normals"], evaluation="evaluate", **changes)


def test_page_table_and_drawing_tell_the_same():
    content = sweep_content("x", "A title", "1", SweepSettings(stage="normals", vary={"a": [1]}), [scene()])
    (made,) = content["scenes"]
    assert [row["ahead"] for row in made["rows"]] == [(True,), (True,), (False,)]
    page = render_sweep(content)
    assert page.count("<svg") == 1
    assert "plain &lt;a&gt;" in page
    assert "plain <a>" not in page
    assert page.count("<b>not ") == 1
    assert "maps.zarr/x" in page
    for line in made["advice"][0]:
        assert line.replace("'", "&#39;").replace("<", "&lt;").replace(">", "&gt;") in page
    table = table_rows(content)
    assert [(one["variant"], one["deg"], one["seconds_median"]) for one in table] == [
        ("plain <a>", 4.0, 10.5),
        ("quick", 5.0, 2.1),
        ("bad", 6.0, 20.0),
    ]
    text = io.StringIO()
    csv.DictWriter(text, list(table[0])).writerows(table)


def test_drawing_is_sound_xml_with_a_mark_and_a_tip_for_every_variant():
    svg = ElementTree.fromstring(scene()["plots"][0]["svg"])
    space = "{http://www.w3.org/2000/svg}"
    tips = [title.text for title in svg.iter(f"{space}title")]
    assert [tip.split(":")[0] for tip in tips] == ["plain <a>", "quick", "bad"]
    numbers = [float(text) for text in re.findall(r'(?:x1|x2|cx)="([-\d.]+)"', scene()["plots"][0]["svg"])]
    assert all(0 <= value <= 640 for value in numbers)


def test_a_variant_apart_is_shown_and_neither_beats_nor_is_advised():
    rows = [
        row("plain", 4.0, {"normals": [record("normals", 10.0)]}, default=True),
        row("twice the bytes", 1.0, {"normals": [record("normals", 5.0)]}, apart=True),
        row("quick", 5.0, {"normals": [record("normals", 2.0)]}),
    ]
    made = scene_content("cat", rows, [ERROR], axis="seconds", counted=["normals"], evaluation="evaluate")
    assert [one["ahead"] for one in made["rows"]] == [(True,), (False,), (True,)]
    assert not any("twice the bytes" in line for line in made["advice"][0])
    assert "twice the bytes" in made["plots"][0]["svg"]


@pytest.mark.parametrize("values", [[1.0], [0.0, 0.0], [1.0, 1000.0], [-3.0, 5.0], [1e-9, 2e-9], [0.0, 1e6]])
def test_axes_hold_all_values_and_have_ticks(values):
    axis = axis_over(values, 0.0, 100.0)
    assert all(0 <= axis(value) <= 100 for value in values)
    assert axis.marks()
    flipped = axis_over(values, 0.0, 100.0, flipped=True)
    assert flipped(max(values)) == pytest.approx(100 - axis(max(values)))


def test_more_is_better_puts_the_best_below():
    points = [VariantPoint("a", 1, 1, 1, -20.0, 20.0), VariantPoint("b", 2, 2, 2, -40.0, 40.0)]
    svg = plot(points, [0, 1], x_label="x", y_label="y", higher=True, title="t")
    first, second = (float(text) for text in re.findall(r'<circle cx="[\d.]+" cy="([\d.]+)" r="4.5"', svg)[:2])
    assert second > first
