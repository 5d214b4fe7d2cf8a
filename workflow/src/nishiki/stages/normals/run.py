"""Normals: photometric stereo on the selected lights, with uncertainty, and the reflectance of each channel."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np

from nishiki.artifacts.maps import Maps, MapWriter, TiledStage
from nishiki.artifacts.stage import Context
from nishiki.errors import UserError
from nishiki.model_selection.decision import Decision, economy
from nishiki.model_selection.lights import choose_lights
from nishiki.observations.parcels import parcels
from nishiki.observations.plane import Observations
from nishiki.photometric import flags as bits
from nishiki.photometric.expected_error import UNKNOWN, correction_error, direction_groups
from nishiki.photometric.flags import FEW_LIGHTS
from nishiki.photometric.light_selection import unpack_lights
from nishiki.photometric.relighting import TERMS
from nishiki.stages.normals import NormalsSettings
from nishiki.stages.normals.finishes import choose_finishes, finish_labels, refitted_error
from nishiki.stages.normals.interreflection import find_thrown_light
from nishiki.stages.normals.parcel import MAPS, fit_finishes, relit, solve

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
    for made in (*finishes.decisions, taken_off):
        if made:
            context.progress.tell(str(made))
    arrays = create_maps(context, frames, terms=TERMS.get(model, 3), relight=relight, several=several)
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
            apart &= (tile_maps["flags"] & (bits.NO_ESTIMATE | bits.NO_REDUNDANCY)) == 0
            tile_maps["sigma"] = np.where(apart, sigma, tile_maps["sigma"])
        if frames.uncertainty:
            add_correction_error(tile_maps, frames, lights)
        for name, array in arrays.items():
            array[band] = tile_maps[name]
        inside = frames.mask[band]
        flags = tile_maps["flags"]
        known = inside & ((flags & bits.NO_ESTIMATE) == 0)
        counted = {"object_pixels": int(inside.sum()), "valid_pixels": int(known.sum())}
        counted |= {f"flagged_{name}": int((inside & ((flags & bit) != 0)).sum()) for bit, name in bits.NAMES.items()}
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
        "economy": economy(decision, *finishes.decisions, taken_off),
    }
    return {"same": same, "counts": dict(counts), "sigma": np.concatenate([np.empty(0, np.float32), *sigmas])}


def merge(context: Context, tallies: list[dict]) -> dict:
    """Return counts of pixels and of flags; standard error of the direction, degrees, over a sample of the pixels."""
    counts: Counter[str] = Counter()
    for tally in tallies:
        counts.update(tally["counts"])
    sigma = np.concatenate([tally["sigma"] for tally in tallies])
    middle, high = np.degrees(np.percentile(sigma, [50, 95])).tolist() if sigma.size else (None, None)
    return {**counts, "sigma_median_deg": middle, "sigma_p95_deg": high, **tallies[0]["same"]}


def fit_lights(
    frames: Observations, selection: Maps | None, settings: NormalsSettings
) -> tuple[np.ndarray, Decision | None]:
    """Return the indices of the lights of the fit: those that separate chose; chosen here where it was left out."""
    if selection is not None:
        return np.array([frames.lights.index(name) for name in selection.group.attrs["lights"]], np.int64), None
    lights = frames.fit_lights(settings.hold_out)
    chosen, decision = choose_lights(frames, lights, settings)
    return lights[chosen], decision


def create_maps(context: Context, frames: Observations, *, terms: int, relight: bool, several: bool) -> dict:
    """Create the artifact's arrays; terms: of `shading`; relight: with `shading_normals`; several: with `finish`."""
    rows, columns = frames.shape
    maps = MapWriter(context.output.folder, rows=rows, columns=columns, band_rows=frames.band_rows, stamp=context.stamp)
    unbalanced = not frames.white_board and str(frames.attributes.get("coding")).startswith("linear")
    maps.group.update(pixel_pitch_mm=frames.pixel_pitch_mm, to_srgb=frames.to_srgb, unbalanced=unbalanced)
    trailing = {"normals": (3,), "reflectance": (len(frames.channels),), "shading": (terms,), "shading_normals": (3,)}
    left_out = {"shading"} if context.settings.solver == "least_squares" else set()
    left_out |= set() if relight else {"shading_normals"}
    left_out |= set() if several else {"finish"}
    left_out |= set() if frames.uncertainty else {"correction_sigma"}
    return {
        name: maps.create(name, trailing.get(name, ()), dtype=dtype, unit=unit)
        for name, (dtype, unit) in MAPS.items()
        if name not in left_out
    }


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
