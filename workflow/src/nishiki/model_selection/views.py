"""Which views of a cloth lit along its normal a fit needs."""

import numpy as np

from nishiki.errors import UserError
from nishiki.goniometry.directions import disc
from nishiki.goniometry.hemisphere import complete
from nishiki.goniometry.symmetry import reduced
from nishiki.goniometry.table import ReflectanceSet
from nishiki.model_selection.decision import Decision
from nishiki.model_selection.spread import spread_order

OVERRIDE = "cloth_brdf.measurements: all, auto or a number"
LIMIT = 0.01  # relative error at the views not used; a sixth of what a cloth's model is expected to miss
FEWEST = 48
GROWTH = 1.4  # from one number that is tried to the next


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


def measured_choice(
    measured: ReflectanceSet, *, grid_deg: float, method: str, limit: float = LIMIT, fewest: int = FEWEST
) -> tuple[np.ndarray | None, Decision | None]:
    """As `static_choice`, with the number found: the fewest views from which the others are told within the limit.

    Numbers grow by GROWTH from `fewest`; of each the hemisphere is completed from the views used by `method` on a grid
    of `grid_deg` degrees (`hemisphere.complete`) and compared with the measured values of the others (`unseen_error`).
    None decided where there are not more than `fewest` views.
    """
    order = normal_order(measured)
    error, number = np.inf, min(fewest, len(order))
    while number < len(order):
        error = unseen_error(measured, order, number, grid_deg=grid_deg, method=method)
        if error <= limit:
            break
        number = min(len(order), int(np.ceil(GROWTH * number)))
    if len(order) <= fewest:
        return None, None
    saved = number < len(order)
    words = f"{number} of {len(order)} views at normal incidence" + ", evenly spread" * saved
    loss = f"unused views are predicted within {100 * error:.2g} % (rms, cosine-weighted)" if saved else "nothing"
    criterion = "relative error at the views at normal incidence that are not used"
    decision = Decision("measurements", words, criterion, float(error), limit, loss, OVERRIDE)
    return np.sort(order[:number]) if saved else None, decision


def unseen_error(measured: ReflectanceSet, order: np.ndarray, number: int, *, grid_deg: float, method: str) -> float:
    """Cosine-weighted relative root mean square of the views order[number:], told from order[:number]; worst region.

    order: rows of the views at normal incidence. Infinite where the views used do not span the hemisphere.
    """
    used, rest = order[:number], order[number:]
    try:
        basic = complete(with_normal_rows(measured, np.sort(used)), grid_deg=grid_deg, method=method)[0].basic
    except UserError:
        return float("inf")
    cosine, errors = measured.outgoing[rest, 2][:, None], []
    for region in range(len(measured.regions)):
        values = measured.values[rest, region]
        error = basic.evaluate(measured.outgoing[rest], region) - values
        errors.append(np.sqrt(np.sum(cosine * error**2) / max(np.sum(cosine * values**2), 1e-300)))
    return float(max(errors))
