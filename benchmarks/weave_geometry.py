"""Weave geometry of path-traced cloths: what the stage finds against what the cloth is.

    python benchmarks/weave_geometry.py FOLDER [--cloths NAME ...]

FOLDER: made by path_traced_cloth.py. One JSON object a line and method: `yarns` (elliptical yarns over the hemisphere,
every harness and step; the default) and the sections in the planes of weft and warp with the number of yarns searched,
`shaded` and `paper` (Takeda and Tanaka). Keys: cloth, use (tuned, unseen), method, harness, true_harness, alike
(weaves that the method does not tell apart), cpu_s, values {name: [true, found, low, high]} and within_10 of 10: the
harness, mean and 90th percentile of the slopes in both planes over what is seen from above, share of the weft, aspects
of both yarns, width of a warp yarn over its spacing, ratio of the spacings. What a method does not give or calls not
determined counts as missed.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))
import _project  # noqa: F401
from nishiki.brdf.cloth.yarn_fit import Measured
from nishiki.capture.goniometer_tables import read_table
from nishiki.goniometry.directions import unit
from nishiki.goniometry.hemisphere import complete
from nishiki.goniometry.table import ReflectanceSet
from nishiki.weave.fit import fit_weave, planes_of
from nishiki.weave.yarn_search import parameters_of, search_yarns
from nishiki.weave.yarn_weave import bindings

SLOPES = ("mean_slope_weft", "p90_slope_weft", "mean_slope_warp", "p90_slope_warp")
YARNS = ("weft_share", "aspect_warp", "aspect_weft", "fill_warp", "spacing_ratio")
WITHIN = 0.1


def read(folder: Path, name: str) -> tuple[ReflectanceSet, dict]:
    """Reflectances and truth of one cloth."""
    table = read_table(folder / name / "reflectances.csv", name)
    directions = (unit(*np.radians(angles).T) for angles in (table.incident_deg, table.outgoing_deg))
    truth = json.loads((folder / f"{name}-truth.json").read_text())
    truth |= {key: truth[f"{key}_deg"] for key in SLOPES} | {"fill_warp": truth["cloth"]["warp"]["fill"]}
    return complete(ReflectanceSet.of(*directions, table.values))[0], truth


def of_sections(measured: ReflectanceSet, reading: str) -> dict:
    """Harness and slopes of the fitted sections; intervals are not known of slopes."""
    fit = fit_weave(*planes_of(measured), reading=reading, confidence=None)
    values = {}
    for plane, section in (("weft", fit.model.weft), ("warp", fit.model.warp)):
        points, _ = section.profile(4000)
        across, up = np.diff(points, axis=0).T
        angle, order = np.degrees(np.arctan2(np.abs(up), across)), np.argsort(np.abs(up) / np.maximum(across, 1e-12))
        share = np.cumsum(across[order]) / across.sum()
        mean, tenth = float(angle @ across / across.sum()), float(angle[order][np.searchsorted(share, 0.9)])
        values |= {f"mean_slope_{plane}": [mean, None, None], f"p90_slope_{plane}": [tenth, None, None]}
    return {"harness": round(fit.model.weft.n) + 1, "alike": None, "found": values}


def of_yarns(measured: ReflectanceSet) -> dict:
    """The default."""
    search = search_yarns(Measured.of(measured), bindings())
    numbers = parameters_of(search, confidence=0.95)
    values = {
        name: [numbers[name][key] for key in ("value", "low", "high")]
        for name in (*SLOPES, *YARNS)
        if numbers[name]["determined"]
    }
    return {"harness": search.best.binding.harness, "alike": [str(one) for one in search.alike], "found": values}


def main() -> None:
    """Arguments in, lines out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cloths", nargs="+")
    arguments = parser.parse_args()
    names = arguments.cloths or sorted(path.parent.name for path in arguments.folder.glob("*/reflectances.csv"))
    for name in names:
        measured, truth = read(arguments.folder, name)
        for method in ("yarns", "shaded", "paper"):
            start = time.process_time()
            result = of_yarns(measured) if method == "yarns" else of_sections(measured, method)
            seconds = time.process_time() - start
            found = result.pop("found")
            values = {key: [truth[key], *(found.get(key) or [None] * 3)] for key in (*SLOPES, *YARNS)}
            right = sum(v[1] is not None and abs(v[1] / v[0] - 1) <= WITHIN for v in values.values())
            values = {key: [None if one is None else round(one, 3) for one in row] for key, row in values.items()}
            line = {"cloth": name, "use": truth["use"], "method": method, "true_harness": truth["harness"], **result}
            right += result["harness"] == truth["harness"]
            print(json.dumps({**line, "within_10": right, "cpu_s": round(seconds, 1), "values": values}), flush=True)


if __name__ == "__main__":
    main()
