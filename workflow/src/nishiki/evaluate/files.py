"""The files that every evaluation leaves, and the truth that it may compare with."""

import csv
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from nishiki.artifacts.provenance import truth_digest
from nishiki.artifacts.stage import Context
from nishiki.errors import UserError


def write_tables(context: Context, evaluation: dict, columns: Sequence[str], rows: Iterable[dict]) -> None:
    """Write evaluation.json, which holds everything, and evaluation.csv, a table of these rows."""
    text = json.dumps(evaluation, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"
    context.output.path("evaluation.json").write_text(text, encoding="utf-8")
    with context.output.path("evaluation.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, columns, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def planned_truth(context: Context) -> Path | None:
    """Find the truth of a capture, None where none is given; UserError where it is not the one that was planned."""
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
