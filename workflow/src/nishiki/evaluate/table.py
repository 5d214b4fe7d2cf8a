"""The evaluation as rows of one flat table, for people and spreadsheets."""

from typing import Any

COLUMNS = ("subject", "case", "pixels_of", "figure", "value", "unit", "pixels")
_FIGURES = ("mean", "median", "p90")


def rows_of(evaluation: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows with the keys `COLUMNS`; figures that could not be measured have an empty value."""
    rows: list[dict[str, Any]] = []
    if normals := evaluation.get("normals"):
        for name in ("inside", "estimated", "unflagged", "flagged"):
            rows += _summary("normals", "angle to truth", name, normals[name], "degrees")
        for part in normals["by_slope"]:
            name = f"slope {part['from_deg']:g} to {part['to_deg']:g} degrees"
            rows += _summary("normals", "angle to truth", name, part, "degrees")
    if height := evaluation.get("height"):
        for figure in ("rms", "p90", "worst", "relief_rms"):
            rows.append(
                _row("height", "less a plane", "estimated", figure, height[figure], height["unit"], height["pixels"])
            )
    if reflectance := evaluation.get("reflectance"):
        rows += _summary("reflectance", "rms over the bands", "estimated", reflectance["rmse"], "reflectance")
        for name, part in reflectance["de00"].items():
            rows += _summary("reflectance", f"under {name}", "estimated", part, "CIEDE2000")
    for light in evaluation.get("lights", ()):
        rows += _light(light)
    return rows


def _light(light: dict[str, Any]) -> list[dict[str, Any]]:
    rows = []
    parts = {"all": light, **light["by_class"]}
    for name, part in parts.items():
        subject = f"light {light['name']}"
        rows += _summary(subject, "against the photograph", name, part["de00"], "CIEDE2000")
        for figure in ("psnr_linear_db", "psnr_coded_db"):
            pixels = part["de00"]["count"]
            rows.append(_row(subject, "against the photograph", name, figure[:-3], part[figure], "dB", pixels))
    for case, part in (light.get("truth") or {}).items():
        rows += _summary(f"light {light['name']}", f"against truth, {case}", "all", part["de00"], "CIEDE2000")
        for name, summary in part["by_class"].items():
            rows += _summary(f"light {light['name']}", f"against truth, {case}", name, summary, "CIEDE2000")
    return rows


def _summary(subject: str, case: str, pixels_of: str, summary: dict[str, Any], unit: str) -> list[dict[str, Any]]:
    return [_row(subject, case, pixels_of, figure, summary[figure], unit, summary["count"]) for figure in _FIGURES]


def _row(*values: Any) -> dict[str, Any]:
    row = dict(zip(COLUMNS, values, strict=True))
    row["value"] = "" if row["value"] is None else f"{row['value']:.6g}"
    return row
