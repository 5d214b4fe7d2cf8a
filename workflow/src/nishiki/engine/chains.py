"""The one table that declares the chains; plan, keys, rules, resources and documentation derive from it."""

from nishiki.chains.goniometer import GONIOMETER
from nishiki.chains.plane import PLANE
from nishiki.chains.turntable import TURNTABLE
from nishiki.engine.stage_types import Stage

CHAIN: dict[str, Stage] = {stage.name: stage for stage in (*PLANE, *TURNTABLE, *GONIOMETER)}
PRODUCTS = tuple(dict.fromkeys(stage.asked_as for stage in CHAIN.values() if stage.name != "ingest"))


def chain_of(geometry: str) -> dict[str, Stage]:
    """Stages that captures of this geometry have, in the order of the flow."""
    return {name: stage for name, stage in CHAIN.items() if stage.serves(geometry)}
