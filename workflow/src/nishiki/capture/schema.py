"""Define and read the part of capture.yaml that every geometry shares: closed models, and errors in plain words."""

import re
from datetime import date as Date
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import yaml
from pydantic import Field, ValidationError, field_validator

from nishiki.artifacts.declaration import Closed, Fault, faults
from nishiki.formats.coding import RGB
from nishiki.formats.files import Refused, is_plain, read_text
from nishiki.formats.problems import CaptureError, Problem, error, refuse
from nishiki.formats.text_tables import SafeLoader, load_plain, refusal

FORMAT = 1  # of the file; readers refuse others
OBJECT_FACTS = {
    "object_kind": "Kind of object",
    "object_maker": "Maker",
    "object_made": "Made",
    "object_holder": "Kept by",
    "object_place": "Kept in",
}
"""Keys of capture.yaml about the object itself, beside `title` and `object_id`, with their labels on pages."""
ABOUT = ("title", "creator", "date", "object_id", *OBJECT_FACTS, "rights", "notes")
"""Keys of capture.yaml that are copied to records of a digitisation."""
TEXTS = frozenset(ABOUT) - {"date"}
"""Keys whose values are read as literal text, where YAML would convert 0755, 17.5 or yes."""
NULL, TEXT = "tag:yaml.org,2002:null", "tag:yaml.org,2002:str"

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(strict=True, ge=0)]


class CameraResponse(Closed):
    """Conversion of stored codes to light."""

    channels: tuple[str, ...] = Field(RGB, min_length=1, max_length=64)
    encoding: Literal["file", "linear", "srgb"] = "file"
    bits: Annotated[int, Field(strict=True, ge=1, le=16)] | None = None
    saturation: Annotated[float, Field(gt=0, le=1)] | None = None
    black_level: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    sensitivities: str | None = None
    model: str | None = None

    @field_validator("channels")
    @classmethod
    def _distinct(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(names)) != len(names) or any(not n.strip() or len(n) > 100 or not is_plain(n) for n in names):
            raise ValueError("channel names must be distinct and not empty, of at most 100 printable characters")
        return names


class White(Closed):
    """White board."""

    reflectance: Annotated[float, Field(gt=0, le=1.1)] = 1.0
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)

    @field_validator("normal")
    @classmethod
    def _faces_camera(cls, normal: tuple[float, float, float]) -> tuple[float, float, float]:
        length = sum(v * v for v in normal) ** 0.5
        if not 0 < length < float("inf") or normal[2] <= 0:
            raise ValueError("the board's normal must be finite, of non-zero length, with z > 0 (towards the camera)")
        return tuple(v / length for v in normal)


class Session(Closed):
    """Keys of capture.yaml for every geometry: object, creator and camera."""

    format: Literal[1]
    camera: CameraResponse = CameraResponse()
    title: str = ""
    creator: str | None = None
    date: str | None = None
    object_id: str | None = None
    object_kind: str | None = None
    object_maker: str | None = None
    object_made: str | None = None
    object_holder: str | None = None
    object_place: str | None = None
    rights: str | None = None
    notes: str | None = None
    illuminant: str | None = None
    white: White = White()

    @field_validator("date", mode="before")
    @classmethod
    def _iso_date(cls, value: Any) -> Any:
        # YAML reads an unquoted 2024-05-01 as a date; we keep the text of ISO 8601.
        if isinstance(value, Date):
            return value.isoformat()
        if isinstance(value, str):
            Date.fromisoformat(value[:10])
        return value


class UniqueKeyLoader(SafeLoader):
    """Safe YAML loader that rejects repeated keys and keeps TEXTS as literal text."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        for key_node, value_node in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} is not text", key_node.start_mark)
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key {key!r} appears twice", key_node.start_mark)
            seen.add(key)
            if key in TEXTS and isinstance(value_node, yaml.ScalarNode) and value_node.tag != NULL:
                value_node.tag = TEXT
        return super().construct_mapping(node, deep)


class UnquotedStatesLoader(UniqueKeyLoader):
    """Loader that keeps off, on, no and yes as words: polariser states need no quotes."""

    yaml_implicit_resolvers: ClassVar[dict] = {
        first: [(tag, words) for tag, words in resolvers if tag != "tag:yaml.org,2002:bool"]
        for first, resolvers in UniqueKeyLoader.yaml_implicit_resolvers.items()
    }


UnquotedStatesLoader.add_implicit_resolver(
    "tag:yaml.org,2002:bool", re.compile("true|True|TRUE|false|False|FALSE"), list("tTfF")
)


def read_mapping(path: Path, loader: type[UniqueKeyLoader] = UniqueKeyLoader) -> dict:
    """Read keys and values of a plain YAML file. CaptureError: yaml-missing, yaml-invalid."""
    try:
        parsed = load_plain(read_text(path, "settings_bytes"), loader)
    except FileNotFoundError as e:
        remedy = "Write one, or make a capture folder from photographs with the convert command"
        raise CaptureError(error("yaml-missing", path.name, "file is missing", remedy=remedy)) from e
    except Refused as e:
        raise CaptureError(refusal(e, "yaml-invalid")) from e
    except (yaml.YAMLError, UnicodeDecodeError) as e:
        mark = getattr(e, "problem_mark", None)
        where = f"{path.name} line {mark.line + 1}" if mark else path.name
        found = getattr(e, "problem", None) or str(e)
        raise CaptureError(
            error(
                "yaml-invalid", where, "not valid plain YAML", found=found, remedy="Correct the line; tags are not used"
            )
        ) from e
    if not isinstance(parsed, dict):
        refuse("yaml-invalid", path.name, "wrong content", expected="keys with values", found=type(parsed).__name__)
    return parsed


Model = TypeVar("Model", bound=Closed)


def validate(model: type[Model], parsed: dict, file: str) -> Model:
    """Parse the mapping as this closed model. CaptureError: unknown-key, missing-key, wrong-value."""
    try:
        return model.model_validate(parsed)
    except ValidationError as e:
        raise CaptureError([_problem(fault, file) for fault in faults(model, parsed, e)]) from e


def _problem(fault: Fault, file: str) -> Problem:
    if fault.kind == "unknown-key":
        remedy = fault.hint[0].upper() + fault.hint[1:]
        return error("unknown-key", file, f"unknown key '{fault.key}'", remedy=remedy)
    if fault.kind == "missing-key":
        return error("missing-key", file, str(fault), remedy="Add it; see the capture folder format")
    what = f"key '{fault.key}'" if fault.key else "keys disagree"
    given = repr(fault.value) if fault.key else ""
    return error(
        "wrong-value", file, what, expected=fault.text, found=given if len(given) <= 60 else given[:57] + "..."
    )
