"""Mean, median, 90th percentile and largest of a set of errors."""

from dataclasses import asdict, dataclass

import numpy as np


@dataclass(frozen=True)
class Summary:
    """Errors of a set of pixels; the figures are None where the set is empty.

    count: pixels in the set; dropped: values that were not finite and are in no figure.
    """

    count: int
    mean: float | None
    median: float | None
    p90: float | None
    worst: float | None
    dropped: int = 0

    def as_dict(self) -> dict:
        """Plain values, for JSON."""
        return asdict(self)


def summarise(values: np.ndarray, *, where: np.ndarray | None = None) -> Summary:
    """Summary of an array of errors, any shape; `where` (same shape, bool) selects the pixels that count.

    Percentiles interpolate linearly between ranks. The sum is taken in float64.
    """
    chosen = np.asarray(values).ravel() if where is None else np.asarray(values)[np.asarray(where)]
    finite = np.isfinite(chosen)
    dropped = int(chosen.size - np.count_nonzero(finite))
    if dropped:
        chosen = chosen[finite]
    if chosen.size == 0:
        return Summary(0, None, None, None, None, dropped)
    median, p90 = np.percentile(chosen, (50, 90))
    mean = np.mean(chosen, dtype=np.float64)
    return Summary(chosen.size, float(mean), float(median), float(p90), float(chosen.max()), dropped)
