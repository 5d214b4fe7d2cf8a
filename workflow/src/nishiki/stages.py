"""The one table that declares the chain; plan, keys, rules, resources and documentation derive from it."""

from collections.abc import Callable

from nishiki.chain import SceneFacts as SceneFacts
from nishiki.chain import Stage
from nishiki.closed import Closed
from nishiki.settings.brdf import BrdfSettings
from nishiki.settings.cameras import CamerasSettings
from nishiki.settings.evaluate import EvaluateSettings
from nishiki.settings.height import HeightSettings
from nishiki.settings.ingest import IngestSettings
from nishiki.settings.mesh import MeshSettings
from nishiki.settings.normals import NormalsSettings
from nishiki.settings.object_evaluate import ObjectEvaluateSettings
from nishiki.settings.object_render import ObjectRenderSettings
from nishiki.settings.object_report import ObjectReportSettings
from nishiki.settings.polarise import PolariseSettings
from nishiki.settings.reflection import ReflectionSettings
from nishiki.settings.render import RenderSettings
from nishiki.settings.report import ReportSettings
from nishiki.settings.residual import ResidualSettings
from nishiki.settings.separate import SeparateSettings
from nishiki.settings.spectra import SpectraSettings
from nishiki.settings.texels import TexelsSettings


def _no_method(facts: SceneFacts, settings: Closed) -> str | None:
    return "its method is set to none" if settings.method == "none" else None


def _no_spectra(facts: SceneFacts, settings: Closed) -> str | None:
    missing = [
        name
        for name, there in (
            ("camera sensitivities", facts.has_sensitivities),
            ("illuminant spectrum", facts.has_illuminant),
        )
        if not there
    ]
    return f"the capture has no {' and no '.join(missing)}" if missing else None


def _nothing_to_compare(facts: SceneFacts, settings: Closed) -> str | None:
    if facts.truth_sha256 or facts.check_lights or settings.hold_out:
        return None
    return "there is no truth, the capture has no check lights and no light is held out (set hold_out)"


def _no_polarisers(facts: SceneFacts, settings: Closed) -> str | None:
    if len(facts.states) < 2:
        return "the photographs show one polariser state only"
    return _no_method(facts, settings)


def _no_poses(facts: SceneFacts, settings: Closed) -> str | None:
    return None if facts.has_poses else "the capture has no camera matrices, no board pictures and no correspondences"


def _whole_image(bytes_a_pixel: int) -> Callable[[int, int], int]:
    return lambda pixels, observations: 500 + pixels * bytes_a_pixel // 2**20


PLANE = (
    Stage(
        IngestSettings,
        "photographs to linear, white-normalised observations",
        geometry=None,
        libraries=("numpy", "numba", "zarr", "opencv-contrib-python-headless", "OpenEXR", "rawpy"),
    ),
    Stage(SeparateSettings, "lights that show only diffuse reflection", requires=("ingest",), lacks=_no_method),
    Stage(
        NormalsSettings,
        "normals and diffuse reflectance",
        requires=("ingest",),
        wants=lambda settings: ("separate",),
    ),
    Stage(
        HeightSettings,
        "height by integration of the normals",
        requires=("normals",),
        libraries=("numpy", "scipy", "numba", "zarr"),
        memory_mb=_whole_image(96),
    ),
    Stage(
        SpectraSettings,
        "spectral reflectance coefficients",
        requires=("ingest", "normals"),
        lacks=_no_spectra,
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr"),
    ),
    Stage(
        BrdfSettings,
        "Torrance-Sparrow parameters",
        requires=("ingest", "normals"),
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr"),
    ),
    Stage(
        RenderSettings,
        "pictures under any light and view",
        requires=("normals",),
        wants=lambda settings: ("height",) * settings.cast_shadows + ("spectra", "brdf"),
        needs_colour=True,
        libraries=("numpy", "numba", "zarr", "OpenEXR", "opencv-contrib-python-headless", "av"),
        memory_mb=_whole_image(160),
    ),
    Stage(
        EvaluateSettings,
        "errors against truth, or on lights that the fit never saw",
        requires=("ingest", "normals"),
        wants=lambda settings: ("height",) * settings.cast_shadows + ("spectra", "brdf"),
        lacks=_nothing_to_compare,
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr"),
        memory_mb=_whole_image(160),
    ),
    Stage(
        ReportSettings,
        "one page that tells everything",
        requires=("ingest", "normals"),
        uses=("separate", "height", "spectra", "brdf", "render", "evaluate"),
        libraries=("numpy", "jinja2", "zarr", "opencv-contrib-python-headless"),
        memory_mb=_whole_image(64),
    ),
)
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
        memory_mb=_whole_image(400),
    ),
    Stage(
        CamerasSettings,
        "where each view was taken from",
        geometry="turntable",
        requires=("ingest",),
        lacks=_no_poses,
        libraries=("numpy", "scipy", "opencv-contrib-python-headless"),
        memory_mb=_whole_image(64),
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
        memory_mb=lambda pixels, observations: 2000 + pixels * observations // 2**20,
    ),
    Stage(
        TexelsSettings,
        "what every view shows of every patch of the surface",
        geometry="turntable",
        requires=("ingest", "cameras", "mesh"),
        wants=lambda settings: ("polarise",),
        needs_colour=True,
        libraries=("numpy", "numba", "zarr", "opencv-contrib-python-headless"),
        memory_mb=lambda pixels, observations: 1500 + pixels * 200 // 2**20,
    ),
    Stage(
        ReflectionSettings,
        "Lambert and Torrance-Sparrow parameters of every texel",
        geometry="turntable",
        requires=("ingest", "texels"),
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr"),
        memory_mb=lambda pixels, observations: 2000,
    ),
    Stage(
        ResidualSettings,
        "captured minus model, as coded wavelet coefficients",
        geometry="turntable",
        requires=("texels", "reflection"),
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr", "pywavelets"),
        memory_mb=lambda pixels, observations: 2500,
        minutes=lambda pixels, observations: 20 + pixels * observations // 500_000,
    ),
    Stage(
        ObjectRenderSettings,
        "captured and in-between views, and a turn as video",
        geometry="turntable",
        product="render",
        requires=("ingest", "mesh", "cameras", "texels", "reflection", "residual"),
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr", "pywavelets", "OpenEXR", "opencv-contrib-python-headless", "av"),
        memory_mb=lambda pixels, observations: 2000 + pixels * 160 // 2**20,
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
        memory_mb=lambda pixels, observations: 2000 + pixels * 160 // 2**20,
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
        memory_mb=_whole_image(64),
    ),
)
CHAIN: dict[str, Stage] = {stage.name: stage for stage in (*PLANE, *TURNTABLE)}
PRODUCTS = tuple(dict.fromkeys(stage.asked_as for stage in CHAIN.values() if stage.name != "ingest"))


def chain_of(geometry: str) -> dict[str, Stage]:
    """Stages that captures of this geometry have, in the order of the flow."""
    return {name: stage for name, stage in CHAIN.items() if stage.serves(geometry)}
