"""Scenes of a mosaic's fields: expanded from one row, planned apart, and read by the stage that joins them."""

import json
import shutil

import pytest
from captures import make_capture

from nishiki.archive.audit import survey_artifact
from nishiki.archive.pack import FolderTree
from nishiki.artifacts.artifact import ArtifactWriter, open_artifact
from nishiki.artifacts.declaration import Guarded
from nishiki.artifacts.provenance import name_above, place_above
from nishiki.artifacts.stage import run_stage
from nishiki.capture.seal import seal
from nishiki.engine.project import load_project
from nishiki.engine.workflow import Workflow
from nishiki.errors import UserError
from nishiki.stages.table import CHAIN

VALUES = {"scenes": "scenes.tsv", "products": ["height"]}


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A scene table with a mosaic of two fields and an ordinary scene."""
    monkeypatch.chdir(tmp_path)
    for number, name in enumerate(("wall/fields/a1", "wall/fields/a2", "other")):
        make_capture(tmp_path / name, seed=number)
        seal(tmp_path / name)
    table("a1,fields/a1,,\na2,fields/a2,,\n")
    (tmp_path / "scenes.tsv").write_text("scene\tcapture\nwall\twall\nother\tother\n")
    return tmp_path


def table(rows):
    with open("wall/fields.csv", "w") as file:
        file.write(f"field,path,x_mm,y_mm\n{rows}")


def keys(flow=None):
    plans = (flow or Workflow(VALUES)).plans
    return {scene: {name: stage.key for name, stage in plan.stages.items()} for scene, plan in plans.items()}


def test_one_row_stands_for_the_scenes_of_the_fields_and_of_the_mosaic(project):
    assert list(load_project(VALUES).scenes) == ["wall--a1", "wall--a2", "wall", "other"]
    flow = Workflow(VALUES, only=["wall"])
    assert list(flow.plans) == ["wall--a1", "wall--a2", "wall"]
    assert list(flow.plans["wall"].stages) == ["mosaic", "height"]
    assert set(flow.plans["wall--a1"].stages) == {"ingest", "separate", "normals", "brdf"}
    assert Workflow(VALUES, only=["wall--a2"]).plans.keys() == {"wall--a2"}


def test_the_joining_stage_reads_what_it_stands_for_of_every_field_and_later_ones_read_it(project):
    flow = Workflow(VALUES)
    made = keys(flow)
    upstream = flow.plans["wall"].stages["mosaic"].upstream
    stages = CHAIN["mosaic"].stands_for
    assert upstream == {f"{field}/{stage}": made[f"wall--{field}"][stage] for field in ("a1", "a2") for stage in stages}
    assert flow.plans["wall"].stages["height"].upstream == {"mosaic": made["wall"]["mosaic"]}
    inputs = flow.inputs("wall", "mosaic", made["wall"]["mosaic"])
    assert f"results/wall--a2/normals/{made['wall--a2']['normals']}/artifact.json" in inputs


def test_fields_are_planned_like_captures_on_their_own(project):
    (project / "scenes.tsv").write_text("scene\tcapture\tproducts\nwall\twall\t\none\twall/fields/a1\tnormals brdf\n")
    made = keys(Workflow({**VALUES, "ingest": {"correct": {"gains": "never"}}}))
    assert made["one"] == made["wall--a1"]


@pytest.mark.parametrize(("given", "taken"), [({}, "never"), ({"ingest": {"correct": {"gains": "auto"}}}, "auto")])
def test_fields_do_not_estimate_lamps_each_by_itself_unless_they_are_told_to(project, given, taken):
    plans = Workflow({**VALUES, **given}).plans
    assert plans["wall--a1"].stages["ingest"].settings["correct"]["gains"] == taken
    assert plans["other"].stages["ingest"].settings["correct"]["gains"] == "auto"


def test_a_changed_field_changes_its_own_keys_and_those_of_the_mosaic(project):
    before = keys()
    shutil.rmtree("wall/fields/a2")
    make_capture(project / "wall/fields/a2", seed=9)
    seal(project / "wall/fields/a2")
    after = keys()
    assert {scene for scene in before if before[scene] != after[scene]} == {"wall--a2", "wall"}


def test_a_further_field_or_another_position_changes_the_keys_of_the_mosaic_alone(project):
    before = keys()
    table("a1,fields/a1,0,1\na2,fields/a2,,\n")
    moved = keys()
    assert {scene for scene in before if before[scene] != moved[scene]} == {"wall"}
    make_capture(project / "wall/fields/a3", seed=9)
    seal(project / "wall/fields/a3")
    table("a3,fields/a3,,\na1,fields/a1,0,1\na2,fields/a2,,\n")
    further = keys()
    assert {scene for scene in moved if moved[scene] != further[scene]} == {"wall"}
    assert further.keys() - moved.keys() == {"wall--a3"}


def test_positions_are_the_same_when_they_are_remembered(project):
    table("a1,fields/a1,0,1.5\na2,fields/a2,,\n")
    assert keys() == keys()
    settings = Workflow(VALUES).plans["wall"].stages["mosaic"].settings
    assert json.loads(json.dumps(settings["positions_mm"])) == {"a1": [0, 1.5], "a2": None}


def test_a_product_of_the_fields_stands_for_the_mosaic_and_one_that_needs_lamps_is_refused(project):
    flow = Workflow({**VALUES, "products": ["brdf"]})
    assert list(flow.plans["wall"].stages) == ["mosaic"]
    with pytest.raises(UserError, match="separate"):
        Workflow({**VALUES, "products": ["separate"]}, only=["wall"])


def test_a_wrong_table_or_field_refuses_its_mosaic_and_leaves_other_scenes(project):
    table("a1,fields/a1,,\na2,fields/a3,,\n")
    flow = Workflow(VALUES, leave_out_refused=True)
    assert (list(flow.refused), list(flow.plans)) == (["wall"], ["other"])
    table("a1,fields/a1,,\na2,fields/a2,,\n")
    shutil.rmtree("wall/fields/a2/data/frames")
    flow = Workflow(VALUES, leave_out_refused=True)
    assert (set(flow.refused), set(flow.plans)) == ({"wall--a2", "wall"}, {"wall--a1", "other"})


def test_a_row_that_has_the_name_of_a_field_is_refused(project):
    (project / "scenes.tsv").write_text("scene\tcapture\nwall\twall\nwall--a1\tother\n")
    with pytest.raises(UserError, match="wall--a1"):
        load_project(VALUES)


def test_variants_of_a_mosaic_are_refused_with_a_field_that_can_be_named(project):
    sweep = {"stage": "height", "vary": {"method": ["dct"]}, "scenes": ["wall"]}
    with pytest.raises(UserError, match="wall--a1"):
        Workflow({**VALUES, "sweeps": {"one": sweep}, "sweep": "one"})


def test_a_sweep_over_all_scenes_takes_the_fields_of_a_mosaic(project):
    sweep = {"stage": "height", "vary": {"flatten": [True]}, "settings": {"hold_out": ["L01"]}}
    flow = Workflow({**VALUES, "sweeps": {"one": sweep}, "sweep": "one"})
    assert [swept.scene for swept in flow.sweep.scenes] == ["wall--a1", "wall--a2", "other"]


@pytest.mark.parametrize(
    "settings",
    [
        {"hold_out": ["L01"]},
        {"normals": {"given": "wall/fields.csv"}},
        {"products": ["export"], "export": {"formats": ["normals", "relight"]}},
    ],
)
def test_settings_that_no_mosaic_can_follow_are_refused(project, settings):
    Workflow({**VALUES, **settings}, only=["other"])
    with pytest.raises(UserError, match="wall"):
        Workflow({**VALUES, **settings}, only=["wall"])


def test_fields_are_jobs_of_their_own_on_a_cluster(project):
    flow = Workflow(VALUES)
    made = keys(flow)
    levels = {scene: flow.group(scene, stage, key) for scene in made for stage, key in made[scene].items()}
    assert levels["wall--a1"] == levels["wall--a2"] != levels["wall"]


class JoinedSettings(Guarded, stage="joined", version=1, limits=()):
    """Settings of a stage that joins fields."""


class LaterSettings(Guarded, stage="later", version=1, limits=()):
    """Settings of a stage after it."""


def field_artifact(folder, scene, stage):
    key = f"{len(scene) * 7 + len(stage):012x}"
    with ArtifactWriter(folder / scene / stage / key) as output:
        described = {"scene": scene, "stage": stage, "key": key, "settings": {}, "diagnostics": {}, "format_version": 1}
        output.finish({**described, "upstream": {"capture": {"digest": "5" * 64}}}, {})
    return str(folder / scene / stage / key)


def test_a_stage_is_given_the_artifacts_of_fields_and_stands_for_those_that_all_have(tmp_path):
    names = [("w--a", "normals"), ("w--b", "normals"), ("w--a", "brdf")]
    inputs = [field_artifact(tmp_path, *name) for name in names]
    given = {}

    def join(context):
        given.update({name: sorted(made) for name, made in context.fields.items()})
        return {}

    words = ["--scene", "w", "--inputs", *inputs, "--output", str(tmp_path / "w/joined")]
    run_stage(JoinedSettings, join, "", arguments=words, stands_for=("normals", "brdf"))
    assert given == {"a": ["brdf", "normals"], "b": ["normals"]}
    (made,) = (tmp_path / "w/joined").iterdir()
    manifest = open_artifact(made).manifest
    assert (manifest["stands_for"], sorted(manifest["upstream"])) == (["normals"], ["a/brdf", "a/normals", "b/normals"])
    assert not survey_artifact(FolderTree(made)).damages

    def later(context):
        assert not context.fields
        given["later"] = {name: each.stage for name, each in context.inputs.items()}
        return {}

    run_stage(
        LaterSettings, later, "", arguments=["--scene", "w", "--inputs", str(made), "--output", str(tmp_path / "l")]
    )
    assert given["later"] == {"joined": "joined", "normals": "joined"}


def test_names_and_places_of_what_a_stage_reads_agree():
    for scene, stage in (("wall", "normals"), ("wall--a-1", "brdf")):
        name = name_above("wall", {"scene": scene, "stage": stage})
        assert place_above("wall", name) == (scene, stage)
