"""The part of the page on lights that no fit has seen: prediction beside photograph, and their differences."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from nishiki.evaluate.classes import DIFFUSE, HIGHLIGHT, SHADOW
from nishiki.evaluate.museum import FADGI, ISO_19264
from nishiki.report.colour_map import balance, heat
from nishiki.report.pictures import (
    block_of,
    brightened,
    brightening,
    class_picture,
    colour_picture,
    scalar_picture,
    shrink,
)

SHOWN = 4
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear sRGB, IEC 61966-2-1
LEAST_SIGNED_END = 1.0  # per cent of the white: smaller differences are the camera's noise
LARGEST_DE00 = 10.0
"""End of the scale of difference maps: the same for all lights, so that they can be compared."""
CLASS_KEY = {
    DIFFUSE: ("#a9c0c9", "diffuse"),
    HIGHLIGHT: ("#e3a72f", "highlight in view"),
    SHADOW: ("#3c4657", "shadow"),
}


def chosen(lights: list[dict[str, Any]], count: int = SHOWN) -> list[int]:
    """Which lights to show: all, or evenly through the ranks of their mean difference, best and worst among them."""
    if len(lights) <= count:
        return list(range(len(lights)))
    ranks = sorted(range(len(lights)), key=lambda k: (lights[k]["de00"]["mean"] or 0.0, k))
    places = np.round(np.linspace(0, len(ranks) - 1, count)).astype(int)
    return sorted(ranks[p] for p in places)


def relighting_section(
    evaluation: dict[str, Any], evaluated, previews: dict[int, Any], *, widest: int
) -> dict[str, Any]:
    """Content of the section.

    evaluation : evaluation.json; evaluated : `Maps` of the evaluate stage; previews : light index -> arrays predicted,
    observed (linear sRGB) and inside.
    """
    lights = evaluation["lights"]
    shown = []
    signed = {k: signed_difference(previews[lights[k]["index"]]) for k in chosen(lights)}
    end = signed_end(list(signed.values()))
    for k in chosen(lights):
        light = lights[k]
        pair = previews[light["index"]]
        inside = np.asarray(pair["inside"])
        observed, predicted = (np.asarray(pair[name], np.float32) for name in ("observed", "predicted"))
        factor = brightening(observed[inside])
        name = f"de00_{light['index']:03d}"
        shape = tuple(evaluated.group[name].shape)
        block = block_of(shape[1], widest)
        difference = shrink(lambda rows, name=name: evaluated.read(name, rows), shape, block)
        classes = f"classes_{light['index']:03d}"
        what = shrink(lambda rows, name=classes: _ranked(evaluated.read(name, rows)), shape, block, worst=True)
        shown.append(
            {
                "light": light,
                "note": brightened(factor),
                "photograph": colour_picture(factor * observed, inside=inside),
                "prediction": colour_picture(factor * predicted, inside=inside),
                "difference": scalar_picture(difference, heat(), unit="ΔE00", low=0.0, high=LARGEST_DE00),
                "signed": scalar_picture(signed[k], balance(), unit="% of white", low=-end, high=end),
                "classes": class_picture(what, CLASS_KEY),
            }
        )
    return {
        "shown": shown,
        "lights": lights,
        "overall": evaluation["overall"],
        "how": evaluation["colour"]["how"],
        "lamp": "as if under D65" if evaluation["colour"]["rmse_xyz"] is None else "under the lamp of the capture",
        "classes_from": evaluation["classes_from"],
        "with_truth": any(light.get("truth") for light in lights),
        "cases": sorted({case for light in lights for case in (light.get("truth") or {})}, key=lambda c: c != "lamp"),
        "fadgi": FADGI,
        "iso": ISO_19264,
    }


def signed_difference(pair: Mapping[str, Any]) -> np.ndarray:
    """Luminance of prediction less photograph, per cent of the white, of a preview; NaN outside the object."""
    difference = np.asarray(pair["predicted"], np.float32) - np.asarray(pair["observed"], np.float32)
    return np.where(np.asarray(pair["inside"]), 100 * (difference @ LUMINANCE), np.nan)


def signed_end(maps: list[np.ndarray]) -> float:
    """End of the common scale of signed maps: the 98th percentile of all magnitudes, up to 1, 2 or 5 times 10^n."""
    values = np.concatenate([np.abs(values[np.isfinite(values)]) for values in maps])
    wanted = max(float(np.percentile(values, 98)) if values.size else 0.0, LEAST_SIGNED_END)
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(next(power * step for step in (1, 2, 5, 10) if power * step >= wanted * (1 - 1e-9)))


def _ranked(classes: np.ndarray) -> np.ndarray:
    """Classes as floats, 0 (not compared) as NaN, so that a block takes its gravest."""
    return np.where(classes > 0, classes, np.nan).astype(np.float32)
