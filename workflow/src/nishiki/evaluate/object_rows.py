"""The rows and figures of an evaluation: each view by each way of making it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np

from nishiki.evaluate.object_quality import Difference, difference, structural_similarity, summary

DECODED, MODEL, INTERPOLATED, SLOT = "decoded", "model_alone", "interpolated", "slot"
COLUMNS = (
    "view", "light", "left_out", "picture", "against", "psnr_db", "covered_psnr_db", "similarity", "pixels",
    "uncovered_pixels", "superfluous_pixels",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One picture against one counterpart.  picture: DECODED, MODEL, INTERPOLATED (a left-out view from its
    neighbours' residual) or SLOT (from what the decoder filled into its own place); against: photograph | truth."""

    view: str
    light: str
    left_out: bool
    picture: str
    against: str
    judged: Difference
    covered: Difference
    similarity: float | None

    def as_dict(self) -> dict:
        """Plain data with the keys `COLUMNS`."""
        values = {name: value for name, value in asdict(self).items() if name in COLUMNS}
        return {
            **values,
            "psnr_db": self.judged.psnr_db,
            "covered_psnr_db": self.covered.psnr_db,
            "similarity": self.similarity,
            "pixels": self.judged.pixels,
            "uncovered_pixels": self.judged.uncovered,
            "superfluous_pixels": self.judged.superfluous,
        }


def compare(
    coded: np.ndarray,
    counterpart: np.ndarray,
    *,
    outline: np.ndarray,
    covered: np.ndarray,
    valid: np.ndarray,
    similarity: bool,
    **named,
) -> Row:
    """A row over outline and rendered surface together (see `difference`); its figure `covered` is over the pixels of
    both. named: the other fields of the row."""
    both = outline & covered
    return Row(
        judged=difference(coded, counterpart, outline, covered, valid),
        covered=difference(coded, counterpart, both, both, valid),
        similarity=structural_similarity(coded, counterpart, (outline | covered) & valid) if similarity else None,
        **named,
    )


def figures(rows: Iterable[Row]) -> dict:
    """Summaries by kind of picture: captured views, the model alone, left-out views both ways, and against truth."""
    rows = list(rows)
    summaries = {}
    for name, picture, left_out, against in (
        ("captured", DECODED, False, "photograph"),
        ("model_alone", MODEL, False, "photograph"),
        ("left_out_interpolated", INTERPOLATED, True, "photograph"),
        ("left_out_slot", SLOT, True, "photograph"),
        ("left_out_model_alone", MODEL, True, "photograph"),
        ("captured_truth", DECODED, False, "truth"),
        ("left_out_interpolated_truth", INTERPOLATED, True, "truth"),
        ("left_out_slot_truth", SLOT, True, "truth"),
        ("photograph_truth", "photograph", False, "truth"),
    ):
        chosen = [r for r in rows if (r.picture, r.left_out, r.against) == (picture, left_out, against)]
        if chosen:
            similarities = [r.similarity for r in chosen if r.similarity is not None]
            summaries[name] = {
                **summary([r.judged for r in chosen]),
                "mean_covered_psnr_db": summary([r.covered for r in chosen])["mean_psnr_db"],
                "mean_similarity": float(np.mean(similarities)) if similarities else None,
            }
    return summaries


def better_prediction(summaries: dict) -> str | None:
    """INTERPOLATED or SLOT, whichever predicts the left-out views better on average; None without left-out views."""
    scores = {
        name: summaries[key]["mean_psnr_db"]
        for name, key in ((INTERPOLATED, "left_out_interpolated"), (SLOT, "left_out_slot"))
        if key in summaries and summaries[key]["mean_psnr_db"] is not None
    }
    return max(scores, key=scores.get) if scores else None
