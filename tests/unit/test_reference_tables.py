"""The documentation's tables of settings, limits and stages say what the declarations say."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest
from refusals import expect_facts

import nishiki
from nishiki.artifacts.declaration import Output, convert_to_declared
from nishiki.artifacts.maps import Maps, MapWriter
from nishiki.stages.table import CHAIN

DOCS = Path(__file__).resolve().parents[2] / "docs"


def load_hook():
    spec = importlib.util.spec_from_file_location("reference_tables", DOCS / "hooks/reference_tables.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


HOOK = load_hook()


def cells(markdown: str) -> dict[str, list[str]]:
    """Rows of all tables by their first cell, without its code marks."""
    rows = [re.split(r" (?<!\\)\| ", line.strip("| ")) for line in markdown.splitlines() if line.startswith("| ")]
    return {row[0].strip("`"): row[1:] for row in rows}


def page(name: str) -> str:
    return HOOK.on_page_markdown((DOCS / "stages" / f"{name}.md").read_text(encoding="utf-8"), None, None, None)


@pytest.mark.parametrize(("name", "stage"), CHAIN.items(), ids=CHAIN)
def test_the_page_of_a_stage_has_every_setting_and_limit(name, stage):
    rows = cells(page(name))
    assert set(stage.settings.model_fields) <= set(rows)
    assert {limit.name for limit in stage.limits if limit.stated} <= set(rows)
    assert {output.name for output in stage.outputs} <= set(rows)
    assert not HOOK.LINE.search(page(name))


def test_arrays_of_maps_are_written_as_they_are_declared(tmp_path):
    outputs = (Output("angle", "float32", "degrees", "of the normal"), Output("classes_NNN", "uint8", "", "of a lamp"))
    out = MapWriter(tmp_path, outputs, rows=4, columns=3, band_rows=2, stamp={})
    out.write("angle", np.zeros((4, 3)), nan="unknown")
    out.write("classes_007", np.ones((4, 3), int), light="L7")
    maps = Maps(tmp_path)
    assert maps.attributes("angle") == {"unit": "degrees", "meaning": "of the normal", "nan": "unknown"}
    assert [str(maps.read(name).dtype) for name in ("angle", "classes_007")] == ["float32", "uint8"]
    with pytest.raises(KeyError):
        out.create("undeclared")
    named = (Output("v/COMPONENT", "float32", "", "", "pair 3"), Output("used", "uint8", "", "", "pair"))
    got = convert_to_declared(named, {"v/total": np.zeros((4, 3)), "used": np.ones(4, bool)})
    assert [str(values.dtype) for values in got.values()] == ["float32", "uint8"]
    for shape, used in (((4, 2), 4), ((4,), 4), ((4, 3), 5)):
        with pytest.raises(ValueError, match="axes"):
            convert_to_declared(named, {"v/total": np.zeros(shape), "used": np.ones(used)})
    with pytest.raises(KeyError):
        convert_to_declared(named, {"unnamed": np.zeros(4)})
    programs = (Path(nishiki.__file__).parent / "stages").rglob("*.py")
    assert not [path for path in programs if "MapWriter(" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("name", CHAIN)
def test_no_page_lists_settings_by_hand(name):
    text = (DOCS / "stages" / f"{name}.md").read_text(encoding="utf-8")
    assert [line[1] for line in HOOK.LINE.finditer(text)] == [name]
    assert not re.search(r"^\| *setting *\|", text, re.MULTILINE)


def test_a_row_says_choices_bounds_default_and_meaning():
    rows = cells(page("normals"))
    assert rows["solver"][0] == "`lobe`, `least_squares`"
    expect_facts(rows["lights"][0], "all", "auto", 4, "4,096")
    expect_facts(rows["refractive_index"][0], 1, 3)
    assert (rows["lights"][1], rows["refractive_index"][1]) == ("`auto`", "`1.45`")
    assert "[economy](../notes/economy.md)" in rows["lights"][2]
    assert rows["needs"] == ["[ingest](ingest.md)"]


def test_settings_inside_blocks_and_lists_have_dotted_names():
    bounds, default = cells(page("cloth_render"))["view.distance"][:2]
    assert default == "`2.2`"
    expect_facts(bounds, "0.8", 100)
    assert cells(page("cloth_render"))["film.frames"][1] == "`96`"
    assert cells(page("render"))["pictures[].lights[].illuminant"][1] == "`D65`"


def test_the_list_of_stages_has_all_of_them():
    text = HOOK.on_page_markdown((DOCS / "stages/README.md").read_text(encoding="utf-8"), None, None, None)
    assert set(CHAIN) <= set(re.findall(r"\]\((\w+)\.md\)", text))


def test_settings_beside_the_stages_are_listed_apart():
    rows = cells(HOOK.on_page_markdown((DOCS / "settings.md").read_text(encoding="utf-8"), None, None, None))
    assert {"hold_out", "scatter", "products", "results"} <= set(rows)
    assert not set(CHAIN) & set(rows)
