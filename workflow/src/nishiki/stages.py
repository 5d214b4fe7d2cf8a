"""The one table that declares the chain; plan, keys, rules, resources and documentation derive from it."""

from collections.abc import Callable
from dataclasses import dataclass

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


@dataclass(frozen=True)
class SceneFacts:
    """What a plan has to know of a scene before anything is read from its photographs."""

    capture_digest: str
    lights: tuple[str, ...]
    check_lights: tuple[str, ...]
    channels: int
    pixels: int
    has_sensitivities: bool
    has_illuminant: bool
    truth_sha256: str  # empty: no truth


@dataclass(frozen=True)
class Stage:
    """One stage of the chain.

    requires: without these stages it cannot run; wants: pulled into the plan where the capture can feed them; uses:
    read where the plan has them anyway. lacks: a reason why the capture cannot feed the stage, or None.
    memory_mb: (pixels, lights, settings) -> peak resident memory; minutes: likewise, generous.
    """

    settings: type[Closed]
    does: str
    requires: tuple[str, ...] = ()
    wants: Callable[[Closed], tuple[str, ...]] = lambda settings: ()
    uses: tuple[str, ...] = ()
    lacks: Callable[[SceneFacts, Closed], str | None] = lambda facts, settings: None
    needs_colour: bool = False
    libraries: tuple[str, ...] = ("numpy", "numba", "zarr")
    memory_mb: Callable[[int, int], int] = lambda pixels, lights: 700
    minutes: Callable[[int, int], int] = lambda pixels, lights: 5 + pixels * lights // 20_000_000

    @property
    def name(self) -> str:
        """Name of the stage, of its rule, of its script and of its folder."""
        return self.settings.STAGE

    @property
    def version(self) -> int:
        """Version of the stage's output format; a part of the key."""
        return self.settings.VERSION


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


def _whole_image(bytes_a_pixel: int) -> Callable[[int, int], int]:
    return lambda pixels, lights: 500 + pixels * bytes_a_pixel // 2**20


CHAIN: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        Stage(
            IngestSettings,
            "photographs to linear, white-normalised observations",
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
}
PRODUCTS = tuple(name for name in CHAIN if name != "ingest")
