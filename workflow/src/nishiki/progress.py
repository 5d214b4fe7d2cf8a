"""Print one line of progress on long work, and results as short texts."""

import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from html import escape
from typing import TypeVar

Item = TypeVar("Item")


class Progress:
    """Print the progress of a stage at most every two seconds, on standard error; nothing on short work."""

    def __init__(self, label: str, *, every_s: float = 2.0, stream=None):
        self.label = label
        self.every_s = every_s
        self.stream = stream or sys.stderr
        self._last = time.monotonic()

    def __call__(self, done: int, total: int, what: str) -> None:
        """Tell that `done` of `total` are done, the last being `what`."""
        self.tell(f"{done} of {total}, {what}")

    def tell(self, what: str) -> None:
        """Tell what is being worked on."""
        now = time.monotonic()
        if now - self._last >= self.every_s:
            self._last = now
            print(f"{self.label}: {what}", file=self.stream, flush=True)

    def over(self, items: Iterable[Item], what: str) -> Iterator[Item]:
        """Pass `items` on, telling how many of them are done and how long the rest will take."""
        items = list(items)
        yield from self.through(items, len(items), what)

    def through(self, items: Iterable[Item], total: int, what: str) -> Iterator[Item]:
        """Pass items on like `over` while they are made; `total`: their number."""
        start = last = time.monotonic()
        for done, item in enumerate(items):
            now = time.monotonic()
            if now - last >= self.every_s and done:
                rest = (now - start) / done * (total - done)
                print(f"{self.label}: {what} {done} of {total}, {rest:.0f} s left", file=self.stream, flush=True)
                last = now
            yield item


class Summarised:
    """Show the `diagnostics` of a result in place of its arrays."""

    @property
    def diagnostics(self) -> Mapping[str, object]:
        """Facts of the result by name."""
        raise NotImplementedError

    def __repr__(self) -> str:
        facts = (f"{name}={_short(value)}" for name, value in self.diagnostics.items() if value or value == 0)
        return f"{type(self).__name__}({', '.join(facts)})"

    def _repr_html_(self) -> str:
        rows = (f"<tr><td>{escape(name)}</td><td>{escape(_short(v))}</td></tr>" for name, v in self.diagnostics.items())
        return f"<table><caption>{type(self).__name__}</caption>{''.join(rows)}</table>"


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
