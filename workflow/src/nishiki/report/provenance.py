"""What the page says of each stage: settings, keys, code, libraries, diagnostics, and what was left out."""

from dataclasses import dataclass
from typing import Any

from nishiki.artifacts.closed import Closed
from nishiki.artifacts.provenance import canonical
from nishiki.report.numbers import plain

PLANNED = ("hold_out", "without", "truth_sha256", "training_sha256", "left_out")
"""Settings that the plan fills in; a user does not write them."""


@dataclass(frozen=True)
class Setting:
    """One setting: its value and default as text, whether they differ, its meaning."""

    name: str
    value: str
    default: str
    changed: bool
    planned: bool
    meaning: str


@dataclass(frozen=True)
class StageRecord:
    """One stage as the page shows it; every text is final."""

    name: str
    does: str
    key: str
    code: str
    settings: tuple[Setting, ...]
    upstream: tuple[tuple[str, str], ...]
    libraries: tuple[tuple[str, str], ...]
    diagnostics: tuple[tuple[str, str], ...]
    files: int
    megabytes: str
    run_file: str


def stage_record(manifest: dict[str, Any], model: type[Closed], does: str) -> StageRecord:
    """Record of a finished stage from its manifest; `model` has the defaults and meanings of its settings."""
    name, key = manifest["stage"], manifest["key"]
    return StageRecord(
        name=name,
        does=does,
        key=key,
        code=manifest.get("code") or "not recorded",
        settings=settings_of(manifest["settings"], model),
        upstream=tuple(
            (other, entry.get("key") or f"sha256 {entry['digest'][:12]}…")
            for other, entry in manifest["upstream"].items()
        ),
        libraries=tuple(sorted(manifest.get("libraries", {}).items())),
        diagnostics=tuple(flat(manifest["diagnostics"])),
        files=len(manifest["files"]),
        megabytes=f"{sum(entry['bytes'] for entry in manifest['files'].values()) / 1e6:.1f}",
        run_file=f"{name}/{key}/run.json",
    )


def settings_of(values: dict[str, Any], model: type[Closed]) -> tuple[Setting, ...]:
    """Settings in the order of the model, with those that differ from the default marked."""
    defaults = model().model_dump(mode="json")
    rows = []
    for name, field in model.model_fields.items():
        value = values.get(name, defaults[name])
        planned = name in PLANNED
        rows.append(
            Setting(
                name=name,
                value=text(value),
                default=text(defaults[name]),
                changed=canonical(value) != canonical(defaults[name]) and not planned,
                planned=planned,
                meaning=field.description or "",
            )
        )
    return tuple(rows)


def flat(values: dict[str, Any], path: str = "") -> list[tuple[str, str]]:
    """Diagnostics as (name, text) lines; blocks become dotted names, long lists are summed up."""
    lines = []
    for name, value in values.items():
        place = f"{path}.{name}" if path else name
        lines += flat(value, place) if isinstance(value, dict) else [(place, text(value))]
    return lines


def text(value: Any, *, longest: int = 160) -> str:
    """A setting or diagnostic as short text."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return plain(value, 6)
    if isinstance(value, dict):
        return shortened(", ".join(f"{key}: {text(item)}" for key, item in value.items()) or "none", longest)
    if isinstance(value, list | tuple):
        return shortened(", ".join(text(item) for item in value) or "none", longest)
    return shortened(str(value), longest) or "(empty)"


def shortened(line: str, longest: int) -> str:
    """A line cut at `longest` characters, with a mark where it was cut."""
    return line if len(line) <= longest else line[: longest - 1] + "…"
