"""Define stages, and the facts of a scene that plans require: the types of the one table in `nishiki.stages.table`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, Output
from nishiki.artifacts.provenance import file_digest, module_of
from nishiki.errors import UserError

Lights = Literal["all", "auto"] | Annotated[int, Field(ge=4, le=4096)]
Measurements = Literal["all", "auto"] | Annotated[int, Field(ge=8, le=100_000)]
Bases = Literal["auto"] | Annotated[int, Field(ge=1, le=16)]
"""Number of the measurements in use: all, a number, or chosen from the data."""

ARRAYS = ("numpy", "scipy", "numba", "zarr")
OPENCV = "opencv-contrib-python-headless"
"""Package of OpenCV, which most stages load."""


@dataclass(frozen=True)
class SceneFacts:
    """Facts of a scene that a plan requires before anything is read from its photographs.

    Attributes
    ----------
    capture_digest, truth_sha256 : str
        Digests of capture and truth; the latter is empty where there is no truth.
    lights, check_lights, channels, pixels
        Names of the lights; of those kept for evaluation; number of channels; pixels of one photograph.
    kept_pixels : int
        Pixels that ingest keeps of each: with a mask those of its bounding box. 0: all of them.
    has_sensitivities, has_illuminant : bool
        Whether the spectra of camera and lamp are known.
    geometry : str
        plane (one view, many lights), turntable (many views), goniometer (many pairs of directions) or mosaic (fields,
        each a plane).
    views, states : tuple of str
        Views of a turntable, and the states of its polarisers.
    has_poses : bool
        Whether matrices, boards or correspondences say where a turntable's cameras were.
    measurements, frontal : int
        Pairs of directions of a goniometer; of these, lit along the normal of the cloth.
    given : tuple of str
        Parts of a turntable's capture: matrices, boards, correspondences, silhouettes of all views.
    parts : mapping of str to int
        Number of files of each part that a scene may do without (see `nishiki.engine.plan`).
    suffixes : tuple of str
        Suffixes of the photographs' names, in small letters.
    table : bool
        Whether the capture holds reflectances instead of photographs.
    fields : mapping of str to tuple of float or None
        x and y of each field of a mosaic on the stage, in mm, None where unknown.
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
    kept_pixels: int = 0
    fields: Mapping[str, tuple[float, float] | None] = field(default_factory=dict)

    @property
    def observations(self) -> int:
        """Number of the object's photographs in a fit: lights, times views on a turntable; pairs of directions."""
        return self.measurements or max(len(self.lights), 1) * max(len(self.views), 1)

    @property
    def series(self) -> tuple[str, ...]:
        """Names that can be held out of the fits and predicted instead: views of a turntable, otherwise lights."""
        return self.views if self.geometry == "turntable" else self.lights


@dataclass(frozen=True)
class Cost:
    """Resources of a stage at its default settings: a constant part, one per pixel, one per sample.

    A sample is one pixel of one photograph, all channels together. Memory is the peak of the resident memory, time is
    processor time of all threads with compiled kernels. The numbers are upper limits of measurements, at most about
    twice what was measured (benchmarks/cost_models.py, docs/notes/cluster.md). Those of objects hold where the object
    fills about half of the picture, because a plan does not know how much it fills: a smaller one takes less.

    Attributes
    ----------
    mib, bytes_per_pixel, bytes_per_sample : float
        Memory: MiB of its own, bytes for each pixel and each sample.
    tiles : float
        Memory in tiles, of the stages that hold one tile of the observations at a time.
    seconds, us_per_pixel, us_per_sample : float
        Time: seconds of its own, microseconds for each pixel and each sample.
    """

    mib: float = 400.0
    bytes_per_pixel: float = 0.0
    bytes_per_sample: float = 0.0
    tiles: float = 0.0
    seconds: float = 5.0
    us_per_pixel: float = 0.0
    us_per_sample: float = 0.0

    def memory_mb(self, pixels: int, samples: int, *, tile_mib: float = 0.0) -> float:
        """Return peak resident memory in MiB; tile_mib: size of one tile of all observations, as float32."""
        growing = (pixels * self.bytes_per_pixel + samples * self.bytes_per_sample) / 2**20
        return self.mib + growing + self.tiles * tile_mib

    def processor_seconds(self, pixels: float, samples: float) -> float:
        """Return an upper limit of the expected processor time in seconds."""
        return self.seconds + (pixels * self.us_per_pixel + samples * self.us_per_sample) * 1e-6


SceneSettings = Mapping[str, Any]
"""Settings of all stages of a scene, by the name of the stage."""
Reason = Callable[[SceneFacts, SceneSettings], str | None]
Asked = tuple[str, ...]
Parts = Callable[[SceneFacts, SceneSettings, Asked], tuple[str, ...]]


@dataclass(frozen=True)
class Stage:
    """One stage of a chain.

    Attributes
    ----------
    settings : type of Guarded
        Model of its settings, with the stage's name, the version of its output and the limits of its result.
    does : str
        Result of the stage, in a few words.
    geometry : str or None
        Geometry of the captures that it processes; None: all.
    of_mosaics : bool
        Whether it also works on the maps into which the fields of a mosaic were joined.
    stands_for : tuple of str
        Stages whose artifacts of all fields it reads and joins, and in whose place later stages read its own.
    product : str
        Name under which a scene asks for it, where that is not its own: the `render` of a plane and that of a
        turntable are different stages with one name for the user.
    requires, optional_inputs, uses
        Stages without which it cannot run; those pulled into the plan where the capture can feed them; those that it
        reads where the plan has them anyway.
    missing_inputs : callable
        Reason why the capture cannot feed the stage, or None.
    needs_colour : bool
        Ingest keeps all channels for it.
    capture_parts : callable
        Parts of the capture (see `nishiki.engine.plan`) that it reads, from the facts, all settings of the
        scene and the products asked for.
    filled : callable
        Settings that only the plan knows, from its own settings and those of the scene.
    libraries : tuple of str
        Packages that it loads; their versions decide whether it runs again.
    unused_packages : mapping of str to callable
        For some of these, the reason why a scene does not load it, or None where it is loaded.
    outputs : tuple of Output
        The arrays of its `store`.
    deliverables : tuple of str
        Patterns of its files that a user wants to open; they are linked into `current/`.
    threads : int
        Maximum number of threads.
    cost : callable
        Memory and time, from the facts of the scene.
    scatter : bool
        Its work can be divided over jobs.
    """

    settings: type[Guarded]
    does: str
    geometry: str | None = "plane"
    of_mosaics: bool = False
    stands_for: tuple[str, ...] = ()
    product: str = ""
    requires: tuple[str, ...] = ()
    optional_inputs: Callable[[Any], tuple[str, ...]] = lambda settings: ()
    uses: tuple[str, ...] = ()
    missing_inputs: Callable[[SceneFacts, Any], str | None] = lambda facts, settings: None
    needs_colour: bool = True
    capture_parts: Parts = lambda facts, settings, asked: ()
    filled: Callable[[Any, Any], dict[str, Any]] = lambda block, settings: {}
    libraries: tuple[str, ...] = ("numpy", "numba", "zarr")
    unused_packages: Mapping[str, Reason] = field(default_factory=dict)
    outputs: tuple[Output, ...] = ()
    store: str = "maps.zarr"
    deliverables: tuple[str, ...] = ()
    threads: int = 2
    cost: Callable[[SceneFacts], Cost] = lambda facts: Cost()
    scatter: bool = False

    @property
    def name(self) -> str:
        """Name of the stage, of its rule, of its folder in the package and of its folder of results."""
        return self.settings.STAGE

    @property
    def version(self) -> int:
        """Version of the stage's output format; a part of the key."""
        return self.settings.VERSION

    @property
    def limits(self) -> tuple[Limit, ...]:
        """Limits of its result."""
        return self.settings.LIMITS

    @property
    def asked_as(self) -> str:
        """Name under which a scene requests it."""
        return self.product or self.name

    def serves(self, geometry: str) -> bool:
        """Check whether captures of this geometry have the stage."""
        return self.geometry in (None, geometry) or (geometry == "mosaic" and self.of_mosaics)


def declaration_of(name: str) -> Stage:
    """Return the declaration of a stage from its package, without importing that of any other stage."""
    package = import_module(f"nishiki.stages.{module_of(name).partition('.')[0]}")
    return next(value for value in vars(package).values() if isinstance(value, Stage) and value.name == name)


def no_method(facts: SceneFacts, settings: Any) -> str | None:
    """Return the reason to omit a stage whose method is none."""
    return "its method is set to none" if settings.method == "none" else None


POSES = ("matrices", "boards", "correspondences", "photographs")
"""What can give the poses of a turntable, the best first."""


def poses_of(facts: SceneFacts, settings: SceneSettings) -> str:
    """Return what gives the poses: matrices, boards, correspondences or photographs (see the stage cameras)."""
    source = settings["cameras"].source
    there = [name for name in POSES if name in facts.given]
    return source if source != "auto" else next(iter(there), "")


def surface_of(facts: SceneFacts, settings: SceneSettings) -> str:
    """Return the source of the surface: file, scans or silhouettes (see the stage mesh)."""
    source = settings["mesh"].source
    there = [name for name, part in (("file", "mesh"), ("scans", "scans")) if facts.parts.get(part)]
    return source if source != "auto" else next(iter(there), "silhouettes")


def photographs_or_states(facts: SceneFacts, settings: SceneSettings, asked: Asked) -> tuple[str, ...]:
    """Return parts of a turntable's capture that hold light of any polarisation."""
    return ("photographs",) if "off" in facts.states else ("photographs", "states")


def only_files(suffixes: frozenset[str], what: str) -> Reason:
    """Return the reason not to load the package of one kind of photograph."""
    return lambda facts, settings: None if suffixes & set(facts.suffixes) else f"no photograph is {what}"


def no_film(stage: str, key: str) -> Reason:
    """Return the reason not to load the package that writes videos."""
    return lambda facts, settings: None if getattr(settings[stage], key) else "no video is asked for"


def no_format(stage: str, name: str) -> Reason:
    """Return the reason not to load the package that writes a format."""
    return lambda facts, settings: None if name in settings[stage].formats else f"no file of format {name} is asked for"


def digest_of(path: str, key: str) -> str:
    """Return the SHA-256 of a file that a setting names; UserError where it is missing."""
    if not Path(path).is_file():
        raise UserError(f"{key}: file {path} not found; correct the path in the configuration")
    return file_digest(Path(path))
