"""What a plan leaves out of a scene, and why: parts of the capture, colour, packages; and how the command says it."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from refusals import expect_facts, refused

from nishiki.commands import inspecting
from nishiki.engine.plan import PARTS, Plan, make_plan
from nishiki.engine.project import Scene, StageSettings
from nishiki.errors import UserError
from nishiki.installation import EXTRAS
from nishiki.report.page import Facts
from nishiki.report.scene_page import left_out_blocks
from nishiki.stages.base import SceneFacts
from nishiki.stages.table import CHAIN

PLANE = SceneFacts(
    capture_digest="0" * 64,
    lights=tuple(f"l{number}" for number in range(9)),
    check_lights=("c1", "c2"),
    channels=3,
    pixels=1000,
    has_sensitivities=True,
    has_illuminant=True,
    truth_sha256="",
    parts={"check": 2, "flat": 0},
    suffixes=(".png",),
)
OBJECT = replace(
    PLANE,
    lights=("",),
    check_lights=(),
    geometry="turntable",
    views=tuple(f"v{number}" for number in range(12)),
    states=("off", "on"),
    has_poses=True,
    given=("matrices", "silhouettes"),
    parts={
        "states": 12,
        "white_states": 4,
        "photographs": 12,
        "calibration": 3,
        "silhouettes": 12,
        "mesh": 1,
        "scans": 2,
    },
)
CLOTH = replace(
    PLANE, lights=(), check_lights=(), geometry="goniometer", measurements=100, frontal=40, parts={"oblique": 60}
)


def planned(facts: SceneFacts, *products: str, **settings) -> Plan:
    scene = Scene("s", Path("captures/s"), None, products, StageSettings.model_validate(settings))
    return make_plan(scene, facts)


def without(plan: Plan) -> tuple[str, ...]:
    return tuple(plan.stages["ingest"].settings["without"])


@pytest.mark.parametrize(
    ("facts", "products", "settings", "expected"),
    [
        (PLANE, ["render", "evaluate", "report"], {}, ()),
        (PLANE, ["render", "report"], {}, ("check",)),
        (replace(PLANE, parts={"check": 2, "flat": 3}), ["evaluate"], {}, ("flat",)),
        (PLANE, ["normals"], {"hold_out": ["l3", "l5"]}, ("check", "light l3", "light l5")),
        (PLANE, ["evaluate"], {"hold_out": ["l3", "l5"]}, ()),
        (OBJECT, ["report", "evaluate", "render"], {}, ("calibration", "scans")),
        (OBJECT, ["separate"], {}, ("calibration", "silhouettes", "mesh", "scans")),
        (OBJECT, ["render"], {"polarise": {"method": "none"}}, ("states", "white_states", "calibration", "scans")),
        (OBJECT, ["cameras"], {}, tuple(name for name in PARTS if name in OBJECT.parts)),
        (OBJECT, ["render"], {"mesh": {"source": "scans"}}, ("calibration", "mesh")),
        (OBJECT, ["render"], {"mesh": {"source": "silhouettes"}}, ("calibration", "mesh", "scans")),
        (OBJECT, ["render"], {"cameras": {"source": "boards"}}, ("scans",)),
        (CLOTH, ["render", "evaluate", "report"], {}, ()),
        (CLOTH, ["weave", "report"], {}, ("oblique",)),
        (CLOTH, ["goniometer_samples"], {}, ()),
        # light within normal_deg counts as along the normal, and lies among what ingest takes for oblique
        (CLOTH, ["weave"], {"goniometer_samples": {"normal_deg": 5}}, ()),
        (CLOTH, ["cloth_brdf"], {"cloth_brdf": {"oblique": 0}}, ("oblique",)),
        (CLOTH, ["cloth_brdf"], {"cloth_brdf": {"oblique": 0, "compare": ["bard_linear"]}}, ("oblique",)),
        (CLOTH, ["render", "evaluate"], {"cloth_brdf": {"oblique": 0, "compare": []}}, ()),
    ],
)
def test_parts_that_no_stage_of_the_plan_looks_at(facts, products, settings, expected):
    found = planned(facts, *products, **settings)
    assert without(found) == expected
    reasons = [why for name, why in found.left_out.items() if name[0].isdigit()]
    assert len(reasons) == len(expected) - max(0, sum(name.startswith("light ") for name in expected) - 1)
    assert all(reasons)


def test_photographs_through_one_polariser_are_all_that_there_is():
    """Where no state is without polariser, other stages read the first of them with the rest."""
    facts = replace(OBJECT, states=("lin0:0", "lin0:90"))
    assert "states" not in without(planned(facts, "texels", polarise={"method": "none"}))


@pytest.mark.parametrize(
    "products", [("normals",), ("height",), ("normals", "spectra"), ("render", "evaluate", "report")]
)
def test_channels_of_normals_do_not_depend_on_the_products(products):
    assert planned(PLANE, *products).stages["ingest"].settings["channels"] == "all"


def test_one_channel_where_the_settings_say_so():
    plan = planned(PLANE, "normals", ingest={"channels": "luminance"})
    assert plan.stages["ingest"].settings["channels"] == "luminance"


def test_the_report_is_told_of_parts_and_packages():
    told = planned(PLANE, "normals", "report").stages["report"].settings["left_out"]
    assert sum(part.startswith("2 ") for part in told) == 1
    assert any("rawpy" in part for part in told)
    assert "render" in told["package av"]


@pytest.mark.parametrize(
    ("facts", "settings", "loaded"),
    [
        (PLANE, {}, {"av"}),
        (PLANE, {"render": {"sequences": []}}, set()),
        (replace(PLANE, suffixes=(".cr2",)), {"render": {"sequences": []}}, {"rawpy"}),
        (OBJECT, {}, {"av", "trimesh"}),
        (OBJECT, {"object_render": {"film": None}, "mesh": {"source": "silhouettes"}}, {"scikit-image"}),
        (OBJECT, {"mesh": {"source": "scans"}}, {"av", "trimesh", "pymeshlab"}),
        (CLOTH, {}, set()),
        (CLOTH, {"cloth_render": {"film": {"moves": "turn"}}}, {"av"}),
    ],
)
def test_optional_packages_of_a_scene(facts, settings, loaded):
    found = planned(facts, "render", "evaluate", "report", **settings)
    optional = set(EXTRAS)
    assert {package for names in found.packages.values() for package in names} & optional == loaded
    chain = {package for stage in CHAIN.values() if stage.serves(facts.geometry) for package in stage.libraries}
    assert set(found.unused_packages) == (chain & optional) - loaded


def test_exr_photographs_need_no_opencv_in_ingest():
    found = planned(replace(PLANE, suffixes=(".exr",)), "normals")
    assert "OpenEXR" in found.packages["ingest"]
    assert "opencv-contrib-python-headless" not in found.packages["ingest"]


@pytest.mark.parametrize(
    ("facts", "figures"),
    [
        (PLANE, ["1000", "9", "3"]),
        (replace(PLANE, pixels=2_500_000, channels=1), ["2.50", "9", "1"]),
        (replace(OBJECT, pixels=40_000), ["0.04", "12", "2", "3"]),
        (CLOTH, ["1000", "100", "40", "3"]),
        (replace(CLOTH, table=True), ["100", "40", "3"]),
    ],
)  # fmt: skip
def test_a_capture_in_one_line(facts, figures):
    assert re.findall(r"[\d.]+", inspecting.describe_capture(facts)) == figures


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0 s"), (59, "59 s"), (130, "2 min"), (9000, "2 h")])
def test_durations(seconds, text):
    assert inspecting.duration(seconds) == text


class _Flow:
    """A workflow of one plan of which nothing has been made."""

    def __init__(self, plan: Plan):
        self.plans = {"s": plan}


def test_a_missing_package_stops_the_run_with_the_command_that_installs_it(monkeypatch):
    flow = _Flow(planned(OBJECT, "render"))
    monkeypatch.setattr(inspecting, "stage_state", lambda flow, scene, stage: ("run", []))
    inspecting.expect_packages(flow)
    monkeypatch.setattr(inspecting, "is_installed", lambda package: package not in ("trimesh", "av"))
    with refused(UserError, "/nishiki", "--extras"):
        inspecting.expect_packages(flow)
    monkeypatch.setattr(inspecting, "stage_state", lambda flow, scene, stage: ("done", []))
    inspecting.expect_packages(flow)


def test_section_of_the_report():
    read = {
        "files": [{"what": "white boards", "read": 3, "of": 5, "bytes_read": 3_000_000, "bytes_of": 5_000_000}],
        "total": {"what": "files", "read": 3, "of": 5, "bytes_read": 3_000_000, "bytes_of": 5_000_000},
        "channels": [1, 3],
        "tiles": None,
    }
    entry = {
        "decision": "left out",
        "criterion": "gloss",
        "measured": 0.1,
        "limit": 0.2,
        "loss": "none",
        "override": "x: y",
    }
    files, kept, planned_out, decided = left_out_blocks(
        {"b": "2", "a": "1"}, {"ingest": {"read": read}, "brdf": {"economy": {"the_lobe": entry}}}
    )
    assert [row[3] for row in files.rows] == ["3.00", "3.00"]
    expect_facts(kept, "1 of 3")
    assert planned_out == Facts([("a", "1"), ("b", "2")])
    assert [(stage, *rest) for stage, _, *rest in decided.rows] == [("brdf", *entry.values())]
    assert len(left_out_blocks({}, {})) == 1


def test_versions_of_packages_that_a_scene_does_not_load_are_no_reason_to_run_again():
    stages = planned(PLANE, "render", render={"sequences": []}).stages
    assert "rawpy" in CHAIN["ingest"].libraries
    assert not {"rawpy", "av", "OpenEXR"} & set(stages["ingest"].packages)
    assert "av" not in stages["render"].packages


@pytest.mark.parametrize(("facts", "stage"), [(PLANE, "export"), (OBJECT, "object_export")])
@pytest.mark.parametrize(
    ("formats", "loaded"), [(["gltf"], set()), (["gltf", "usd"], {"usd-core"}), (["materialx"], {"materialx"})]
)
def test_a_package_of_a_format_is_loaded_where_it_is_asked_for(facts, stage, formats, loaded):
    found = planned(facts, "export", **{stage: {"formats": formats}})
    assert set(found.packages[stage]) & {"usd-core", "materialx"} == loaded
    told = {package: why for package, why in found.unused_packages.items() if package in ("usd-core", "materialx")}
    assert set(told) == {"usd-core", "materialx"} - loaded


@pytest.mark.parametrize(("kinds", "read"), [(["ptm"], False), (["ptm", "bilinear"], True)])
def test_gloss_is_fitted_for_relightable_images_that_read_it(kinds, read):
    found = planned(PLANE, "export", export={"formats": ["relight"], "relight": {"kinds": kinds}})
    assert ("brdf" in found.packages) is read
