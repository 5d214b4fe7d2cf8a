"""The part of a page that says what was read and what was left out, and why."""

from collections.abc import Mapping
from typing import Any


def left_out_section(left_out: Mapping[str, str], diagnostics: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Content of the section.

    left_out: of the plan, name to reason; diagnostics: of every stage by its name: `read` of ingest says what was read,
    `economy` of any stage what it decided by a measurement (see `nishiki.model_selection.decision`).
    """
    read = diagnostics.get("ingest", {}).get("read")
    return {
        "planned": sorted(left_out.items()),
        "files": _files(read) if read else [],
        "kept": _kept(read) if read else [],
        "decided": [
            _decision(stage, what, entry)
            for stage, told in diagnostics.items()
            for what, entry in (told.get("economy") or {}).items()
        ],
    }


def _files(read: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One row a kind of files, all together last."""
    rows = [*read["files"], {**read["total"], "what": "all files"}]
    return [
        {
            "what": row["what"],
            "read": row["read"],
            "of": row["of"],
            "megabytes_read": row["bytes_read"] / 1e6,
            "megabytes_of": row["bytes_of"] / 1e6,
        }
        for row in rows
    ]


def _kept(read: Mapping[str, Any]) -> list[tuple[str, int, int]]:
    """What was kept of how much: channels, and tiles of a plane."""
    kept = [("channels", *read["channels"])]
    return kept + ([("tiles, bands of rows times lights", *read["tiles"])] if read["tiles"] else [])


def _decision(stage: str, what: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    """A decision of a stage: in words, with the measured value against its limit where something was measured."""
    return {
        "stage": stage,
        "what": what.replace("_", " "),
        **{name: entry.get(name) for name in ("decision", "criterion", "measured", "limit", "loss", "override")},
    }
