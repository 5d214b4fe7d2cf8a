"""What several chains say of reasons to leave a stage out."""

from nishiki.chains.chain import SceneFacts
from nishiki.contract.closed import Closed


def no_method(facts: SceneFacts, settings: Closed) -> str | None:
    """Reason to leave a stage out whose method is none."""
    return "its method is set to none" if settings.method == "none" else None
