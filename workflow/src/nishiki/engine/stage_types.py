"""What a stage is, and what a plan has to know of a scene: the types of the one table in `nishiki.engine.chains`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from nishiki.artifacts.closed import Closed


@dataclass(frozen=True)
class SceneFacts:
    """What a plan has to know of a scene before anything is read from its photographs.

    geometry: plane (one view, many lights), turntable (many views) or goniometer (many pairs of directions); views,
    states (of polarisers): of a turntable; has_poses: matrices, boards or correspondences tell where its cameras were;
    measurements: pairs of directions of a goniometer, frontal: of these, lit along the normal of the cloth.
    truth_sha256: empty where there is no truth. given: what a turntable's capture comes with (matrices, boards,
    correspondences, silhouettes of all views); parts: number of files of each part that a scene may do without (see
    `nishiki.engine.capture_parts`); suffixes: of the photographs' names, in small letters; table: reflectances instead
    of photographs.
    """

    capture_digest: str
    lights: tuple[str, ...]
    check_lights: tuple[str, ...]
    channels: int
    pixels: int
    has_sensitivities: bool
    has_illuminant: bool
    truth_sha256: str
    geometry: str = "plane"
    views: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    has_poses: bool = False
    measurements: int = 0
    frontal: int = 0
    given: tuple[str, ...] = ()
    parts: Mapping[str, int] = field(default_factory=dict)
    suffixes: tuple[str, ...] = ()
    table: bool = False

    @property
    def observations(self) -> int:
        """Photographs of the object that a fit sees: lights, times views on a turntable; pairs of directions."""
        return self.measurements or max(len(self.lights), 1) * max(len(self.views), 1)

    @property
    def series(self) -> tuple[str, ...]:
        """Names of what can be left out of the fits and predicted instead: views of a turntable, otherwise lights."""
        return self.views if self.geometry == "turntable" else self.lights


@dataclass(frozen=True)
class Cost:
    """What a stage takes at its default settings: a part of its own, one for each pixel, one for each sample.

    A sample is one pixel of one photograph, all channels together. tiles: memory in tiles, of the stages that hold one
    tile of the observations at a time. Memory is the peak of the resident memory, time is processor time of all
    threads with compiled kernels. The numbers are upper limits of measurements, at most about twice what was measured
    (tests/benchmarks/cost_models.py, docs/cluster.md).
    """

    mib: float = 400.0
    bytes_per_pixel: float = 0.0
    bytes_per_sample: float = 0.0
    tiles: float = 0.0
    seconds: float = 5.0
    us_per_pixel: float = 0.0
    us_per_sample: float = 0.0

    def memory_mb(self, pixels: int, samples: int, *, tile_mib: float = 0.0) -> float:
        """Peak resident memory in MiB; tile_mib: of one tile of all observations, as float32."""
        growing = (pixels * self.bytes_per_pixel + samples * self.bytes_per_sample) / 2**20
        return self.mib + growing + self.tiles * tile_mib

    def processor_seconds(self, pixels: float, samples: float) -> float:
        """Expected processor time in seconds, at most."""
        return self.seconds + (pixels * self.us_per_pixel + samples * self.us_per_sample) * 1e-6


@dataclass(frozen=True)
class Stage:
    """One stage of the chain.

    requires: without these stages it cannot run; wants: pulled into the plan where the capture can feed them; uses:
    read where the plan has them anyway. lacks: a reason why the capture cannot feed the stage, or None.
    geometry: the captures that it is for, None: all. product: the name under which a scene asks for it, where that is
    not its own: a plane's and a turntable's `render` are different stages with one name for the user.
    cost: memory and time as measured, of a scene of this kind, for whoever plans or schedules. scatter: its work can be
    divided over jobs.
    """

    settings: type[Closed]
    does: str
    requires: tuple[str, ...] = ()
    wants: Callable[[Closed], tuple[str, ...]] = lambda settings: ()
    uses: tuple[str, ...] = ()
    lacks: Callable[[SceneFacts, Closed], str | None] = lambda facts, settings: None
    geometry: str | None = "plane"
    product: str = ""
    needs_colour: bool = False
    libraries: tuple[str, ...] = ("numpy", "numba", "zarr")
    cost: Callable[[SceneFacts], Cost] = lambda facts: Cost()
    scatter: bool = False

    @property
    def name(self) -> str:
        """Name of the stage, of its rule, of its script and of its folder."""
        return self.settings.STAGE

    @property
    def version(self) -> int:
        """Version of the stage's output format; a part of the key."""
        return self.settings.VERSION

    @property
    def asked_as(self) -> str:
        """The name under which a scene asks for it."""
        return self.product or self.name

    def serves(self, geometry: str) -> bool:
        """Whether captures of this geometry have the stage."""
        return self.geometry in (None, geometry)
