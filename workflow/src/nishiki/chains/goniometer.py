"""Stages of a cloth on a gonioreflectometer."""

from nishiki.artifacts.closed import Closed
from nishiki.engine.stage_types import Cost, SceneFacts, Stage
from nishiki.settings.fabric import FabricSettings
from nishiki.settings.fabric_evaluate import FabricEvaluateSettings
from nishiki.settings.fabric_render import FabricRenderSettings
from nishiki.settings.fabric_report import FabricReportSettings
from nishiki.settings.reflectance import ReflectanceSettings
from nishiki.settings.weave import WeaveSettings


def _seen_from_one_light_only(facts: SceneFacts, settings: Closed) -> str | None:
    if facts.measurements > facts.frontal or facts.truth_sha256:
        return None
    return "the light stood at the normal of the cloth in every measurement: none is left to compare with"


def _no_normal_incidence(facts: SceneFacts, settings: Closed) -> str | None:
    return None if facts.frontal else "no measurement has its light at the normal of the cloth"


GONIOMETER = (
    Stage(
        ReflectanceSettings,
        "photographs by direction to reflectance, over the whole hemisphere",
        geometry="goniometer",
        requires=("ingest",),
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr", "opencv-contrib-python-headless"),
        cost=lambda facts: Cost(mib=220, bytes_per_sample=2, seconds=1.8, us_per_sample=0.28),
    ),
    Stage(
        WeaveSettings,
        "cross-sections of warp and weft, from how they hide each other",
        geometry="goniometer",
        requires=("reflectance",),
        lacks=_no_normal_incidence,
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "opencv-contrib-python-headless"),
        cost=lambda facts: Cost(mib=480, seconds=30),
    ),
    Stage(
        FabricSettings,
        "reflectance for every direction of light and view",
        geometry="goniometer",
        requires=("reflectance",),
        wants=lambda settings: ("weave",) * ("weave" in (settings.model, *settings.compare)),
        needs_colour=True,
        libraries=("numpy", "scipy", "numba"),
        cost=lambda facts: Cost(mib=400, seconds=12, us_per_sample=1.2),
    ),
    Stage(
        FabricRenderSettings,
        "the cloth on a draped mesh, in any dye",
        geometry="goniometer",
        product="render",
        requires=("fabric",),
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "trimesh", "OpenEXR", "opencv-contrib-python-headless", "av"),
        cost=lambda facts: Cost(mib=900, seconds=95),
    ),
    Stage(
        FabricEvaluateSettings,
        "errors of the predicted against the measured reflectance",
        geometry="goniometer",
        product="evaluate",
        requires=("reflectance", "fabric"),
        lacks=_seen_from_one_light_only,
        needs_colour=True,
        libraries=("numpy", "scipy", "numba"),
        cost=lambda facts: Cost(mib=230, seconds=2, us_per_sample=0.05),
    ),
    Stage(
        FabricReportSettings,
        "one page that tells everything",
        geometry="goniometer",
        product="report",
        requires=("ingest", "reflectance"),
        wants=lambda settings: ("weave",),
        uses=("fabric", "fabric_render", "fabric_evaluate"),
        libraries=("numpy", "scipy", "jinja2", "numba", "opencv-contrib-python-headless"),
        cost=lambda facts: Cost(mib=260, seconds=5.5),
    ),
)
