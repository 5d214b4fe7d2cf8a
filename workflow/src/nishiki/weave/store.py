"""Store the weave model: `weave.json`, one entry a region, and the pictures and curves made from it."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from nishiki.brdf.cloth.store import load_brdf
from nishiki.errors import UserError
from nishiki.weave.fit import Plane, WeaveFit, WeaveModel
from nishiki.weave.yarn_search import YarnSearch, parameters_of
from nishiki.weave.yarn_weave import InterlacedYarns

NAME = "weave.json"
FORMAT = 1  # of the file; readers refuse others


def describe(
    fit: WeaveFit, planes: tuple[Plane, Plane], *, weave: str, harness: int, yarns: dict | None = None
) -> dict:
    """Describe one region: sections, parameters, intervals, curves of the fit beside the measured values.

    yarns : what is known of the interlaced yarns, see `describe_yarns`.
    """
    model = fit.model
    found: dict = {"yarns": yarns, "weave": weave, "harness": harness, "reading": model.reading}
    found |= {"weft": model.weft.as_dict(), "warp": model.warp.as_dict()}
    found |= {"a_weft": model.a_weft, "a_warp": model.a_warp, "index": model.index}
    found |= {"k_s": model.k_s.tolist(), "k_d": model.k_d.tolist(), "rms_rel": fit.rms_rel, "variance": fit.variance}
    return found | {
        "intervals": {name: list(ends) for name, ends in fit.intervals.items()},
        "identifiability": asdict(fit.identifiability),
        "at_bounds": fit.at_bounds,
        "curves": {name: curves(model, name, plane) for name, plane in zip(("weft", "warp"), planes, strict=True)},
    }


def describe_yarns(search: YarnSearch, *, confidence: float) -> dict:
    """Describe the weave of elliptical yarns: binding, equally good bindings, parameters, ranking."""
    best = search.best
    names = ("weave", "harness", "step", "over", "under", "together")
    return {
        **{name: getattr(best.binding, name) for name in names},
        "alike": [str(binding) for binding in search.alike],
        "ranking": [{"binding": str(binding), "cost": round(cost, 2)} for binding, cost in search.ranking],
        "rms_rel": best.rms_rel,
        "variation": best.variation,
        "determined": best.explains,
        "parameters": parameters_of(search, confidence=confidence),
    }


def curves(model: WeaveModel, name: str, plane: Plane) -> dict:
    """Return measured and fitted reflectance of one plane, mean over channels: degrees, sr^-1."""
    gloss, body = model.parts(name, plane.theta_r)
    return {
        "theta_r_deg": np.round(np.degrees(plane.theta_r), 4).tolist(),
        "measured": plane.mean.tolist(),
        "sigma": plane.sigma.tolist(),
        "gloss": gloss.mean(axis=-1).tolist(),
        "body": body.mean(axis=-1).tolist(),
        "interpolated": not plane.measured,
    }


def yarns_file(region: str) -> str:
    """Return the name of the file that holds a region's interlaced yarns as a reflection model."""
    return f"yarns_{region}.npz"


def write_weave(folder: Path, regions: dict[str, dict]) -> None:
    """Write the entries of `describe` by region; the first is the default."""
    text = json.dumps({"format": FORMAT, "regions": regions}, indent=1, allow_nan=False)
    (Path(folder) / NAME).write_text(text + "\n")


def read_yarns(folder: Path | str, region: str | int = 0) -> tuple[InterlacedYarns, dict] | None:
    """Read the interlaced yarns of a region as an uncorrected BRDF, and facts of their fit; None without.

    region : name, or number in order. UserError where the file is missing, of another format, or the region.
    """
    path = Path(folder) / NAME
    try:
        stored = json.loads(path.read_text())
        name = list(stored["regions"])[region] if isinstance(region, int) else region
        found = stored["regions"][name]["yarns"]
    except (OSError, ValueError, KeyError, IndexError, TypeError) as e:
        raise UserError(f"{path}: expected a weave model of region {region!r} ({e!r}); run weave first") from None
    if stored.get("format") != FORMAT:
        raise UserError(f"{path}: expected format {FORMAT}, found {stored.get('format')}; run weave again")
    if not found:
        return None
    facts = {"rms_rel_normal": found["rms_rel"], "binding": found["alike"][0], "determined": found["determined"]}
    return load_brdf(Path(folder) / yarns_file(name)), facts
