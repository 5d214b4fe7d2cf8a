"""What several chains say of costs and of reasons to leave a stage out."""

from collections.abc import Callable

from nishiki.chain import SceneFacts
from nishiki.closed import Closed


def no_method(facts: SceneFacts, settings: Closed) -> str | None:
    """Reason to leave a stage out whose method is none."""
    return "its method is set to none" if settings.method == "none" else None


def whole_image(bytes_a_pixel: int) -> Callable[[int, int], int]:
    """Cost model of a stage that holds whole images: memory in MiB from pixels."""
    return lambda pixels, observations: 500 + pixels * bytes_a_pixel // 2**20
