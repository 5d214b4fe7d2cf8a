"""Print results as short texts in prompts and notebooks."""

from collections.abc import Mapping
from html import escape


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
