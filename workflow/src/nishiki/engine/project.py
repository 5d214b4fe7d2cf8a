"""Read the configuration and the scene table, and the facts of a scene that a plan requires of its capture."""

import csv
import os
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import yaml
from pydantic import Field, create_model

from nishiki.artifacts.declaration import Closed, merge_blocks, parse
from nishiki.artifacts.provenance import scene_of_field, truth_digest
from nishiki.capture.folder import Capture, load_capture
from nishiki.capture.goniometer import GoniometerCapture
from nishiki.capture.mosaic import MosaicCapture, is_mosaic, read_fields
from nishiki.capture.seal import capture_digest
from nishiki.capture.turntable import TurntableCapture, estimates_cameras
from nishiki.errors import UserError
from nishiki.formats.files import is_plain, read_text
from nishiki.formats.images import read_header
from nishiki.formats.problems import CaptureError
from nishiki.formats.text_tables import load_plain
from nishiki.goniometry.table import NORMAL_DEG
from nishiki.observations.linearise import CHECK_BLOCK
from nishiki.observations.region import object_mask, region_around, region_of
from nishiki.stages.base import POSES, SceneFacts
from nishiki.stages.table import CHAIN, PRODUCTS, chain_of
from nishiki.sweep.variants import SweepName, SweepSettings

CONFIGURATION = "config/config.yaml"
COLUMNS = ("scene", "capture", "truth", "products", "settings")
SCATTERED = tuple(name for name, stage in CHAIN.items() if stage.scatter)
if TYPE_CHECKING:  # the names stand in the table of stages
    DividedStage = str
    Product = str
else:
    DividedStage, Product = Literal[SCATTERED], Literal[PRODUCTS]
SWEEPS = "sweeps"
"""Folder of the results that holds the pages and timings of sweeps."""


class Shared(Closed):
    """Settings of a scene that concern several stages."""

    hold_out: Literal["auto", "none"] | tuple[str, ...] = Field(
        "auto",
        description="lights (views of a turntable) left out of every fit and predicted instead; auto: some, where "
        "nothing else checks",
    )
    scatter: Literal["none", "auto"] | dict[DividedStage, Annotated[int, Field(ge=1, le=256)]] = Field(
        "none",
        description="parts that a stage is divided into, each a job: {normals: 4}; auto: of about a quarter of an "
        "hour; the results have the same keys and bytes (docs/cluster.md)",
    )


if TYPE_CHECKING:

    class StageSettings(Shared):
        def __getattr__(self, stage: str) -> Any: ...

else:
    StageSettings = create_model(
        "StageSettings",
        __base__=Shared,
        __doc__="Settings of the stages; everything has a default.",
        **{name: (stage.settings, stage.settings()) for name, stage in CHAIN.items()},
    )


class Configuration(StageSettings):
    """The whole of config/config.yaml."""

    scenes: str = Field("config/scenes.tsv", description="scene table: scene, capture, truth, products, settings")
    results: str = Field("results", description="folder of the results", min_length=1, pattern=r"^[^{}\x00-\x1f]+$")
    products: tuple[Product, ...] = Field(
        ("render", "evaluate", "report"), min_length=1, description="what is wanted, where a scene does not say"
    )
    sweeps: dict[SweepName, SweepSettings] = Field(
        {}, description="sweeps by name: settings to vary, and what to measure; made by ./nishiki sweep NAME"
    )
    sweep: str = Field("", description="the sweep to make: a name, or a file; filled in by ./nishiki sweep")
    exports: dict[str, tuple[str, ...]] = Field(
        {}, description="formats to export beside the products, by scene; filled in by ./nishiki export"
    )


@dataclass(frozen=True)
class Scene:
    """One row of the scene table, with its own settings merged in."""

    name: str
    capture: Path
    truth: Path | None
    products: tuple[str, ...]
    settings: StageSettings
    fields: tuple["Scene", ...] = ()  # of a mosaic: the scenes of its fields

    @property
    def with_fields(self) -> tuple["Scene", ...]:
        """The scenes of its fields, and itself, which is made from them."""
        return (*self.fields, self)


@dataclass(frozen=True)
class Project:
    """Checked configuration and scenes."""

    configuration: Configuration
    scenes: dict[str, Scene]

    @property
    def results(self) -> Path:
        """Folder of the results."""
        return Path(self.configuration.results)


def load_yaml(path: Path) -> dict:
    """Load keys and values of a YAML file (see `load_plain`). Raises UserError naming file, line and remedy."""
    try:
        values = load_plain(read_text(path, "settings_bytes", name=str(path))) or {}
    except FileNotFoundError:
        remedy = "Remedy: ./nishiki init makes one, or name it with --configfile; ./nishiki demo makes one to try"
        raise UserError(f"{path}: file not found" + (f". {remedy}" if str(path) == CONFIGURATION else "")) from None
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: expected UTF-8 text ({error.reason} at byte {error.start})") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        raise UserError(f"{path}{line}: not valid YAML ({getattr(error, 'problem', error)})") from None
    if not isinstance(values, dict):
        raise UserError(f"{path}: expected a block of keys and values, found {type(values).__name__}")
    return values


def load_project(
    values: dict | None = None, *, path: Path = Path(CONFIGURATION), may_be_empty: bool = False
) -> Project:
    """Project from `values` (as parsed from `path`), or from the file itself where values are None.

    Raises UserError naming file, key or row, what was expected and found.
    """
    if values is None:
        values = load_yaml(path)
    configuration = parse(Configuration, values, str(path))
    scenes = {}
    for row in _read_scenes(configuration, values, Path(configuration.scenes)):
        for scene in row.with_fields:
            if scene.name in scenes:
                raise UserError(f"{configuration.scenes}: scene {scene.name!r} stands in the table twice")
            scenes[scene.name] = scene
    if not scenes and not may_be_empty:
        raise UserError(f"{configuration.scenes}: no scene in the table. Remedy: ./nishiki run PHOTOGRAPHS/ adds one")
    return Project(configuration, scenes)


def _read_scenes(configuration: Configuration, values: dict, table: Path) -> list[Scene]:
    try:
        lines = read_text(table, "scenes_bytes", name=str(table)).splitlines()
        rows = list(csv.reader((line for line in lines if line.strip() and not line.startswith("#")), delimiter="\t"))
    except FileNotFoundError:
        raise UserError(f"{table}: scene table not found (named by the key scenes)") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{table}: expected a tab-separated table in UTF-8 ({error})") from None
    header = tuple(rows[0]) if rows else ()
    if not {"scene", "capture"} <= set(header) <= set(COLUMNS):
        text = ", ".join(header)[:200] or "an empty file"
        raise UserError(f"{table}: expected tab-separated columns {', '.join(COLUMNS)}, found {text}")
    for row in rows[1:]:
        if any(cell.strip() for cell in row[len(header) :]):
            text = f"found {len(row)} values: {', '.join(row)[:120]}"
            raise UserError(f"{table}: scene {row[0]!r}: expected {len(header)} values as there are columns, {text}")
    return [_scene(dict(zip(header, row, strict=False)), configuration, values, table) for row in rows[1:]]


def _scene(row: dict[str, str], configuration: Configuration, values: dict, table: Path) -> Scene:
    name = row.get("scene", "").strip()
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,99}", name):
        raise UserError(f"{table}: scene name {name[:120]!r}: use letters, digits, - and _ only, no - in front")
    for key, value in row.items():
        if not is_plain(value):
            raise UserError(f"{table}: scene {name!r}: {key} has control characters, found {value[:120]!r}")
    if name == SWEEPS:
        raise UserError(f"{table}: a scene cannot be called {name!r}: this folder of the results holds the sweeps")
    capture = row.get("capture", "").strip()
    if not capture:
        raise UserError(f"{table}: scene {name!r} names no capture folder")
    products = tuple(row.get("products", "").replace(",", " ").split()) or configuration.products
    unknown = [product for product in products if product not in PRODUCTS]
    if unknown:
        raise UserError(f"{table}: scene {name!r}: unknown product {unknown[0]!r}; known: {', '.join(PRODUCTS)}")
    truth = row.get("truth", "").strip()
    settings: StageSettings = configuration
    if path := row.get("settings", "").strip():
        shared = {key: value for key, value in values.items() if key in StageSettings.model_fields}
        settings = parse(StageSettings, merge_blocks(shared, load_yaml(Path(path))), path)
    scene = Scene(name, _place(capture), _place(truth) if truth else None, products, settings)
    return replace(scene, fields=_scenes_of_fields(scene)) if is_mosaic(scene.capture) else scene


def _scenes_of_fields(scene: Scene) -> tuple[Scene, ...]:
    """Return a scene for each field of a mosaic; none where its table is wrong, which its plan reports.

    Strengths of lamps that each field estimates by itself differ from field to field: without boards, lamps are
    taken as equally strong in all of them.
    """
    settings, ingest = scene.settings, scene.settings.ingest
    if "gains" not in ingest.correct.model_fields_set:
        correct = ingest.correct.model_copy(update={"gains": "never"})
        settings = settings.model_copy(update={"ingest": ingest.model_copy(update={"correct": correct})})
    products = next(iter(stage.stands_for[1:] for stage in CHAIN.values() if stage.stands_for), ())
    with suppress(CaptureError):
        return tuple(
            Scene(scene_of_field(scene.name, field.name), field.path, None, products, settings)
            for field in read_fields(scene.capture)
        )
    return ()


def _place(text: str) -> Path:
    return Path(os.path.expandvars(text)).expanduser()


def scene_with(scene: Scene, overrides: dict, where: str) -> Scene:
    """Change some settings of a scene, by stage. Raises UserError naming `where` and the key."""
    base = scene.settings.model_dump(exclude_unset=True, include=set(StageSettings.model_fields))
    return replace(scene, settings=parse(StageSettings, merge_blocks(base, overrides), where))


def scene_with_exports(scene: Scene, geometry: str, formats: tuple[str, ...]) -> Scene:
    """Add an export in these formats to a scene. UserError where its captures have no such format."""
    stage = next((name for name, each in chain_of(geometry).items() if each.asked_as == "export"), None)
    if stage is None:
        raise UserError(f"scene {scene.name!r}: nothing can be exported from captures of a {geometry} yet")
    changed = scene_with(scene, {stage: {"formats": list(formats)}}, f"./nishiki export {scene.name}")
    return replace(changed, products=tuple(dict.fromkeys((*scene.products, "export"))))


def scene_facts(scene: Scene) -> SceneFacts:
    """Read the facts of a scene. Raises UserError where the capture is missing, not sealed or broken."""
    try:
        capture = load_capture(scene.capture)
    except UserError as error:
        raise UserError(f"scene {scene.name!r} of the scene table: {error}") from None
    if not capture.sealed:
        raise UserError(
            f"scene {scene.name!r}: capture {scene.capture} is not sealed. Remedy: ./nishiki seal {scene.capture}"
        )
    return replace(FACTS[capture.geometry](capture), truth_sha256=truth_digest(scene.truth) if scene.truth else "")


def _plane_facts(capture: Capture) -> SceneFacts:
    return SceneFacts(
        **_common_facts(capture),
        lights=tuple(frame.light for frame in capture.observed if frame.role == "sample"),
        check_lights=tuple(frame.light for frame in capture.observed if frame.role == "check"),
        channels=len(capture.settings.camera.channels),
        pixels=_pixels(capture),
        parts={role: len(capture.frames_of(role)) for role in ("check", "flat")},
        kept_pixels=_count_pixels(capture),
    )


def _mosaic_facts(capture: MosaicCapture) -> SceneFacts:
    """Return facts of the joined maps; pixels: of all fields, of which their overlaps are counted more than once."""
    fields = [_plane_facts(each) for each in capture.captures]
    return replace(
        fields[0],
        capture_digest=capture.digest,
        lights=(),
        check_lights=(),
        pixels=sum(each.kept_pixels or each.pixels for each in fields),
        geometry="mosaic",
        parts={},
        suffixes=(),
        kept_pixels=0,
        fields={each.name: each.position_mm for each in capture.fields},
    )


def _turntable_facts(capture: TurntableCapture) -> SceneFacts:
    boards = {frame.view for frame in capture.frames_of("board")}
    given = {
        "matrices": capture.matrices is not None,
        "boards": boards >= set(capture.views),
        "correspondences": capture.points is not None,
        "photographs": estimates_cameras(capture.settings.turntable, capture.views),
        "silhouettes": all(capture.silhouette_of(view) for view in capture.views),
    }
    header = read_header(capture.observed[0].path, name=capture.observed[0].file)
    observed = capture.observed
    first = [f for f in observed if f.polariser == capture.states[0]]
    return SceneFacts(
        **_common_facts(capture),
        lights=capture.light_names,
        check_lights=(),
        channels=len(capture.settings.camera.channels),
        pixels=header.rows * header.columns,
        geometry="turntable",
        views=capture.views,
        states=capture.states,
        has_poses=any(given[name] for name in POSES),
        given=tuple(name for name, is_there in given.items() if is_there),
        parts={
            "states": len(observed) - len(first),
            "white_states": sum(bool(f.polariser) for f in capture.frames_of("white")),
            "photographs": len(first),
            "calibration": len(capture.frames_of("board")),
            "silhouettes": len({f.silhouette for f in capture.frames if f.silhouette}),
            "mesh": int(capture.mesh is not None),
            "scans": len(capture.scans),
        },
    )


def _goniometer_facts(capture: GoniometerCapture) -> SceneFacts:
    angles, pixels, table = capture.angles_deg, 1, capture.table is not None
    if not table:
        header = read_header(capture.observed[0].path, name=capture.observed[0].file)
        rows, columns, crop = header.rows, header.columns, capture.settings.goniometer.crop_px
        pixels = rows * columns if capture.regions is not None else min(rows, crop) * min(columns, crop)
    along = sum(angle[0] < NORMAL_DEG for angle in angles)
    return SceneFacts(
        **_common_facts(capture),
        lights=(),
        check_lights=(),
        channels=len(capture.channels),
        pixels=pixels,
        geometry="goniometer",
        measurements=len(angles),
        frontal=along,
        parts={} if table or not along else {"oblique": len(angles) - along},
        table=table,
    )


FACTS: dict[str, Callable[[Any], SceneFacts]] = {
    "plane": _plane_facts,
    "turntable": _turntable_facts,
    "goniometer": _goniometer_facts,
    "mosaic": _mosaic_facts,
}


def _common_facts(capture: Capture | TurntableCapture | GoniometerCapture) -> dict[str, Any]:
    """Return the facts that captures of every geometry have."""
    return {
        "capture_digest": capture_digest(capture.root),
        "has_sensitivities": capture.sensitivities is not None,
        "has_illuminant": capture.illuminant is not None,
        "truth_sha256": "",
        "suffixes": tuple(sorted({frame.path.suffix.lower() for frame in capture.frames})),
    }


def _pixels(capture: Capture) -> int:
    """Count the pixels of the region of interest, from the header of the first photograph."""
    region = capture.settings.region_of_interest
    if region is not None:
        return region[2] * region[3]
    header = read_header(capture.observed[0].path, name=capture.observed[0].file)
    return header.rows * header.columns


def _count_pixels(capture: Capture) -> int:
    """Count the pixels of the mask's bounding box inside the region of interest.

    The count is 0 without a mask, or with one that ingest will refuse.
    """
    if capture.mask is None:
        return 0
    header = read_header(capture.observed[0].path, name=capture.observed[0].file)
    try:
        region = region_of(capture, header.rows, header.columns)
        mask = object_mask(capture, (header.rows, header.columns), region).inside
    except CaptureError:
        return 0
    _, _, rows, columns = region_around(mask, region, CHECK_BLOCK)
    return rows * columns
