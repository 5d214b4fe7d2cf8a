"""Conditions and flags of every stage, beside the limits at which a run would have stopped."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from nishiki.artifacts.bounds import at_bounds
from nishiki.artifacts.limits import Limit, limit_checks
from nishiki.report.numbers import plain


def conditions(manifests: Iterable[Mapping[str, Any]], limits: Mapping[str, Iterable[Limit]]) -> list[dict[str, str]]:
    """Rows (stage, meaning, value, limit, state) of the artifacts of these manifests, in their order; limits: by stage.

    state: '' without a limit, else within | beyond, allowed (a run stops where a result is beyond and not allowed).
    Last of each stage are the fitted parameters that ended at the end of their range.
    """
    rows = []
    for manifest in manifests:
        allow = manifest["settings"].get("allow", ())
        for each in limit_checks(limits.get(manifest["stage"], ()), manifest["diagnostics"], allow):
            state = "" if not each.limit.stated else "beyond, allowed" if each.beyond else "within"
            rows.append(
                {
                    "stage": manifest["stage"],
                    "meaning": each.limit.meaning,
                    "value": plain(each.value),
                    "limit": _stated(each.limit),
                    "state": state,
                }
            )
        rows += [
            {
                "stage": manifest["stage"],
                "meaning": f"fitted parameter at a bound: {each}",
                "value": "–",
                "limit": "inside its range",
                "state": "at its bound",
            }
            for each in at_bounds(manifest["diagnostics"])
        ]
    return rows


def _stated(limit: Limit) -> str:
    """The limit in words; "none" where a figure is only reported."""
    if limit.most is not None:
        return f"at most {plain(limit.most)}"
    return "none" if limit.least is None else f"at least {plain(limit.least)}"
