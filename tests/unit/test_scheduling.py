"""Groups and parts of jobs: no way leaves a group and comes back; costs follow the table."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from captures import make_capture
from hypothesis import given
from hypothesis import strategies as st

from nishiki.capture.folder import load_capture
from nishiki.capture.seal import seal
from nishiki.engine.plan import PlannedStage
from nishiki.engine.project import StageSettings, scene_facts
from nishiki.engine.workflow import SHORT_SECONDS, Scheduling
from nishiki.observations.plane import Observations
from nishiki.observations.plane_store import write_observations
from nishiki.stages.base import SceneFacts
from nishiki.stages.ingest import IngestSettings
from nishiki.stages.table import CHAIN, chain_of

PLANE = tuple(chain_of("plane"))


class Fixed(Scheduling):
    """One scene of a plane chain in which these stages take these seconds."""

    results = "results"

    def __init__(self, seconds: dict[str, float], scatter="none"):
        upstream = {name: CHAIN[name].requires + CHAIN[name].uses for name in PLANE}
        stages = {
            name: PlannedStage(name, name, {}, {above: above for above in upstream[name] if above in PLANE})
            for name in PLANE
        }
        scene = SimpleNamespace(settings=SimpleNamespace(scatter=scatter))
        self.plans = {"x": SimpleNamespace(stages=stages, scene=scene)}
        self.given = seconds

    def stage(self, scene, stage, key):
        return self.plans[scene].stages[stage]

    def seconds(self, scene, stage, share=1.0):
        return self.given.get(stage, 1.0) * share


def ways(flow, stage):
    """Every way from a stage up to the capture, as stages."""
    above = flow.stage("x", stage, stage).upstream
    yield from ([stage, *rest] for name in above for rest in ways(flow, name)) if above else [[stage]]


@given(st.sets(st.sampled_from(PLANE)), st.sampled_from(["none", {"normals": 3}, {"normals": 2, "separate": 9}]))
def test_no_way_leaves_a_group_and_comes_back(long, scatter):
    flow = Fixed(dict.fromkeys(long, 10 * SHORT_SECONDS), scatter)
    for stage in PLANE:
        for way in ways(flow, stage):
            groups = []
            for name in way:  # a divided stage is two jobs on the way: the one that joins, then its parts
                groups.append(flow.group("x", name, name))
                if flow.parts("x", name) > 1:
                    groups.append(flow.group("x", name, name, part=True))
            for group in set(groups) - {None}:
                places = [n for n, other in enumerate(groups) if other == group]
                assert places == list(range(places[0], places[-1] + 1))


def test_short_stages_share_a_job_and_long_ones_have_their_own():
    flow = Fixed({"normals": SHORT_SECONDS + 1})
    assert flow.group("x", "normals", "normals") is None
    assert flow.group("x", "ingest", "ingest") == flow.group("x", "separate", "separate") == "level0"
    assert flow.group("x", "spectra", "spectra") == flow.group("x", "report", "report") == "level1"


def test_parts_of_a_divided_stage():
    flow = Fixed({"normals": 10 * SHORT_SECONDS}, {"normals": 2})
    assert flow.part_paths("x", "normals", "k") == [f"results/.parts/x/normals/k/{n}-of-2" for n in (1, 2)]
    assert flow.part_paths("x", "height", "k") == []
    assert flow.group("x", "normals", "normals", part=True) is None
    assert flow.group("x", "normals", "normals") == flow.group("x", "height", "height") == "level1"


def test_auto_divides_what_can_be_divided_and_takes_long():
    flow = Fixed({"normals": 3600.0, "separate": 60.0, "height": 1e5, "spectra": 1e9}, "auto")
    assert {name: flow.parts("x", name) for name in PLANE if flow.parts("x", name) > 1} == {"normals": 4, "spectra": 64}


@pytest.mark.parametrize("stage", CHAIN.values(), ids=CHAIN)
def test_a_further_attempt_gets_more(stage):
    lights = tuple(f"L{number}" for number in range(40))
    facts = SceneFacts("", lights, (), 3, 12_000_000, True, True, "", geometry=stage.geometry or "plane")
    flow = Scheduling()
    flow.plans = {"x": SimpleNamespace(facts=facts, scene=SimpleNamespace(settings=StageSettings()))}
    first, second = (flow.memory_mb("x", stage.name, attempt) for attempt in (1, 2))
    assert second == pytest.approx(1.5 * first, abs=2)
    assert flow.minutes("x", stage.name, 2) >= 2 * flow.minutes("x", stage.name, 1) - 2
    assert flow.minutes("x", stage.name) * 60 >= 4 * flow.seconds("x", stage.name)


def test_a_small_object_in_a_large_picture_is_planned_by_its_bounding_box(tmp_path):
    mask = np.zeros((200, 300), bool)
    mask[90:100, 120:150] = True
    folder = make_capture(tmp_path / "c", mask=mask, rows=200, columns=300)
    seal(folder)
    facts = scene_facts(SimpleNamespace(name="x", capture=folder, truth=None))
    write_observations(load_capture(folder), tmp_path, settings=IngestSettings())
    assert facts.kept_pixels == np.prod(Observations(tmp_path).shape) < facts.pixels == 60_000
    settings = SimpleNamespace(settings=StageSettings())
    small, large = Scheduling(), Scheduling()
    small.plans = {"x": SimpleNamespace(facts=facts, scene=settings)}
    large.plans = {"x": SimpleNamespace(facts=replace(facts, kept_pixels=0), scene=settings)}
    assert small.seconds("x", "ingest") == large.seconds("x", "ingest")
    for stage in ("separate", "normals", "height", "evaluate"):
        assert small.seconds("x", stage) < large.seconds("x", stage)
        assert small.memory_mb("x", stage) <= large.memory_mb("x", stage)


def test_what_a_stage_does_not_read_costs_nothing():
    """A fit to reflectances takes no longer for larger photographs; without polarisers there is one component."""
    plain = SceneFacts("", ("a",), (), 3, 1000, False, False, "", geometry="turntable", views=("a", "b"), states=("",))
    series, cloth = replace(plain, states=("off", "on")), replace(plain, geometry="goniometer", measurements=5000)

    def seconds(stage, facts, pixels=10**6):
        return CHAIN[stage].cost(facts).processor_seconds(pixels, pixels * 36)

    assert seconds("cloth_brdf", cloth, 1) == seconds("cloth_brdf", cloth)
    assert seconds("cloth_brdf", replace(cloth, measurements=50)) < seconds("cloth_brdf", cloth)
    for stage, share in (("texels", 0.6), ("object_brdf", 0.8)):
        assert seconds(stage, plain) < share * seconds(stage, series)
