"""Normals: photometric stereo on the selected lights, with uncertainty, and the reflectance of each channel."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nishiki.artifacts.maps import Maps, MapWriter, TiledStage
from nishiki.artifacts.stage import Context
from nishiki.errors import UserError
from nishiki.formats.images import read_codes, read_header
from nishiki.model_selection.decision import Decision, economy
from nishiki.model_selection.lights import choose_lights
from nishiki.observations.linearise import Edges, field_rows
from nishiki.observations.plane import Observations, Parcel, parcels
from nishiki.photometric.body import mean_of_channels
from nishiki.photometric.expected_error import UNKNOWN, correction_error, direction_groups
from nishiki.photometric.flags import FEW_LIGHTS, NO_ESTIMATE, NormalFlag
from nishiki.photometric.light_selection import select_diffuse, unpack_lights
from nishiki.photometric.relighting import TERMS
from nishiki.stages.normals import OUTPUTS, NormalsSettings
from nishiki.stages.normals.finishes import choose_finishes, finish_labels, refitted_error
from nishiki.stages.normals.parcel import fit_finishes, relit, solve

if TYPE_CHECKING:
    from nishiki.photometric.interreflection import FacetGrid

SIDE = 64  # facets along the longer side of the picture; the decision is made on half as many
COUNTS = 0.01  # share of the light, exceeded on a tenth of the object, from which it is looked at
BRIGHT = 0.99  # share of the facets that reflect no more than all light
SCALES = 2.0 ** np.arange(-2, 0.1, 0.5)  # of the level at which they do: without a white board it is not known


@dataclass(frozen=True)
class Thrown:
    """Shares (r, c, lights * channels) of interreflected light on a grid of facets, whose edges are these in pixels."""

    shares: np.ndarray
    edges: Edges

    def taken_off(self, observations: np.ndarray, rows: slice) -> np.ndarray:
        """Subtract interreflected light from observations (lights, rows, columns, channels) of some rows."""
        from nishiki.photometric.interreflection import taken_off

        lights, *picture, channels = observations.shape
        shares = field_rows(self.shares, self.edges, rows.start, rows.stop).reshape(*picture, lights, channels)
        return taken_off(observations, np.maximum(shares.transpose(2, 0, 1, 3), 0, order="C"))


def find_thrown_light(
    frames: Observations, lights: np.ndarray, settings: NormalsSettings
) -> tuple[Thrown | None, Decision | None]:
    """Estimate interreflections of the object where they are significant, and return the decision.

    It counts where a tenth of the object receives COUNTS of its light or more from other places, and captured lamps
    that are left out in turn are predicted better with it. Under near lamps nothing is looked for.
    """
    if settings.interreflection == "none" or settings.solver == "least_squares" or frames.positions_mm is not None:
        return None, None
    from nishiki.model_selection.relighting import ERRORS, FEWEST, FOLDS
    from nishiki.photometric.interreflection import find_interreflection, left_out_errors

    step = facet_of(frames)
    facets = read_facets(frames, lights, step, settings)
    few = facets.every(2)
    found = find_interreflection(few)
    brightest = np.quantile(found.reflectance[found.known], BRIGHT) if found.known.any() else 1.0
    scales = np.ones(1) if frames.white_board else SCALES / max(brightest, np.finfo(float).tiny)
    found = find_interreflection(few.scale(scales[-1]))
    received = found.shares.sum(axis=0).mean(axis=-1)[found.known]
    share = float(np.quantile(received, 0.9)) if received.size else 0.0
    words = "share of the light, exceeded on a tenth of the object, that other places of it throw"
    loss = f"normals of concave places too flat, {share:.2g} of the light" if share >= COUNTS else "nothing"
    kept = Decision("interreflection", "none", words, share, COUNTS, loss, "no setting forces it")
    if share < COUNTS or len(lights) < FEWEST:
        return None, kept
    without, best, most = left_out_errors(few, None, FOLDS), 0.0, 0.0
    for scale in scales:
        brighter = few.scale(scale)
        gains = without - left_out_errors(brighter, find_interreflection(brighter), FOLDS) / scale
        if not gains.mean() > most:
            break
        most = gains.mean()
        best = scale if most > ERRORS * gains.std(ddof=1) / np.sqrt(gains.size) else 0.0
    if not best:
        return None, kept
    shares = find_interreflection(facets.scale(best)).shares.astype(np.float32).transpose(1, 2, 0, 3)
    rows, columns = (np.append(np.arange(0, size, step), size) for size in frames.shape)
    override = "normals.interreflection: none"
    made = Decision("interreflection", "taken off", words, share, COUNTS, "nothing", override)
    return Thrown(shares.reshape(*shares.shape[:2], -1), (rows, columns)), made


def facet_of(frames: Observations) -> int:
    """Compute the side of a facet in pixels."""
    return max(1, -(-max(frames.shape) // SIDE))


def read_facets(frames: Observations, lights: np.ndarray, step: int, settings: NormalsSettings) -> FacetGrid:
    """Read the middle row of squares of `step` pixels; a facet is valid where half of these pixels are."""
    from nishiki.photometric.interreflection import FacetGrid

    rows, columns = (-(-size // step) for size in frames.shape)
    sums = np.zeros((len(lights), rows, columns, len(frames.channels)))
    counts, starts = np.zeros((len(lights), rows, columns)), np.arange(0, frames.shape[1], step)
    middle = np.minimum(np.arange(rows) * step + step // 2, frames.shape[0] - 1)
    for band in frames.bands():
        codes, first = frames.codes(band, lights=lights)
        for number in np.flatnonzero((middle >= first) & (middle < band.stop)):
            row = int(middle[number])
            values, known = frames.decode(codes[:, row - first : row - first + 1], lights, row)
            sums[:, number] = np.add.reduceat(np.where(known[..., None], values, 0)[:, 0], starts, axis=1)
            counts[:, number] = np.add.reduceat(known[:, 0].astype(int), starts, axis=1)

    def fit(values: np.ndarray, valid: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        values = values.astype(np.float32)
        usable = select_diffuse(mean_of_channels(values), directions, valid=valid).usable
        place = slice(0, valid.shape[1]), slice(0, valid.shape[2])
        parcel = Parcel(*place, directions, np.ones(len(values), np.float32))
        maps = solve(values, usable, valid, parcel, settings)
        return maps["normals"], ((maps["flags"] & NO_ESTIMATE) == 0) & valid.any(axis=0), usable

    return FacetGrid(sums / np.maximum(counts, 1)[..., None], counts > step / 2, frames.directions[lights], fit)


SPACING = 4  # pixels between those whose normals are solved again for their error; divides the rows of a band


def _sparse(start: int, stop: int) -> np.ndarray:
    """Return the middles of the squares of SPACING pixels, from start to stop."""
    return np.arange(start + (SPACING // 2 - start) % SPACING, stop, SPACING)


def map_tiles(context: Context) -> dict:
    """Solve band by band; memory does not grow with the number of rows."""
    frames = Observations(context.inputs["ingest"].folder)
    separate = context.inputs.get("separate")
    selection = Maps(separate.folder) if separate else None
    if separate and separate.settings["lights"] != context.settings.lights:
        raise UserError(
            f"normals.lights: {context.settings.lights}, expected {separate.settings['lights']} as the artifact of "
            "separate was made with. Remedy: give both stages the same, or run both through the workflow."
        )
    lights, decision = fit_lights(frames, selection, context.settings)
    finishes = choose_finishes(frames, selection, lights, context.settings)
    model, glosses, several = finishes.model, finishes.joint, len(finishes.parts) > 1
    thrown, taken_off = find_thrown_light(frames, lights, context.settings)
    relight = model is not None and (len(lights) <= FEW_LIGHTS or thrown is not None)
    given, compared = None, None
    if context.settings.given:
        step = facet_of(frames)
        facets = read_facets(frames, lights, step, context.settings)
        given, compared = find_given(frames, facets, step, Path(context.settings.given))
    for made in (*finishes.decisions, taken_off):
        if made:
            context.progress.tell(str(made))
    arrays = create_maps(
        context, frames, terms=TERMS.get(model, 3), relight=relight or given is not None, several=several
    )
    groups = direction_groups(frames.directions[lights])
    refits = len(lights) > 3 and None in glosses

    def solve_band(band: slice) -> tuple[dict[str, int], np.ndarray]:
        size = band.stop - band.start, frames.shape[1]
        tile_maps = {name: np.empty((*size, *array.shape[2:]), array.dtype) for name, array in arrays.items()}
        packed = None if selection is None else selection.read("usable", band)
        labels = np.zeros(size, np.uint8)
        if several:
            labels = finish_labels(frames, selection, lights, band, finishes, context.settings)
            tile_maps["finish"][...] = labels
        errors = np.zeros([n // SPACING if refits else 0 for n in np.add(size, SPACING // 2 - 1)], np.float32)

        def fit(rows: slice, observations: np.ndarray, valid: np.ndarray) -> None:
            strip = slice(rows.start - band.start, rows.stop - band.start)
            usable = valid if packed is None else unpack_lights(packed[strip], len(lights))
            direct = observations if thrown is None else thrown.taken_off(observations, rows)
            for parcel in parcels(frames, rows, lights):
                area = np.s_[:, parcel.rows, parcel.columns]
                here = labels[strip][area[1:]]
                maps = solve(direct[area], usable[area], valid[area], parcel, context.settings)
                fit_finishes(maps, observations[area], valid[area], parcel, context.settings, glosses, here)
                if model is not None:
                    together = np.array([gloss is not None for gloss in glosses])[here]
                    maps.update(relit(observations[area], valid[area], parcel, maps, model, together, always=relight))
                maps = parcel.at_pixels(maps)
                if given is not None:
                    maps.setdefault("shading_normals", maps["normals"])
                for name in maps.keys() & arrays.keys():
                    tile_maps[name][strip][area[1:]] = maps[name]
                row = _sparse(strip.start + parcel.rows.start, strip.start + parcel.rows.stop)
                column = _sparse(parcel.columns.start, parcel.columns.stop)
                if errors.size and row.size and column.size:
                    places = (slice(None), *np.ix_(row - strip.start, column))
                    samples = direct[places], usable[places], valid[places]
                    found = refitted_error(*samples, parcel, groups, context.settings)
                    errors[np.ix_(row // SPACING, column // SPACING)] = found

        deque(frames.strips(band, lights=lights, work=fit), 0)
        if errors.size:
            whole = np.pad(errors, [(0, 1), (0, 1)], mode="edge").repeat(SPACING, axis=0).repeat(SPACING, axis=1)
            sigma = whole[: size[0], : size[1]]
            apart = np.array([gloss is None for gloss in glosses])[labels] & (sigma > 0)
            apart &= (tile_maps["flags"] & (NO_ESTIMATE | NormalFlag.NO_REDUNDANCY)) == 0
            tile_maps["sigma"] = np.where(apart, sigma, tile_maps["sigma"])
        if given is not None:
            given.into(tile_maps, band)
        if frames.uncertainty:
            add_correction_error(tile_maps, frames, lights)
        for name, array in arrays.items():
            array[band] = tile_maps[name]
        inside = frames.mask[band]
        flags = tile_maps["flags"]
        known = inside & ((flags & NO_ESTIMATE) == 0)
        counted = {"object_pixels": int(inside.sum()), "valid_pixels": int(known.sum())}
        counted |= {f"flagged_{flag.name.lower()}": int((inside & ((flags & flag) != 0)).sum()) for flag in NormalFlag}
        return counted, tile_maps["sigma"][known][::17]

    counts: Counter[str] = Counter()
    sigmas = []
    for counted, sigma in map(solve_band, context.progress.over(context.share(frames.bands()), "band")):
        counts.update(counted)
        sigmas.append(sigma)
    same = {
        "lights": [frames.lights[j] for j in lights],
        **finishes.described,
        "relighting": model,
        "given": compared,
        "economy": economy(decision, *finishes.decisions, taken_off),
    }
    return {"same": same, "counts": dict(counts), "sigma": np.concatenate([np.empty(0, np.float32), *sigmas])}


def merge(context: Context, tallies: list[dict]) -> dict:
    """Count pixels and flags; compute the directional standard error, degrees, over a sample of the pixels."""
    counts: Counter[str] = Counter()
    for tally in tallies:
        counts.update(tally["counts"])
    sigma = np.concatenate([tally["sigma"] for tally in tallies])
    middle, high = np.degrees(np.percentile(sigma, [50, 95])).tolist() if sigma.size else (None, None)
    return {**counts, "sigma_median_deg": middle, "sigma_p95_deg": high, **tallies[0]["same"]}


def fit_lights(
    frames: Observations, selection: Maps | None, settings: NormalsSettings
) -> tuple[np.ndarray, Decision | None]:
    """Return the indices of the lights of the fit: those chosen by separate; chosen here without it."""
    if selection is not None:
        return np.array([frames.lights.index(name) for name in selection.group.attrs["lights"]], np.int64), None
    lights = frames.fit_lights(settings.hold_out)
    chosen, decision = choose_lights(frames, lights, settings)
    return lights[chosen], decision


def create_maps(context: Context, frames: Observations, *, terms: int, relight: bool, several: bool) -> dict:
    """Create the artifact's arrays; terms: of `shading`; relight: with `shading_normals`; several: with `finish`."""
    maps = MapWriter.of(context, OUTPUTS, frames.shape, frames.band_rows)
    unbalanced = not frames.white_board and str(frames.attributes.get("coding")).startswith("linear")
    maps.group.update(pixel_pitch_mm=frames.pixel_pitch_mm, to_srgb=frames.to_srgb, unbalanced=unbalanced)
    trailing = {"normals": (3,), "reflectance": (len(frames.channels),), "shading": (terms,), "shading_normals": (3,)}
    left_out = {"shading"} if context.settings.solver == "least_squares" else set()
    left_out |= set() if relight else {"shading_normals"}
    left_out |= set() if several else {"finish"}
    left_out |= set() if frames.uncertainty else {"correction_sigma"}
    return {name: maps.create(name, trailing.get(name, ())) for name, *_ in OUTPUTS if name not in left_out}


def add_correction_error(maps: dict, frames: Observations, lights: np.ndarray) -> None:
    """Fill `correction_sigma` of a band, and add it to its `sigma`, in place."""
    stated = {name: np.array(value) for name, value in frames.uncertainty.items()}
    if "gains" in stated:
        stated["gains"] = stated["gains"][np.ix_(lights, lights)]
    if "shift_px" in stated:
        stated["shift_px"] = stated["shift_px"][lights]
    maps["correction_sigma"] = correction_error(maps["normals"], maps["albedo"], frames.directions[lights], stated)
    maps["sigma"] = np.minimum(np.hypot(maps["sigma"], maps["correction_sigma"]), UNKNOWN)


run = TiledStage(map_tiles, merge)


if TYPE_CHECKING:
    from nishiki.photometric.interreflection import FacetGrid

LIKE = 0.5  # correlation with our normals, of the component that agrees less, from which axes are believed
SHORT = 0.5  # length of a vector below which there is no normal
AXES = tuple(
    np.array([[x, 0, 0], [0, y, 0], [0, 0, 1.0]])[[1, 0, 2] if swapped else [0, 1, 2]]
    for swapped, x, y in product((False, True), (1, -1), (1, -1))
)


@dataclass(frozen=True)
class GivenNormals:
    """Codes (rows, columns, 3) of the field, their full scale (0: vectors as they are), and its axes."""

    codes: np.ndarray
    full: float
    axes: np.ndarray

    def at(self, rows: slice | np.ndarray, columns: slice | np.ndarray = slice(None)) -> np.ndarray:
        """Return unit normals (rows, columns, 3) float32 of some places; 0 where the map has none."""
        values = self.codes[rows][:, columns].astype(np.float32)
        vectors = (values if not self.full else 2 / self.full * values - 1) @ self.axes.T.astype(np.float32)
        length = np.linalg.norm(vectors, axis=-1, keepdims=True)
        known = (length > SHORT) & (vectors[..., 2:] > 0)
        return np.divide(vectors, length, out=np.zeros_like(vectors), where=known)

    def into(self, maps: dict, rows: slice) -> None:
        """Replace the normals of some rows of the maps, in place, where the picture has one.

        The error is at least the angle between the two. `shading_normals`, which predict light, stay our own.
        """
        given, own = self.at(rows), maps["normals"]
        known = given[..., 2] > 0
        maps["normals"] = np.where(known[..., None], given, own)
        maps["sigma"] = np.where(known, np.maximum(maps["sigma"], angles(given, own)), maps["sigma"])


def correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Compute the correlation of two lists of numbers; 0 where one does not vary."""
    a, b = first - first.mean(), second - second.mean()
    return float(a @ b / max(np.sqrt((a @ a) * (b @ b)), np.finfo(np.float32).tiny))


def angles(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Compute the angles (...), radians, between unit vectors (..., 3)."""
    return np.arccos(np.clip(np.sum(first * second, axis=-1), -1, 1)).astype(np.float32)


def find_given(frames: Observations, facets: FacetGrid, step: int, path: Path) -> tuple[GivenNormals, dict[str, Any]]:
    """Read the map named in the settings, find its axes by our own normals of facets, and compare the two.

    Lamps left out cannot decide between the two: normals that were fitted to photographs predict them better than the
    true ones (docs/notes/stages/normals.md). So the user decides by giving a map; what is measured of it is stated.

    step : side of a facet in pixels. Raises UserError where the size is another, where the map shows something else,
    or shows no relief.
    """
    codes, full = _read(frames, path)
    rows, columns = frames.shape
    middle, starts = np.minimum(np.arange(step // 2, rows + step // 2, step), rows - 1), np.arange(0, columns, step)
    own, known, _ = facets.fit(facets.observations, facets.valid, facets.directions)
    candidates = [GivenNormals(codes, full, axes) for axes in AXES]
    sums = [np.add.reduceat(given.at(middle), starts, axis=1) for given in candidates]  # as facets are made
    turned = [each / np.maximum(np.linalg.norm(each, axis=-1, keepdims=True), SHORT) for each in sums]
    known = known & (turned[0][..., 2] > 0)
    if not known.any():
        raise UserError(f"normals.given: {path}: no normals on the object. Remedy: a map of unit vectors")
    like = [min(correlation(each[known][:, k], own[known][:, k]) for k in (0, 1)) for each in turned]
    second, first = np.argsort(like, kind="stable")[-2:]
    if like[first] < LIKE:
        raise UserError(
            f"normals.given: {path}: its normals correlate with those of the photographs by {like[first]:.2g} with the "
            f"best axes (expected {LIKE:g} or more). Remedy: a map of this object, in this place, as unit vectors"
        )
    horizontal, vertical = (
        "".join("+-"[int(v < 0)] + "xyz"[k] for k, v in enumerate(row) if v) for row in AXES[first][:2]
    )
    return candidates[first], {
        "axes": {"x": horizontal, "y": vertical},
        "apart_median_deg": float(np.degrees(np.median(angles(turned[first], own)[known]))),
        "correlation": float(like[first]),
        "correlation_next_axes": float(like[second]),
    }


def _read(frames: Observations, path: Path) -> tuple[np.ndarray, float]:
    """Read the codes (rows, columns, 3) of the field, and their full scale, 0 for vectors as they are."""
    header = read_header(path)
    rows, columns = frames.shape
    whole = tuple(frames.attributes["image_shape"])
    row, column = frames.attributes["region_of_interest"][:2] if (header.rows, header.columns) == whole else (0, 0)
    if (header.rows, header.columns) not in (whole, (rows, columns)):
        raise UserError(
            f"normals.given: {path}: {header.rows} x {header.columns} pixels, expected {whole[0]} x {whole[1]} as the "
            f"photographs, or {rows} x {columns} as the maps. Remedy: a map of one of these sizes"
        )
    codes = read_codes(path, ("x", "y", "z"), header=header, region=(row, column, rows, columns))
    if codes.dtype.kind == "u":
        return codes, float(np.iinfo(codes.dtype).max)
    return codes, 0.0 if np.min(codes, initial=0, where=np.isfinite(codes)) < 0 else 1.0
