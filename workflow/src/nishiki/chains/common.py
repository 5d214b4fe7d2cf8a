"""What several chains say of reasons to leave a stage out."""

from nishiki.artifacts.closed import Closed
from nishiki.engine.stage_types import SceneFacts


def no_method(facts: SceneFacts, settings: Closed) -> str | None:
    """Reason to leave a stage out whose method is none."""
    return "its method is set to none" if settings.method == "none" else None
