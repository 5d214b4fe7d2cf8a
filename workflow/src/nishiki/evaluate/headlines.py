"""The few figures of an evaluation that belong in a list of results."""

from typing import Any


def headlines(evaluation: dict[str, Any]) -> dict[str, Any]:
    """Flat figures from a whole evaluation: what the artifact's manifest and the report's first lines show."""
    figures: dict[str, Any] = {"lights": [light["name"] for light in evaluation["lights"]]}
    overall = evaluation["overall"]
    if evaluation["lights"]:
        figures |= {
            "relighting_de00_mean": overall["de00"]["mean"],
            "relighting_de00_p90": overall["de00"]["p90"],
            "relighting_psnr_db": {light["name"]: light["psnr_coded_db"] for light in evaluation["lights"]},
            "levels": overall["levels"],
        }
        against = [light["truth"]["lamp"]["de00"] for light in evaluation["lights"] if light.get("truth")]
        if against:
            figures["relighting_truth_de00_mean"] = {
                light["name"]: light["truth"]["lamp"]["de00"]["mean"]
                for light in evaluation["lights"]
                if light.get("truth")
            }
    if normals := evaluation.get("normals"):
        figures |= {f"normals_{name}_deg": normals["estimated"][name] for name in ("mean", "median", "p90")}
        figures["normals_inside_mean_deg"] = normals["inside"]["mean"]
    if height := evaluation.get("height"):
        figures |= {"height_rms_mm": height["rms"], "relief_rms_mm": height["relief_rms"]}
    if reflectance := evaluation.get("reflectance"):
        figures["reflectance_rmse_mean"] = reflectance["rmse"]["mean"]
        figures |= {f"reflectance_de00_{name}_mean": part["mean"] for name, part in reflectance["de00"].items()}
    return figures
