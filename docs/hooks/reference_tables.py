"""Reference tables of the stages, written from their declarations (a hook of mkdocs; see mkdocs.yml).

A page of a stage says `Declared in [NAME](../../workflow/.../stages/PACKAGE/__init__.py).`, a link that
readers of the repository can follow. On the site the tables of settings, limits, inputs and cost replace it. The
line `Declared in [table.py](...).` becomes the list of all stages, `Declared in [project.py](...).` the settings that
stand beside the stages' own.
"""

import html
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "workflow" / "src"))

from nishiki.engine.plan import PARTS
from nishiki.engine.project import Configuration
from nishiki.installation import EXTRAS
from nishiki.stages.base import SceneFacts, Stage
from nishiki.stages.table import CHAIN, PRODUCTS, chain_of

LINE = re.compile(
    r"^Declared in \[([^]]*)\]\((?:\.\./)((?:\.\./)*)workflow/src/nishiki/[a-z_/]+\.py\)\.$", re.MULTILINE
)
PAGE = re.compile(r"\bdocs/((?:\w+/)*([\w-]+)\.md)")
GEOMETRIES = {
    "plane": "flat scenes",
    "mosaic": "fields of flat scenes",
    "turntable": "objects on a turntable",
    "goniometer": "cloths on a goniometer",
}
INDEX = {
    "plane": "A flat scene",
    "mosaic": "A mosaic of fields, each a flat scene",
    "turntable": "An object on a turntable",
    "goniometer": "A cloth on a goniometer",
}
EXAMPLES = {
    "plane": SceneFacts("", tuple("abcdefghi"), (), 3, 4_000_000, True, True, "0", parts={"check": 1}),
    "mosaic": SceneFacts(
        "", (), (), 3, 40_000_000, True, True, "0", geometry="mosaic", fields=dict.fromkeys("abcdefghij")
    ),
    "turntable": SceneFacts(
        "", ("lamp",), (), 3, 400_000, False, False, "", geometry="turntable", views=tuple(map(str, range(36)))
    ),
    "goniometer": SceneFacts(
        "", (), (), 3, 256, False, False, "", geometry="goniometer", measurements=1000, frontal=800
    ),
}
"""A scene of each kind, for which the memory and the time of a stage are given."""
EXAMPLE_WORDS = {
    "plane": "4 million pixels under 9 lights",
    "mosaic": "10 fields of 4 million pixels",
    "turntable": "36 views of 400,000 object pixels",
    "goniometer": "1,000 directions, 256 pixels each",
}


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Replace the lines of a page that name a declaration by its tables; pages that these name become links."""
    return LINE.sub(lambda line: PAGE.sub(rf"[\2]({line[2]}\1)", tables(line[1])), markdown)


def tables(name: str) -> str:
    """Markdown that stands for a stage, or for the module that lists the stages or the settings beside theirs."""
    if name == "table.py":
        return "\n".join(f"\n### {INDEX[geometry]}\n\n{stage_list(geometry)}" for geometry in INDEX)
    if name == "project.py":
        return settings_table(Configuration, without=set(CHAIN))
    stage = CHAIN[name]
    parts = [settings_table(stage.settings), facts_table(stage)]
    if stage.outputs:
        axes = any(each.axes for each in stage.outputs)
        rows = [(f"`{each.name}`", each.dtype, *[each.axes] * axes, each.unit, each.meaning) for each in stage.outputs]
        heading = ("array", "type", *["axes"] * axes, "unit", "meaning")
        parts += [f"Arrays of `{stage.store}`:", table(heading, rows)]
    if any(limit.stated for limit in stage.limits):
        parts += [
            "A result beyond one of these limits stops the run, unless `allow` names the limit:",
            limits_table(stage),
        ]
    return "\n\n".join(parts)


def table(heading: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A markdown table; bars inside cells are escaped."""
    lines = [heading, ("---",) * len(heading), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def settings_table(model: Any, without: set[str] = frozenset()) -> str:
    """Every setting of a model, those of its blocks under dotted names: values, default, meaning."""
    schema = model.model_json_schema()
    rows = [row for row in _rows(schema, schema.get("$defs", {}), "") if row[0].strip("`") not in without]
    return table(("setting", "values", "default", "meaning"), rows)


def _rows(block: Mapping[str, Any], known: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, ...]]:
    for name, field in block["properties"].items():
        if "$ref" in field and field["$ref"].endswith("Settings") and prefix == "" and name in CHAIN:
            continue
        default = _default(field["default"]) if "default" in field else "required"
        if isinstance(field.get("default"), dict) and field["default"] and list(_blocks(field, known, "")):
            default = "as below" if "additionalProperties" not in field else default
        yield (
            f"`{prefix}{name}`",
            _values(field, known),
            default,
            html.escape(field.get("description", ""), quote=False),
        )
        for path, inner in _blocks(field, known, f"{prefix}{name}"):
            yield from _rows(inner, known, f"{path}.")


def _blocks(field: Mapping[str, Any], known: Mapping[str, Any], path: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Blocks of settings inside a field, with their dotted paths: `[]` is each of a list, `NAME` each of a block."""
    if "$ref" in field:
        yield path, known[field["$ref"].rpartition("/")[2]]
    for each in (*field.get("anyOf", ()), *field.get("oneOf", ())):
        yield from _blocks(each, known, path)
    if field.get("type") == "array" and isinstance(field.get("items"), dict):
        yield from _blocks(field["items"], known, f"{path}[]")
    if isinstance(field.get("additionalProperties"), dict):
        yield from _blocks(field["additionalProperties"], known, f"{path}.NAME")


def _values(field: Mapping[str, Any], known: Mapping[str, Any]) -> str:
    """What a setting may be, in words."""
    several = field.get("anyOf") or field.get("oneOf")
    if several:
        return " or ".join(dict.fromkeys(_values(each, known) for each in several))
    if "$ref" in field:
        return "a block"
    if "enum" in field or "const" in field:
        return ", ".join(f"`{_plain(value)}`" for value in field.get("enum", [field.get("const")]))
    kind = field.get("type")
    if kind == "array":
        items = _values(field["items"], known) if isinstance(field.get("items"), dict) else "values"
        return {"a block": "a list of blocks", "text": "a list of texts"}.get(items, f"a list of {items}")
    if kind == "object":
        items = field.get("additionalProperties")
        of = _values(items, known) if isinstance(items, dict) else "values"
        return f"names, each with {of}"
    words = {"number": "number", "integer": "integer", "boolean": "`true`, `false`", "string": "text", "null": "`null`"}
    return words.get(kind or "", "any") + _bounds(field)


def _bounds(field: Mapping[str, Any]) -> str:
    upper = "maximum" in field or "exclusiveMaximum" in field
    least = "from" if upper else "of at least"
    words = {"minimum": least, "exclusiveMinimum": "above", "maximum": "to", "exclusiveMaximum": "below"}
    return "".join(f" {word} {field[key]:,.10g}" for key, word in words.items() if key in field)


def _plain(value: Any) -> str:
    return yaml.safe_dump(value, default_flow_style=True, width=10_000).removesuffix("...\n").strip()


def _default(value: Any) -> str:
    if value in ("", [], {}):
        return "empty"
    text = _plain(value)
    return f"`{text}`" if len(text) <= 120 else f"{len(value)} of them; see `./nishiki schema`"


def facts_table(stage: Stage) -> str:
    """What a stage needs, makes and costs."""
    settings = {name: each.settings() for name, each in CHAIN.items()}
    own = settings[stage.name]
    wanted = tuple(name for name in stage.optional_inputs(own) if name not in stage.requires)
    read = [PARTS[name] for name in _looked_at(stage, settings)]
    rows = [
        ("captures", GEOMETRIES.get(stage.geometry or "", "all")),
        ("asked for as", f"`{stage.asked_as}`" if stage.name != "ingest" else "(always runs)"),
        ("needs", _links(stage.requires)),
        ("uses, where the capture has what they need", _links(wanted)),
        ("shows, where they run anyway", _links(stage.uses)),
        ("reads of the capture", ", ".join(read)),
        ("channels", "all are read" if stage.needs_colour else ""),
        ("left out", _left_out(stage)),
        ("files linked into `current/`", ", ".join(f"`{name}`" for name in stage.deliverables)),
        ("packages", ", ".join(f"{name}{_extra(name)}" for name in stage.libraries)),
        ("cost", _cost(stage)),
    ]
    return table(("", ""), [row for row in rows if row[1]])


def _links(names: tuple[str, ...]) -> str:
    return ", ".join(f"[{name}]({name}.md)" for name in names)


def _extra(package: str) -> str:
    extra = EXTRAS.get(package)
    return f" (extra `{extra}`)" if extra else ""


def _looked_at(stage: Stage, settings: Mapping[str, Any]) -> tuple[str, ...]:
    facts = EXAMPLES[stage.geometry or "plane"]
    return tuple(stage.capture_parts(facts, settings, PRODUCTS))


def _left_out(stage: Stage) -> str:
    """The reason why a scene without anything special would not have the stage; empty where every scene has it."""
    bare = SceneFacts("", (), (), 3, 1, False, False, "", geometry=stage.geometry or "plane")
    reason = stage.missing_inputs(bare, stage.settings())
    return f"where {reason}" if reason else ""


def _cost(stage: Stage) -> str:
    geometry = stage.geometry or "plane"
    facts = EXAMPLES[geometry]
    cost, pixels = stage.cost(facts), facts.pixels
    samples = pixels * facts.observations
    memory, seconds = cost.memory_mb(pixels, samples, tile_mib=128), cost.processor_seconds(pixels, samples)
    limits = f"at most {memory:,.0f} MiB and {seconds:,.0f} s of processor time for {EXAMPLE_WORDS[geometry]}"
    threads = f"{stage.threads} threads" if stage.threads > 1 else "1 thread"
    divided = "; can be divided over several jobs" if stage.scatter else ""
    return f"{limits}, {threads}{divided}"


def limits_table(stage: Stage) -> str:
    """Figures of the result beyond which the run stops."""
    rows = [
        (f"`{limit.name}`", limit.meaning, limit.stated, limit.why, limit.remedy)
        for limit in stage.limits
        if limit.stated
    ]
    return table(("limit", "of", "is", "reason", "remedy"), rows)


def stage_list(geometry: str) -> str:
    """Stages of one kind of capture, in the order of the flow."""
    rows = [
        (
            f"[{name}]({name}.md)",
            stage.does,
            f"`{stage.asked_as}`" if name != "ingest" else "",
            _cost_short(stage, geometry),
        )
        for name, stage in chain_of(geometry).items()
    ]
    return table(("stage", "does", "asked for as", f"most processor time for {EXAMPLE_WORDS[geometry]}, s"), rows)


def _cost_short(stage: Stage, geometry: str) -> str:
    facts = EXAMPLES[geometry]
    return f"{stage.cost(facts).processor_seconds(facts.pixels, facts.pixels * facts.observations):,.0f}"
