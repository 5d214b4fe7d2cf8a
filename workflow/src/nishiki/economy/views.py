"""Which views of a cloth lit along its normal a fit needs."""

import numpy as np

from nishiki.economy.decision import Decision
from nishiki.economy.spread import spread_order
from nishiki.goniometry.directions import disc
from nishiki.goniometry.symmetry import reduced
from nishiki.goniometry.table import ReflectanceSet

OVERRIDE = "fabric.measurements: all, auto or a number"


def normal_order(measured: ReflectanceSet) -> np.ndarray:
    """Rows of the usable views at normal incidence, every beginning of them evenly spread over the reduced hemisphere.

    Usable: valid in every region. The distance is that on the azimuthal equidistant disc, where they are interpolated.
    """
    rows = np.flatnonzero(measured.normal_incidence & measured.valid.all(axis=1))
    along = np.tile([0.0, 0.0, 1.0], (len(rows), 1))
    places = disc(reduced(along, measured.outgoing[rows], measured.symmetry)[1])
    return rows[spread_order(places)]


def with_normal_rows(measured: ReflectanceSet, rows: np.ndarray) -> ReflectanceSet:
    """The same set, of the views at normal incidence only `rows` valid; numbers of rows stay what they were."""
    kept = ~measured.normal_incidence
    kept[rows] = True
    names = ("incident", "outgoing", "values", "noise", "regions", "channels", "symmetry", "weave", "normal_deg")
    fields = {name: getattr(measured, name) for name in names}
    return ReflectanceSet(**fields, valid=measured.valid & kept[:, None], basic=measured.basic)


def static_choice(measured: ReflectanceSet, setting: str | int) -> tuple[np.ndarray | None, Decision | None]:
    """(rows of normal incidence that are used, or None for all; what was decided) for 'all' or a number."""
    if setting == "all":
        return None, None
    order = normal_order(measured)
    if int(setting) >= len(order):
        return None, None
    decision = Decision(
        "measurements",
        f"{int(setting)} of {len(order)} views at normal incidence, evenly spread",
        "number set",
        None,
        None,
        "not measured; evaluate compares with the views left out",
        OVERRIDE,
    )
    return np.sort(order[: int(setting)]), decision
