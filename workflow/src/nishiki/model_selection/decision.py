"""What a measured decision says of itself, in a stage's diagnostics and in its log."""

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Decision:
    """One thing left out, or kept, because of a measured criterion."""

    what: str  # the name it has in the diagnostics
    decision: str  # what was decided, in words
    criterion: str  # what was measured, in words
    measured: float | None  # its value, None where a setting decided
    limit: float | None  # what it was compared with, None likewise
    loss: str  # what leaving it out costs, with its unit
    override: str  # the setting that decides otherwise

    def as_dict(self) -> dict[str, dict]:
        """Return {subject: plain values}, to be merged into the block `economy` of a stage's diagnostics."""
        named = asdict(self)
        return {named.pop("what"): {name: _plain(value) for name, value in named.items()}}

    def __str__(self) -> str:
        """One line of the log."""
        numbers = ""
        if self.measured is not None:
            numbers = f" ({self.criterion}: {self.measured:.4g}"
            numbers += f", limit {self.limit:.4g})" if self.limit is not None else ")"
        return f"{self.what}: {self.decision}{numbers}; loss: {self.loss}; {self.override}"


def economy(*decisions: Decision | None) -> dict[str, dict]:
    """Build the block `economy` of a stage's diagnostics; None stands for no decision."""
    block: dict[str, dict] = {}
    for decision in decisions:
        if decision is not None:
            block |= decision.as_dict()
    return block


def _plain(value):
    """Floats with six digits: more would only differ from machine to machine."""
    return float(f"{value:.6g}") if isinstance(value, float) else value
