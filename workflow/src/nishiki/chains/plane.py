"""Stages of a flat object under many lights."""

from nishiki.chain import Cost, SceneFacts, Stage
from nishiki.chains.common import no_method
from nishiki.closed import Closed
from nishiki.settings.brdf import BrdfSettings
from nishiki.settings.evaluate import EvaluateSettings
from nishiki.settings.height import HeightSettings
from nishiki.settings.ingest import IngestSettings
from nishiki.settings.normals import NormalsSettings
from nishiki.settings.render import RenderSettings
from nishiki.settings.report import ReportSettings
from nishiki.settings.separate import SeparateSettings
from nishiki.settings.spectra import SpectraSettings


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


PLANE = (
    Stage(
        IngestSettings,
        "photographs to linear, white-normalised observations",
        geometry=None,
        libraries=("numpy", "numba", "zarr", "opencv-contrib-python-headless", "OpenEXR", "rawpy"),
    ),
    Stage(
        SeparateSettings,
        "lights that show only diffuse reflection",
        requires=("ingest",),
        lacks=no_method,
        scatter=True,
    ),
    Stage(
        NormalsSettings,
        "normals and diffuse reflectance",
        requires=("ingest",),
        wants=lambda settings: ("separate",),
        scatter=True,
    ),
    Stage(
        HeightSettings,
        "height by integration of the normals",
        requires=("normals",),
        libraries=("numpy", "scipy", "numba", "zarr"),
        cost=Cost(mib=500, bytes_per_pixel=96),
    ),
    Stage(
        SpectraSettings,
        "spectral reflectance coefficients",
        requires=("ingest", "normals"),
        lacks=_no_spectra,
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr"),
        scatter=True,
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
        cost=Cost(mib=500, bytes_per_pixel=160),
    ),
    Stage(
        EvaluateSettings,
        "errors against truth, or on lights that the fit never saw",
        requires=("ingest", "normals"),
        wants=lambda settings: ("height",) * settings.cast_shadows + ("spectra", "brdf"),
        lacks=_nothing_to_compare,
        needs_colour=True,
        libraries=("numpy", "scipy", "numba", "zarr"),
        cost=Cost(mib=500, bytes_per_pixel=160),
    ),
    Stage(
        ReportSettings,
        "one page that tells everything",
        requires=("ingest", "normals"),
        uses=("separate", "height", "spectra", "brdf", "render", "evaluate"),
        libraries=("numpy", "jinja2", "zarr", "opencv-contrib-python-headless"),
        cost=Cost(mib=500, bytes_per_pixel=64),
    ),
)
