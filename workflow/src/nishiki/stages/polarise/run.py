"""Polarise: diffuse and specular components of every view, from its polariser states."""

from collections.abc import Iterator
from dataclasses import asdict, replace

import numpy as np

from nishiki.artifacts.stage import Context
from nishiki.errors import UserError
from nishiki.observations.views import Views, encode
from nishiki.polarisation import polarisation
from nishiki.polarisation.noise import PhotographNoise
from nishiki.polarisation.polariser_states import StateSums, arms_of, read_instrument, sums_of
from nishiki.polarisation.series import SeparationStatistics, Thinned, diagnose, select_lit, statistics_of
from nishiki.polarisation.smoothing import smooth_planes
from nishiki.render.display import write_png
from nishiki.stages.polarise import OUTPUTS, PolariseSettings


def run(context: Context) -> dict:
    """Separate one photograph series after another; one view's planes are in memory at a time."""
    folder, settings = context.inputs["ingest"].folder, context.settings
    views = Views(folder)
    name = views.geometry.get("calibration")
    instrument = read_instrument(folder / name) if name else None
    wavelength = settings.wavelength_nm
    if wavelength is None and len(views.channels) == 1:  # a single channel may have it in its name: "630 nm"
        text = views.channels[0].removesuffix("nm").strip()
        wavelength = float(text) if text.replace(".", "", 1).isdigit() else None
    arms = arms_of(instrument, wavelength_nm=wavelength)
    sums = sums_of(views.states, generator=arms[0], analyser=arms[1], method=settings.method)
    writer = polarisation.ComponentWriter(
        context.output.folder,
        OUTPUTS,
        views=views.views,
        lights=views.lights,
        shape=views.shape,
        channels=views.channels,
        stamp=context.stamp,
    )
    count, drawn = len(views.views), min(settings.pictures, len(views.views))
    shown = {count * k // drawn for k in range(drawn)}
    statistics: list[SeparationStatistics] = []
    facts_of_views: list[dict] = []
    exposure = None
    boards = {light: boards_of(views, light, sums, settings) for light in views.lights}
    pictures: dict[str, str] = {}
    for number in context.progress.over(range(len(views.lights) * len(views.views)), "view"):
        light, place = views.lights[number // len(views.views)], number % len(views.views)
        separated, figures, facts = separate(views, place, light, sums, settings, boards[light])
        writer.write(number, separated)
        statistics.append(figures)
        facts_of_views.append(facts)
        if place in shown and number < len(views.views):
            if not exposure:  # at most full scale, but for the brightest half per cent of the whole
                total = (separated.diffuse + separated.specular)[separated.valid]
                top = float(np.percentile(total, 99.5)) if total.size else 0.0
                exposure = 1 / top if top > 0 else 1.0
            pictures[picture(context, views.views[place], place, separated, exposure)] = views.views[place]
    return {
        "method": sums.method,
        "states": len(sums.states),
        "states_used": sums.used,
        "condition": sums.condition,
        "angles_deg": [list(angles) for angles in sums.angles_deg],
        "views": len(views.views),
        "lights": list(views.lights),
        "unit": unit_of(views, sums, boards),
        "boards": {
            light: {"channel": board.channel, "covered": board.covered, "low_pixels": board.low, "spread": board.spread}
            if (board := boards[light])
            else None
            for light in views.lights
        },
        "pictures": pictures,
        **totals(statistics),
        "by_view": [{**asdict(one), **facts} for one, facts in zip(statistics, facts_of_views, strict=True)],
    }


def separate(
    views: Views, place: int, light: str, sums: StateSums, settings: PolariseSettings, board: polarisation.Beta | None
) -> tuple[polarisation.SeparatedView, SeparationStatistics, dict]:
    """Compute components of one view, statistics of those by the formulas alone, and diagnostics of its series."""
    thinned = Thinned(sums, views.shape, len(views.channels))
    planes, valid = polarisation.sum_planes(photographs(views, place, light, thinned), sums.weights)
    facts = diagnose(sums, thinned)
    field = None if board is None else board.field
    beta, gain, phase, sense = None, None, None, 1
    if sums.method == "circular":
        beta = field if field is not None else np.array(settings.beta)
    elif field is not None:
        gain = 1 / field
    if sums.method == "linear":
        angle, agreement = polarisation.common_phase(planes, valid)
        facts |= {"phase_deg": float(np.degrees(angle)), "phase_agreement": agreement}
        phase = angle if settings.phase == "common" else None
    if sums.method == "mueller":
        sense = polarisation.reflected_sense(planes[1][valid], planes[2][valid])
        facts["sense"] = sense
    separated = polarisation.components(planes, valid, sums, beta=beta, phase=phase, sense=sense, gain=gain)
    outline = views.silhouette(place)
    shown = select_lit(separated.diffuse + separated.specular, separated.valid) if outline is None else outline
    figures = statistics_of(separated, shown)
    if not settings.smoothing:
        return separated, figures, facts
    usable = separated.valid
    scales = [views.attributes["scale"][views.index(place, state=state, light=light)] for state in views.states]
    smoothed = smooth_planes(
        planes,
        usable if outline is None else usable & outline,
        sums,
        counted=shown,
        beta=beta,
        phase=phase,
        sense=sense,
        scales=np.array(scales),
    )
    if smoothed.doubtful is not None:
        figures = replace(figures, doubtful=smoothed.doubtful)
    after = polarisation.components(smoothed.planes, valid, sums, beta=beta, phase=phase, sense=sense, gain=gain)
    return after, figures, facts | smoothing_diagnostics(separated, after, smoothed.noise)


def smoothing_diagnostics(
    before: polarisation.SeparatedView, after: polarisation.SeparatedView, noise: PhotographNoise | None
) -> dict:
    """Compute the noise of the photographs, and the root mean square change of the components by smoothing."""
    pairs = {"diffuse": (before.diffuse, after.diffuse), "specular": (before.specular, after.specular)}
    changes = {name: (new - old)[after.valid] for name, (old, new) in pairs.items()}
    return {
        "photograph_noise": None if noise is None else {"slope": noise.slope.tolist(), "floor": noise.floor.tolist()},
        "changed": {
            name: float(np.sqrt(np.mean(each**2, dtype=np.float64))) if each.size else None
            for name, each in changes.items()
        },
    }


def photographs(views: Views, place: int, light: str, thinned: Thinned) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the view's photographs, one at a time, in the order of the states."""
    for state in views.states:
        values, valid = views.read(place, state=state, light=light)
        thinned.add(values, valid)
        yield values, valid


def boards_of(views: Views, light: str, sums: StateSums, settings: PolariseSettings) -> polarisation.Beta | None:
    """Compute beta (circular) or the analyser's transmission (else) by place, from the white boards; None without.

    UserError where circular states have neither boards nor a given beta.
    """
    if sums.method == "none" or (sums.method == "circular" and settings.beta is not None):
        if settings.beta is not None and len(settings.beta) not in (1, len(views.channels)):
            raise UserError(f"polarise.beta: expected 1 or {len(views.channels)} values, found {len(settings.beta)}")
        if settings.beta is not None and min(settings.beta) < settings.beta_least:
            raise UserError(f"polarise.beta: {min(settings.beta):g} is below beta_least = {settings.beta_least:g}")
        return None
    used = [state for state, column in zip(sums.states, sums.weights.T, strict=True) if column.any()]
    boards = {state: views.board(state, light=light) for state in used}
    images = {state: board for state, board in boards.items() if board is not None}
    missing = [state for state in used if state not in images]
    if sums.method == "circular":
        if missing:
            raise UserError(
                f"polarise: no white board for the polariser {' and '.join(missing)}. Remedy: photograph the board "
                "with the "
                "polarisers off and on (role white), or give polarise.beta"
            )
        return polarisation.board_ratio(images["on"], images["off"], least=settings.beta_least, local=settings.local)
    if missing:
        return None
    everywhere = np.ones(views.shape, bool)
    series = ((images.get(state, images[used[0]]), everywhere) for state in sums.states)
    planes, valid = polarisation.sum_planes(series, sums.weights)
    sense = polarisation.reflected_sense(planes[1], planes[2]) if sums.method == "mueller" else 1
    board = polarisation.components(planes, valid, sums, sense=sense)
    total = board.diffuse + board.specular
    lit = total > 0.1 * np.percentile(total, 99, axis=(0, 1))
    return polarisation.board_ratio(total, lit, least=settings.beta_least, what="transmission", local=settings.local)


def unit_of(views: Views, sums: StateSums, boards: dict[str, polarisation.Beta | None]) -> str:
    """Return the meaning of 1: "white board", or "full scale" of the photographs at the longest exposure time.

    Boards behind circular polarisers give beta alone; those behind analysers divide the components.
    """
    divided = sums.method != "circular" and all(board is not None for board in boards.values())
    return "white board" if views.attributes["white_board"] or divided else "full scale"


def totals(statistics: list[SeparationStatistics]) -> dict:
    """Average figures over the views that have valid pixels."""
    known = [one for one in statistics if one.diffuse is not None]
    names = ("diffuse", "specular", "negative", "negative_mean", "noise", "doubtful")
    mean = {name: [getattr(one, name) for one in known if getattr(one, name) is not None] for name in names}
    values = {name: float(np.mean(each)) if each else None for name, each in mean.items()}
    sum_of_means = (values["diffuse"] or 0.0) + (values["specular"] or 0.0)
    return {
        **values,
        "specular_share": values["specular"] / sum_of_means if known and sum_of_means > 0 else None,
        "valid": float(np.mean([one.valid for one in statistics])),
    }


def picture(context: Context, name: str, place: int, view: polarisation.SeparatedView, exposure: float) -> str:
    """Draw whole, diffuse and specular part at one exposure, negative values black; return the file of all three."""
    parts = {"whole": view.diffuse + view.specular, "diffuse": view.diffuse, "specular": view.specular}
    codes = {key: display(values * np.float32(exposure)) for key, values in parts.items()}
    codes["side_by_side"] = np.concatenate(list(codes.values()), axis=1)
    safe = "".join(letter if letter.isalnum() or letter in "._-" else "-" for letter in name)
    for key, pixels in codes.items():
        file = f"pictures/{place:03}_{safe}{'_' if safe else ''}{key}.png"
        write_png(context.output.path(file), pixels, stamp=context.stamp | {"exposure": f"{exposure:.6g}"})
    return file


def display(linear: np.ndarray) -> np.ndarray:
    """Convert linear values to (rows, columns, 3) uint8 sRGB: one channel as grey, of three or more the first three."""
    colours = linear[..., :3] if linear.shape[-1] >= 3 else np.repeat(linear[..., :1], 3, axis=-1)
    return np.rint(255 * encode(np.clip(colours, 0, 1), "srgb")).astype(np.uint8)
