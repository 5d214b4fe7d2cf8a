"""The page of all scenes: what it says of each, in which order, and what the command does where nothing is there."""

import json
import re
from html import unescape
from types import SimpleNamespace

import pytest
from refusals import refused

from nishiki.commands.results import page_of, write_index
from nishiki.errors import UserError
from nishiki.report.page import Metric, SceneCard, campaign_page


def scenes_of(html):
    """What the page's script is given."""
    (text,) = re.findall(r'<script type="application/json" id="scenes">(.*?)</script>', html, re.DOTALL)
    return json.loads(text)


def test_scenes_that_need_attention_come_first_and_every_one_is_counted():
    cards = [SceneCard("a", "finished"), SceneCard("b", "failed", "normals: no lights"), SceneCard("c", "unfinished"),
             SceneCard("d", "finished")]  # fmt: skip
    html = campaign_page("Scenes", cards, "1")
    assert [scene["scene"] for scene in scenes_of(html)] == ["b", "c", "a", "d"]
    assert scenes_of(html)[0]["detail"] == "normals: no lights"
    assert re.findall(r"[a-z]+ \((\d)\)", html) == ["2", "1", "1"]


def test_titles_of_strangers_are_text():
    html = campaign_page("Scenes", [SceneCard("a", "finished", title="</script><script>alert(1)</script>")], "1")
    assert "<script>alert" not in html
    assert scenes_of(html)[0]["title"].startswith("</script>")


def test_figures_can_be_sorted_by():
    tile = Metric(2.5, "°", 'angle, to the "truth"')
    cards = [SceneCard("a", "finished", figures=[tile]), SceneCard("b", "finished")]
    html = campaign_page("Scenes", cards, "1")
    (shown,) = scenes_of(html)[0]["figures"]
    assert (shown["text"], shown["short"]) == ("2.50 °", "angle")
    options = [json.loads(unescape(value)) for value in re.findall(r'<option value="([^"]+)"', html)]
    assert options == [[tile.meaning, 1], [tile.meaning, -1]]


def workflow(results, stages, refused=()):
    """What the page asks of a workflow."""
    planned = {name: SimpleNamespace(key=key) for name, key in stages.items()}
    scenes = ["one", "two", *refused]
    return SimpleNamespace(
        results=str(results),
        plans={name: SimpleNamespace(stages=planned) for name in ("one", "two")},
        refused={name: f"{name}: no such capture" for name in refused},
        project=SimpleNamespace(scenes=scenes),
        artifact=lambda scene, stage: f"{results}/{scene}/{stage}/{stages[stage]}/artifact.json",
    )


@pytest.fixture
def results(tmp_path, monkeypatch):
    """Scene `one` is published, `two` is not; tests/unit/test_finished.py shows when a scene is finished."""
    monkeypatch.setattr("nishiki.engine.finished.reason_to_run", lambda flow, scene: "")
    (tmp_path / "results/one/report/k1").mkdir(parents=True)
    (tmp_path / "results/one/report/k1/artifact.json").write_text("{}")
    current = tmp_path / "results" / "one" / "current"
    (current / "report").mkdir(parents=True)
    (current / "report.html").write_text("report")
    (current / "thumbnail.jpg").write_bytes(b"picture")
    (current / "index.json").write_text(json.dumps({"artifacts": {"report": {"key": "k1"}}}))
    told = {"title": "Mount Fuji", "about": "digitised", "figures": [{"value": 1.5, "unit": "°", "meaning": "angle"}]}
    (current / "report" / "artifact.json").write_text(json.dumps({"diagnostics": told}))
    return tmp_path / "results"


def test_page_is_made_of_what_is_published(results):
    page = write_index(workflow(results, {"report": "k1"}, ["three"]), {"two": "normals: too few lights"})
    failed, refused, finished = scenes_of(page.read_text())
    assert (failed["state"], failed["detail"]) == ("failed", "normals: too few lights")
    assert refused["state"] == "refused"
    assert (finished["state"], finished["title"]) == ("finished", "Mount Fuji")
    assert all((results / finished[name]).is_file() for name in ("page", "thumbnail"))
    assert sorted(path.name for path in results.iterdir()) == ["index.html", "one"]


def test_scene_with_other_settings_than_published_is_not_finished(results):
    scenes = scenes_of(write_index(workflow(results, {"report": "k2"})).read_text())
    assert {(scene["state"], scene["detail"].split()[-1]) for scene in scenes} == {("unfinished", "report")}


def test_a_stage_that_is_made_and_not_published_yet_is_not_the_next(results):
    for scene in ("one", "two"):
        made = results / scene / "report" / "k2"
        made.mkdir(parents=True)
        (made / "artifact.json").write_text("{}")
    scenes = scenes_of(write_index(workflow(results, {"report": "k2", "viewer": "k3"})).read_text())
    assert {scene["detail"].split()[-1] for scene in scenes} == {"viewer"}


def test_scenes_of_an_earlier_table_stay_on_the_page(results):
    (results / "one").rename(results / "before")
    *_, kept = scenes_of(write_index(workflow(results, {"report": "k1"})).read_text())
    assert (kept["scene"], kept["state"], kept["title"]) == ("before", "finished", "Mount Fuji")
    assert kept["detail"]


def test_what_is_opened_of_a_scene(results):
    flow = workflow(results, {"report": "k1"})
    assert page_of(flow, "one").name == "report.html"
    (results / "one" / "current" / "viewer").mkdir()
    (results / "one" / "current" / "viewer" / "index.html").write_text("viewer")
    assert page_of(flow, "one").parent.name == "viewer"
    with refused(UserError, "two"):
        page_of(flow, "two")
    with refused(UserError, "four"):
        page_of(flow, "four")
