"""Sweeps: plans of all variants, stages whose time counts, bad files."""

import pytest
import yaml
from refusals import refused

from nishiki.engine.plan import configuration_of, make_plan, plan_sweep
from nishiki.engine.project import load_project
from nishiki.errors import UserError
from nishiki.stages.base import SceneFacts
from nishiki.sweep.variants import AS_CONFIGURED

PLANE = SceneFacts(
    capture_digest="0" * 64,
    lights=tuple(f"light{number}" for number in range(30)),
    check_lights=(),
    channels=3,
    pixels=1000,
    has_sensitivities=True,
    has_illuminant=True,
    truth_sha256="",
)


@pytest.fixture
def project(tmp_path, monkeypatch):
    """Two scenes, one of them with settings of its own."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes.tsv").write_text("scene\tcapture\tsettings\na\tcaptures/a\t\nb\tcaptures/b\tb.yaml\n")
    (tmp_path / "b.yaml").write_text("separate: {method: threshold, w1: 1.4}\n")
    return load_project({"scenes": "scenes.tsv", "sweeps": {"block": {"stage": "height", "vary": {"method": ["dct"]}}}})


def write(**block):
    with open("x.yaml", "w") as file:
        yaml.safe_dump(block, file)
    return "x.yaml"


def planned(project, facts=PLANE, **block):
    return plan_sweep(write(**block), project, lambda scene: facts)


def test_variants_share_what_does_not_depend_on_them(project):
    swept = planned(project, scenes=["a"], stage="spectra", vary={"method": ["wiener", "paper"]}).scenes[0]
    plans = [variant.plan for variant in swept.variants]
    assert [variant.name for variant in swept.variants] == [AS_CONFIGURED, "method=wiener", "method=paper"]
    for stage in ("ingest", "separate", "normals", "height", "brdf"):
        assert len({plan.stages[stage].key for plan in plans}) == 1
    assert len({plan.stages["spectra"].key for plan in plans}) == 3
    assert swept.evaluation == "evaluate"
    assert swept.counted == ("spectra",)
    assert swept.variants[1].changes == ("spectra.method: 'local' -> 'wiener'",)


def test_counted_are_the_stages_that_differ_on_the_way_to_the_evaluation(project):
    swept = planned(project, scenes=["a"], stage="separate", variants={"none": {"method": "none"}}).scenes[0]
    assert swept.counted == ("separate", "normals", "height", "spectra", "brdf")
    named = planned(project, scenes=["a"], stage="separate", variants={"n": {"w1": 2}}, counted=["normals", "separate"])
    assert named.scenes[0].counted == ("separate", "normals")


def test_a_scene_keeps_its_own_settings_and_they_are_the_default(project):
    swept = planned(project, stage="separate", vary={"w1": [1.2, 1.4]}).scenes
    own = {scene.scene: {v.name: v.plan.stages["separate"].settings["w1"] for v in scene.variants} for scene in swept}
    assert own == {"a": {"w1=1.2": 1.2, "w1=1.4": 1.4}, "b": {"w1=1.2": 1.2, "w1=1.4": 1.4}}
    for scene in swept:
        names = {name for variant in scene.variants for name in variant.names}
        assert AS_CONFIGURED in names
    assert AS_CONFIGURED in swept[1].variants[0].names
    assert swept[1].variants[0].name == "w1=1.4"


def test_settings_of_all_variants_and_shared_ones(project):
    settings = {"hold_out": ["light3"], "brdf.refractive_index": 1.4, "solver": "least_squares"}
    settings["height"] = {"method": "weighted"}
    swept = planned(project, scenes=["a"], stage="normals", vary={"refine": ["none"]}, settings=settings).scenes[0]
    for variant in swept.variants:
        stages = variant.plan.stages
        assert stages["brdf"].settings["refractive_index"] == 1.4
        assert stages["height"].settings["method"] == "weighted"
        assert stages["normals"].settings["hold_out"] == ("light3",) or stages["normals"].settings["hold_out"] == [
            "light3"
        ]
        assert stages["normals"].settings["solver"] == "least_squares"


def test_lights_are_left_out_where_nothing_else_checks(project):
    swept = planned(project, scenes=["a"], stage="normals", vary={"solver": ["least_squares"]}).scenes[0]
    assert {variant.plan.held_out for variant in swept.variants} == {("light5", "light15", "light25")}


def test_the_default_variant_is_the_scene_s_own_plan(project):
    swept = planned(project, scenes=["a"], stage="normals", vary={"solver": ["lobe", "least_squares"]}).scenes[0]
    own = make_plan(project.scenes["a"], PLANE)
    assert swept.variants[0].plan.stages["normals"].key == own.stages["normals"].key
    assert swept.variants[0].names == (AS_CONFIGURED, "solver=lobe")


def test_a_block_of_the_configuration_is_found_by_its_name(project):
    made = plan_sweep("block", project, lambda scene: PLANE)
    assert made.name == "block"
    assert made.scenes[0].counted == ("height",)


def test_the_file_may_name_its_configuration(project):
    assert configuration_of(write(stage="normals", configuration="config/x.yaml")) == "config/x.yaml"
    assert planned(project, stage="height", vary={"method": ["dct"]}, configuration="c.yaml").name == "x"


@pytest.mark.parametrize(
    ("block", "message"),
    [
        ({"stage": "normal", "vary": {"solver": ["lobe"]}}, "'normal'"),
        ({"stage": "reflection", "vary": {"width": ["texel"]}}, "'reflection'"),
        ({"vary": {"solver": ["lobe"]}}, "'stage'"),
        ({"stage": "normals", "vary": {"solvr": ["lobe"]}}, "'solver'"),
        ({"stage": "normals", "vary": {"solver": ["magic"]}}, "normals.solver"),
        ({"stage": "normals", "variants": {"v": {"separate.w1": -1}}}, "variant 'v': separate.w1"),
        ({"stage": "normals", "vary": {"solver": ["lobe"]}, "scenes": ["c"]}, "'c'"),
        ({"stage": "render", "vary": {"supersampling": [1, 3]}}, "render"),
        ({"stage": "residual", "vary": {"rounds": [1, 3]}}, "residual"),
        ({"stage": "normals", "vary": {"solver": ["lobe"]}, "counted": ["residual"]}, "'residual'"),
        ({"stage": "normals", "vary": {"solver": ["lobe"]}, "settings": {"hold_out": "none"}}, "hold_out"),
        ({"stage": "normals", "vary": {"solver": ["lobe"]}, "settings": {"render": 3}}, "x.yaml: settings"),
        ({"stage": "normals", "vary": {"solver": ["lobe"]}, "configuration": 3}, "x.yaml"),
    ],
)
def test_bad_files_are_told_with_file_and_key(project, block, message):
    def read():
        if configuration_of(write(**block)) is None:
            plan_sweep("x.yaml", project, lambda scene: PLANE)

    with pytest.raises(UserError) as told:
        read()
    assert "x.yaml" in str(told.value)
    assert message in str(told.value)


def test_a_name_that_is_no_sweep_is_told_with_those_that_are(project):
    with refused(UserError, "blok"):
        plan_sweep("blok", project, lambda scene: PLANE)
    with refused(UserError, "none.yaml"):
        plan_sweep("none.yaml", project, lambda scene: PLANE)


def test_a_scene_cannot_be_called_like_the_folder_of_the_sweeps(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes.tsv").write_text("scene\tcapture\nsweeps\tcaptures/a\n")
    with refused(UserError, "sweeps"):
        load_project({"scenes": "scenes.tsv"})
