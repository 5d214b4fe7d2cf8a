"""Stages of a flat object under many lights."""

from nishiki.chains.chain import Cost, SceneFacts, Stage
from nishiki.chains.common import no_method
from nishiki.contract.closed import Closed
from nishiki.settings.brdf import BrdfSettings
from nishiki.settings.evaluate import EvaluateSettings
from nishiki.settings.height import HeightSettings
from nishiki.settings.ingest import IngestSettings
from nishiki.settings.normals import NormalsSettings
from nishiki.settings.render import RenderSettings
from nishiki.settings.report import ReportSettings
from nishiki.settings.separate import SeparateSettings
from nishiki.settings.spectra import SpectraSettings

FEW_LIGHTS = 24  # as in nishiki.normals.gloss_scene, which is not loaded for planning


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


def _ingest_cost(facts: SceneFacts) -> Cost:
    """Decoding: JPEG is quick; a flat object has a white and a dark photograph to most of its lights."""
    if set(facts.suffixes) & {".jpg", ".jpeg"}:
        return Cost(mib=400, seconds=2.2, us_per_sample=0.05)
    each = {"plane": 0.65, "turntable": 2.0, "goniometer": 0.42}[facts.geometry]
    return Cost(mib=400, seconds=2.2, us_per_sample=each)


def _normals_cost(facts: SceneFacts) -> Cost:
    """With few lights the gloss is fitted together with the normals."""
    if len(facts.lights) <= FEW_LIGHTS:
        return Cost(mib=400, tiles=2.2, bytes_per_pixel=8, seconds=2.8, us_per_pixel=9, us_per_sample=0.02)
    return Cost(mib=400, tiles=2.2, bytes_per_pixel=8, seconds=2.8, us_per_pixel=1, us_per_sample=0.2)


def _evaluate_cost(facts: SceneFacts) -> Cost:
    if facts.truth_sha256:
        return Cost(mib=390, bytes_per_pixel=160, seconds=2.8, us_per_pixel=16)
    return Cost(mib=225, bytes_per_pixel=195, seconds=2.4, us_per_pixel=16)


PLANE = (
    Stage(
        IngestSettings,
        "photographs to linear, white-normalised observations",
        geometry=None,
        libraries=("numpy", "scipy", "numba", "zarr", "opencv-contrib-python-headless", "OpenEXR", "rawpy"),
        cost=_ingest_cost,
    ),
    Stage(
        SeparateSettings,
        "lights that show only diffuse reflection",
        requires=("ingest",),
        lacks=no_method,
        needs_colour=True,
        scatter=True,
        cost=lambda facts: Cost(mib=300, tiles=2.0, seconds=2.5, us_per_pixel=2, us_per_sample=0.12),
    ),
    Stage(
        NormalsSettings,
        "normals and diffuse reflectance",
        requires=("ingest",),
        wants=lambda settings: ("separate",),
        needs_colour=True,  # normals from luminance alone are others, so that they would depend on the products
        libraries=("numpy", "scipy", "numba", "zarr"),
        scatter=True,
        cost=_normals_cost,
    ),
    Stage(
        HeightSettings,
        "height by integration of the normals",
        requires=("normals",),
        libraries=("numpy", "scipy", "numba", "zarr"),
        cost=lambda facts: Cost(mib=200, bytes_per_pixel=96, seconds=1.4, us_per_pixel=36),
    ),
    Stage(
        SpectraSettings,
        "spectral reflectance coefficients",
        requires=("ingest", "normals"),
        lacks=_no_spectra,
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr"),
        scatter=True,
        cost=lambda facts: Cost(mib=270, tiles=0.5, seconds=2.2, us_per_pixel=8),
    ),
    Stage(
        BrdfSettings,
        "Torrance-Sparrow parameters",
        requires=("ingest", "normals"),
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr"),
        cost=lambda facts: Cost(mib=260, tiles=0.9, seconds=2.2, us_per_pixel=6, us_per_sample=0.02),
    ),
    Stage(
        RenderSettings,
        "pictures under any light and view",
        requires=("normals",),
        wants=lambda settings: ("height",) * settings.cast_shadows + ("spectra", "brdf"),
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr", "OpenEXR", "opencv-contrib-python-headless", "av"),
        cost=lambda facts: Cost(mib=380, bytes_per_pixel=160, seconds=4, us_per_pixel=30),
    ),
    Stage(
        EvaluateSettings,
        "errors against truth, or on lights that the fit never saw",
        requires=("ingest", "normals"),
        wants=lambda settings: ("height",) * settings.cast_shadows + ("spectra", "brdf"),
        lacks=_nothing_to_compare,
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr"),
        cost=_evaluate_cost,
    ),
    Stage(
        ReportSettings,
        "one page that tells everything",
        requires=("ingest", "normals"),
        uses=("separate", "height", "spectra", "brdf", "render", "evaluate"),
        libraries=("numpy", "jinja2", "zarr", "opencv-contrib-python-headless"),
        cost=lambda facts: Cost(mib=230, bytes_per_pixel=16, seconds=2, us_per_pixel=8),
    ),
)
