"""The part of the page on the capture: facts, lights, exposure, warnings."""

from typing import Any

import numpy as np

from nishiki.report.svg import bars, lights_plot

FACTS = (
    ("object_id", "Object"),
    ("creator", "Creator"),
    ("date", "Date"),
    ("rights", "Rights"),
    ("notes", "Notes"),
)
LEAST_SATURATED = 1e-4
"""Share of the object below which a light's saturation is not worth a bar."""


def capture_section(
    diagnostics: dict[str, Any],
    *,
    lights: list[str],
    roles: list[str],
    directions: np.ndarray,
    held_out: list[str],
    channels: list[str],
    pitch_mm: float | None,
) -> dict[str, Any]:
    """Content of the section. diagnostics : of the ingest stage; directions : (lights, 3)."""
    kinds = [kind_of(name, role, held_out) for name, role in zip(lights, roles, strict=True)]
    rows, columns = diagnostics["rows"], diagnostics["columns"]
    return {
        "facts": _facts(diagnostics, rows, columns, channels, pitch_mm, kinds),
        "lights_svg": lights_plot(directions, lights, kinds),
        "kinds": sorted(set(kinds)),
        "exposure": _exposure(diagnostics, lights, kinds, directions),
        "saturation_svg": _saturation(diagnostics, lights),
        "white": bool(diagnostics["white_level"]),
        "warnings": list(diagnostics["warnings"]),
        "defects": diagnostics["defects"],
    }


def kind_of(name: str, role: str, held_out: list[str]) -> str:
    """sample | check | held out."""
    return "check" if role == "check" else ("held out" if name in held_out else "sample")


def _facts(diagnostics, rows, columns, channels, pitch_mm, kinds) -> list[tuple[str, str]]:
    capture = diagnostics["capture"]
    facts = [(label, str(capture[key])) for key, label in FACTS if capture.get(key)]
    camera = capture["camera"]
    encoding = {"linear": "linear values", "srgb": "sRGB-coded values, not linear"}.get(camera["encoding"], "")
    parts = [camera.get("model"), f"{camera['bits']} bits" if camera.get("bits") else None, encoding]
    facts.append(("Camera", ", ".join(part for part in parts if part)))
    size = f"{columns} × {rows} pixels"
    if pitch_mm:
        size += f" of {pitch_mm:g} mm, {columns * pitch_mm:.0f} × {rows * pitch_mm:.0f} mm"
    facts.append(("Picture", size + _cropped(diagnostics)))
    share = diagnostics["mask_pixels"] / (rows * columns)
    if share < 1:
        facts.append(("Object mask", f"{100 * share:.1f} % of the picture"))
    facts.append(("Channels", f"{len(channels)}: {', '.join(channels)} ({diagnostics['dtype']})"))
    count = {kind: kinds.count(kind) for kind in ("sample", "check", "held out")}
    used = f"{count['sample']} used for the fits"
    words = {"check": "kept from them to check the result", "held out": "held out of them and predicted instead"}
    kept = [f"{count[kind]} {text}" for kind, text in words.items() if count[kind]]
    lamp = f"; spectrum {_named(capture['illuminant'])}" if capture.get("illuminant") else "; spectrum not known"
    facts.append(("Lights", f"{len(kinds)}: {', '.join([used, *kept])}{lamp}"))
    return facts


def _cropped(diagnostics) -> str:
    """Where the picture lies in the photographs, where it is a part of them."""
    (row, column, rows, columns), whole = diagnostics["region"], diagnostics["photograph"]
    if [rows, columns] == list(whole):
        return ""
    why = "cropped to the object mask" if diagnostics["capture"].get("mask") else "region of interest"
    place = f"columns {column} to {column + columns - 1}, rows {row} to {row + rows - 1}"
    return f"; {why}: {place} of {whole[1]} × {whole[0]}"


def _named(illuminant: str) -> str:
    return f"in {illuminant}" if illuminant.endswith(".csv") else f"taken as CIE {illuminant}"


def _exposure(diagnostics, lights, kinds, directions) -> list[dict[str, Any]]:
    """One row a light: angles, saturated and dark shares, level and evenness of the white board."""
    rows = []
    for j, (name, kind) in enumerate(zip(lights, kinds, strict=True)):
        x, y, z = (float(v) for v in directions[j])
        rows.append(
            {
                "name": name,
                "kind": kind,
                "incidence": float(np.degrees(np.arctan2(np.hypot(x, y), z))),
                "azimuth": float(np.degrees(np.arctan2(y, x))) if np.hypot(x, y) > 1e-9 else None,
                "saturated": 100 * diagnostics["saturated"][j],
                "dark": 100 * diagnostics["dark"][j],
                "not_finite": diagnostics["not_finite"][j],
                "white_level": _at(diagnostics["white_level"], j, 100),
                "white_evenness": _at(diagnostics["white_uniformity"], j, 100),
            }
        )
    return rows


def _at(values: list, j: int, factor: float) -> float | None:
    return factor * values[j] if j < len(values) and values[j] is not None else None


def _saturation(diagnostics, lights) -> str:
    """Bars of the saturated share of the lights that have any, the largest twelve."""
    shares = sorted(zip(diagnostics["saturated"], lights, strict=True), key=lambda pair: (-pair[0], pair[1]))
    shown = [(100 * share, name) for share, name in shares if share >= LEAST_SATURATED][:12]
    if not shown:
        return ""
    values, names = zip(*shown, strict=True)
    return bars(list(values), list(names), title="saturated share of the object by light", unit="%")
