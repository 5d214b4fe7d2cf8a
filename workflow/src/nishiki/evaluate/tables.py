"""Write the files of every evaluation: all figures, a table of them, and the few for a list."""

import csv
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from nishiki.artifacts.provenance import truth_digest
from nishiki.artifacts.stage import Context
from nishiki.errors import UserError


def write_tables(context: Context, evaluation: dict, columns: Sequence[str], rows: Iterable[dict]) -> None:
    """Write evaluation.json, with everything, and evaluation.csv, a table of these rows."""
    text = json.dumps(evaluation, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"
    context.output.path("evaluation.json").write_text(text, encoding="utf-8")
    with context.output.path("evaluation.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, columns, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def planned_truth(context: Context) -> Path | None:
    """Find the truth of a capture, None where none is given; UserError where it differs from the planned one."""
    if context.truth is None:
        return None
    path, planned = Path(context.truth), context.settings.truth_sha256
    digest = truth_digest(path)
    if digest != planned:
        raise UserError(
            f"{path}: expected the truth with the digest {planned or '(none)'} (setting truth_sha256), found {digest}. "
            "Remedy: run again, so that the plan sees the truth as it is now"
        )
    return path


COLUMNS = ("subject", "case", "pixels_of", "figure", "value", "unit", "pixels")


def rows_of(evaluation: dict[str, Any]) -> list[dict[str, Any]]:
    """Return rows with the keys `COLUMNS`; figures without a measurement have an empty value."""
    rows: list[dict[str, Any]] = []
    if normals := evaluation.get("normals"):
        for name in ("inside", "estimated", "unflagged", "flagged"):
            rows += _summary("normals", "angle to truth", name, normals[name], "degrees")
        for part in normals["by_slope"]:
            name = f"slope {part['from_deg']:g} to {part['to_deg']:g} degrees"
            rows += _summary("normals", "angle to truth", name, part, "degrees")
    if height := evaluation.get("height"):
        for figure in ("rms", "p90", "worst", "relief_rms"):
            told = height[figure], height["unit"], height["pixels"]
            rows.append(_row("height", "less a plane", "estimated", figure, *told))
    if reflectance := evaluation.get("reflectance"):
        rows += _summary("reflectance", "rms over the bands", "estimated", reflectance["rmse"], "reflectance")
        for name, part in reflectance["de00"].items():
            rows += _summary("reflectance", f"under {name}", "estimated", part, "CIEDE2000")
    for light in evaluation.get("lights", ()):
        rows += _light(light)
    return rows


def _light(light: dict[str, Any]) -> list[dict[str, Any]]:
    rows, subject, case = [], f"light {light['name']}", "against the photograph"
    for name, part in {"all": light, **light["by_class"]}.items():
        rows += _summary(subject, case, name, part["de00"], "CIEDE2000")
        for figure in ("psnr_linear", "psnr_coded"):
            rows.append(_row(subject, case, name, figure, part[f"{figure}_db"], "dB", part["de00"]["count"]))
    for case, part in (light.get("truth") or {}).items():
        for name, summary in {"all": part["de00"], **part["by_class"]}.items():
            rows += _summary(subject, f"against truth, {case}", name, summary, "CIEDE2000")
    return rows


def _summary(subject: str, case: str, pixels_of: str, summary: dict[str, Any], unit: str) -> list[dict[str, Any]]:
    return [
        _row(subject, case, pixels_of, figure, summary[figure], unit, summary["count"])
        for figure in ("mean", "median", "p90")
    ]


def _row(*values: Any) -> dict[str, Any]:
    row = dict(zip(COLUMNS, values, strict=True))
    row["value"] = "" if row["value"] is None else f"{row['value']:.6g}"
    return row


def headlines(evaluation: dict[str, Any]) -> dict[str, Any]:
    """Select flat figures from a whole evaluation, for the artifact's manifest and the report's first lines."""
    figures: dict[str, Any] = {"lights": [light["name"] for light in evaluation["lights"]]}
    overall = evaluation["overall"]
    if evaluation["lights"]:
        figures |= {
            "relighting_de00_mean": overall["de00"]["mean"],
            "relighting_de00_p90": overall["de00"]["p90"],
            "relighting_psnr_db": {light["name"]: light["psnr_coded_db"] for light in evaluation["lights"]},
            "levels": overall["levels"],
        }
        judged = {light["name"]: light["truth"]["lamp"]["de00"] for light in evaluation["lights"] if light.get("truth")}
        if judged:
            figures["relighting_truth_de00_mean"] = {name: part["mean"] for name, part in judged.items()}
    if normals := evaluation.get("normals"):
        figures |= {f"normals_{name}_deg": normals["estimated"][name] for name in ("mean", "median", "p90")}
        figures["normals_inside_mean_deg"] = normals["inside"]["mean"]
    if height := evaluation.get("height"):
        figures |= {"height_rms_mm": height["rms"], "relief_rms_mm": height["relief_rms"]}
    if reflectance := evaluation.get("reflectance"):
        figures["reflectance_rmse_mean"] = reflectance["rmse"]["mean"]
        figures |= {f"reflectance_de00_{name}_mean": part["mean"] for name, part in reflectance["de00"].items()}
    return figures
