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


class Pool:
    """Summary of many maps of errors together, without holding them: memory does not grow with their number.

    Median and percentile come from bins of 0.01 (errors above 200 count as 200 there) and are exact to half a bin;
    mean, count and largest value are exact.
    """

    BIN, END = 0.01, 200.0

    def __init__(self):
        self.bins = np.zeros(round(self.END / self.BIN), np.int64)
        self.count, self.total, self.worst = 0, 0.0, None

    def add(self, values: np.ndarray) -> None:
        """Errors of any shape, >= 0; those that are not finite are left out."""
        for part in np.array_split(np.asarray(values).ravel(), max(1, np.size(values) >> 20)):
            part = part[np.isfinite(part)]
            if part.size:
                places = np.minimum((part / self.BIN).astype(np.int64), self.bins.size - 1)
                self.bins += np.bincount(places, minlength=self.bins.size)
                self.count += part.size
                self.total += float(part.sum(dtype=np.float64))
                self.worst = max(float(part.max()), self.worst or 0.0)

    def summary(self) -> Summary:
        """Figures of everything added so far."""
        if not self.count:
            return Summary(0, None, None, None, None)
        return Summary(self.count, self.total / self.count, self._percentile(50), self._percentile(90), self.worst)

    def _percentile(self, percent: float) -> float:
        below = np.searchsorted(np.cumsum(self.bins), percent / 100 * self.count, side="left")
        return min(round((float(below) + 0.5) * self.BIN, 6), self.worst)
