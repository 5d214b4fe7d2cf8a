"""Conditions and flags of every stage, beside the limits at which a run would have stopped."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from nishiki.contract.limits import readings


def conditions(manifests: Iterable[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Rows (stage, meaning, value, limit, state) of the artifacts of these manifests, in their order.

    state: '' without a limit, else within | beyond, allowed (a run stops where a result is beyond and not allowed).
    """
    rows = []
    for manifest in manifests:
        allow = manifest["settings"].get("allow", ())
        for each in readings(manifest["stage"], manifest["diagnostics"], allow):
            state = "" if not each.limit.stated else "beyond, allowed" if each.beyond else "within"
            rows.append(
                {
                    "stage": manifest["stage"],
                    "meaning": each.limit.meaning,
                    "value": f"{each.value:.4g}",
                    "limit": each.limit.stated or "none",
                    "state": state,
                }
            )
    return rows
