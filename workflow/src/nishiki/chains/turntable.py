"""Stages of an object on a turntable."""

from nishiki.artifacts.closed import Closed
from nishiki.chains.common import no_method
from nishiki.engine.stage_types import Cost, SceneFacts, Stage
from nishiki.settings.cameras import CamerasSettings
from nishiki.settings.mesh import MeshSettings
from nishiki.settings.object_evaluate import ObjectEvaluateSettings
from nishiki.settings.object_render import ObjectRenderSettings
from nishiki.settings.object_report import ObjectReportSettings
from nishiki.settings.polarise import PolariseSettings
from nishiki.settings.reflection import ReflectionSettings
from nishiki.settings.residual import ResidualSettings
from nishiki.settings.texels import TexelsSettings


def _no_polarisers(facts: SceneFacts, settings: Closed) -> str | None:
    if len(facts.states) < 2:
        return "the photographs show one polariser state only"
    return no_method(facts, settings)


def _no_poses(facts: SceneFacts, settings: Closed) -> str | None:
    return None if facts.has_poses else "the capture has no camera matrices, no board pictures and no correspondences"


TURNTABLE = (
    Stage(
        PolariseSettings,
        "diffuse and specular parts, by the state of the polarisers",
        geometry="turntable",
        product="separate",
        requires=("ingest",),
        lacks=_no_polarisers,
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr", "opencv-contrib-python-headless"),
        cost=lambda facts: Cost(mib=240, bytes_per_pixel=400, seconds=2.5, us_per_pixel=16, us_per_sample=1.4),
    ),
    Stage(
        CamerasSettings,
        "where each view was taken from",
        geometry="turntable",
        requires=("ingest",),
        lacks=_no_poses,
        libraries=("numpy", "scipy", "zarr", "opencv-contrib-python-headless"),
        cost=lambda facts: Cost(mib=200, seconds=1.5),
    ),
    Stage(
        MeshSettings,
        "the surface, from a file, range scans or silhouettes",
        geometry="turntable",
        requires=("ingest", "cameras"),
        needs_colour=True,
        libraries=(
            "numpy",
            "scipy",
            "numba",
            "zarr",
            "opencv-contrib-python-headless",
            "scikit-image",
            "trimesh",
            "pymeshlab",
        ),
        cost=lambda facts: Cost(mib=600, bytes_per_sample=1, seconds=14, us_per_sample=3.4),
    ),
    Stage(
        TexelsSettings,
        "what every view shows of every patch of the surface",
        geometry="turntable",
        requires=("ingest", "cameras", "mesh"),
        wants=lambda settings: ("polarise",),
        needs_colour=True,
        libraries=("numpy", "numba", "zarr", "opencv-contrib-python-headless"),
        cost=lambda facts: Cost(mib=320, bytes_per_sample=16, seconds=4.5, us_per_sample=5),
    ),
    Stage(
        ReflectionSettings,
        "Lambert and Torrance-Sparrow parameters of every texel",
        geometry="turntable",
        requires=("ingest", "texels"),
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr"),
        cost=lambda facts: Cost(mib=330, bytes_per_sample=40, seconds=3.5, us_per_sample=6.8),
    ),
    Stage(
        ResidualSettings,
        "captured minus model, as coded wavelet coefficients",
        geometry="turntable",
        requires=("texels", "reflection"),
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr", "pywavelets"),
        cost=lambda facts: Cost(mib=340, bytes_per_sample=22, seconds=14, us_per_sample=36),
    ),
    Stage(
        ObjectRenderSettings,
        "captured and in-between views, and a turn as video",
        geometry="turntable",
        product="render",
        requires=("ingest", "mesh", "cameras", "texels", "reflection", "residual"),
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr", "pywavelets", "OpenEXR", "opencv-contrib-python-headless", "av"),
        cost=lambda facts: Cost(mib=450, bytes_per_sample=115, seconds=4, us_per_sample=9.5),
    ),
    Stage(
        ObjectEvaluateSettings,
        "errors of rendered views against photographs, truth and views left out",
        geometry="turntable",
        product="evaluate",
        requires=("ingest", "mesh", "cameras", "texels", "reflection", "residual"),
        wants=lambda settings: ("polarise",),
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr", "pywavelets", "opencv-contrib-python-headless"),
        cost=lambda facts: Cost(mib=380, bytes_per_sample=90, seconds=5, us_per_sample=3),
    ),
    Stage(
        ObjectReportSettings,
        "one page that tells everything",
        geometry="turntable",
        product="report",
        requires=("ingest",),
        wants=lambda settings: ("polarise",),
        uses=("cameras", "mesh", "texels", "reflection", "residual", "object_render", "object_evaluate"),
        libraries=("numpy", "jinja2", "zarr", "opencv-contrib-python-headless"),
        cost=lambda facts: Cost(mib=230, bytes_per_sample=1, seconds=1.8, us_per_sample=0.2),
    ),
)
