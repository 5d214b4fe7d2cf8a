"""Choose the finishes of a scene by held-out captured lamps: number, places, and the fit of normals on each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from nishiki.artifacts.maps import Maps
from nishiki.model_selection.decision import Decision
from nishiki.observations.plane import STRIDE, Observations, Parcel, parcels, sample
from nishiki.photometric.expected_error import LARGEST_SIGMA
from nishiki.photometric.flags import FEW_LIGHTS
from nishiki.photometric.light_selection import unpack_lights
from nishiki.photometric.relighting import MODELS
from nishiki.stages.normals import NormalsSettings
from nishiki.stages.normals.parcel import fit_finishes, relit, solve

if TYPE_CHECKING:
    from nishiki.brdf.gloss_profile import GlossProfile
    from nishiki.model_selection.relighting import RelightingSample
    from nishiki.photometric.gloss import GlossTile
    from nishiki.photometric.gloss_scene import SceneGloss

SAMPLE_PIXELS = 15_000  # of the scene, for its finishes
RELIGHTING_PIXELS = 2000  # likewise, for the model that predicts lamps
CLEAR = 1.0  # cost a value above that of the cheapest finish that counts no more: else borders follow the larger misfit


@dataclass(frozen=True)
class Finish:
    """One finish.

    gloss : fitted to its part of the sample, None where none was looked for; share : of the sample; profile : that
    decides where the finish is, and with which normals are fitted where `joint`; errors : mean CIEDE2000 of captured
    lamps left out, by candidate; inside : of these lamps those that the others surround.
    """

    gloss: SceneGloss | None
    share: float
    profile: GlossProfile | None
    joint: bool
    errors: dict[str, np.ndarray]
    inside: np.ndarray | None = None

    def error(self, name: str) -> np.ndarray:
        """Return CIEDE2000 of the held-out lamps that the others surround."""
        return self.errors[name][self.inside]

    def describe(self, model: str | None) -> dict:
        """Return plain numbers for the diagnostics; model: of relighting."""
        gloss = {} if self.gloss is None else {**self.gloss.described, **self.profile.described}
        means = {name: float(f"{self.error(name).mean():.4g}") for name in self.errors}
        name = "joint" if self.joint else model
        gain = float((self.error(f"{name}, matt") - self.error(name)).mean()) if name in self.errors else None
        counts = {"gloss_counts": gain is None or gain > 0, "gloss_gain_de00": gain}
        return {"share": self.share, "joint": self.joint, **gloss, **counts, "left_out_de00": means}


@dataclass(frozen=True)
class Finishes:
    """parts : the finishes of a scene; model : of relighting, None where no pixel needs it; decisions."""

    parts: tuple[Finish, ...]
    model: str | None
    decisions: tuple[Decision | None, ...] = ()

    @property
    def joint(self) -> list[GlossProfile | None]:
        """Gloss for fitting the normals of each finish; None: from the selected lights alone."""
        return [part.profile if part.joint else None for part in self.parts]

    @property
    def described(self) -> dict:
        """Plain numbers for the diagnostics; the gloss of the widest finish stands at the top too."""
        parts = [part.describe(self.model) for part in self.parts]
        top = {name: value for name, value in max(parts, key=lambda part: part["share"]).items() if "gloss" in name}
        bounds = [bound for part in parts for bound in part.get("at_bounds", [])]
        refined = any(part.joint for part in self.parts)
        return {"refined": refined, "finishes": parts, **top, "at_bounds": bounds}


def choose_finishes(
    frames: Observations, selection: Maps | None, lights: np.ndarray, settings: NormalsSettings
) -> Finishes:
    """Find the finishes of a scene on a sample of its pixels.

    Captured lamps that are left out in turn decide how many there are, how normals are fitted on each, and which model
    predicts lamps, where the settings leave it open. Regions of the capture are finishes without a question.
    """
    from nishiki.model_selection.relighting import FEWEST, choose_model, select_surrounded

    models = () if settings.solver == "least_squares" else MODELS
    looked_for = settings.refine == "gloss" or (settings.refine == "auto" and len(lights) <= FEW_LIGHTS)
    asked = settings.relighting == "auto"
    wanted = SAMPLE_PIXELS if looked_for else RELIGHTING_PIXELS if models and asked else 0
    pieces = sampled_pixels(frames, selection, lights, wanted) if wanted else []
    pieces = [piece for piece in pieces if piece.valid.any()]
    told = pieces and models and len(lights) >= FEWEST and settings.refine != "gloss"
    step = max(1, sum(piece.valid.shape[2] for piece in pieces) // RELIGHTING_PIXELS)
    few = [piece.only(np.s_[::step]) for piece in pieces] if told else []

    inside = select_surrounded(frames.directions[lights])

    def fit(
        glosses: Sequence[SceneGloss | None], labels: np.ndarray, clear: np.ndarray | bool = True
    ) -> tuple[Finish, ...]:
        given = few, settings, models, inside, clear
        return tuple(fitted_finish(labels == k, gloss, *given) for k, gloss in enumerate(glosses))

    one = np.zeros(1 + max((int(piece.cells.max()) for piece in pieces), default=0), np.int64)
    if pieces and looked_for:
        from nishiki.photometric.gloss_scene import find_finishes, fit_glosses

        tiles = gloss_tiles(pieces, settings)
        labels = one if frames.regions is None else np.arange(1 + int(frames.regions.max()))
        glosses = fit_glosses(tiles, labels, settings.refractive_index)
        tried = [fit(glosses, labels)]
        for found in find_finishes(tiles, glosses[0].found) if told and frames.regions is None else ():
            tried.append(fit(*found))
            if predicted_error(tried[-1]) >= predicted_error(tried[-2]):
                break
    else:
        tried = [fit([None], one)]
    parts, decision = choose_count(tried)
    if settings.refine == "gloss":
        parts = tuple(replace(each, joint=each.gloss is not None) for each in parts)
    refinement = describe_refinement(parts, settings)
    without = [each for each in parts if not each.joint]
    if not models or not without:
        return Finishes(parts, None, (decision, refinement))
    if not asked or not told:
        return Finishes(parts, MODELS[0] if asked else settings.relighting, (decision, refinement))
    weights = [each.share for each in without]
    errors = {name: np.average([each.error(name) for each in without], axis=0, weights=weights) for name in MODELS}
    model, relighting = choose_model(errors)
    return Finishes(parts, model, (decision, refinement, relighting))


def fitted_finish(
    member: np.ndarray,
    gloss: SceneGloss | None,
    pieces: Sequence[RelightingSample],
    settings: NormalsSettings,
    models: Sequence[str],
    inside: np.ndarray,
    clear: np.ndarray | bool,
) -> Finish:
    """Fit one finish, with lamps held out of the sample, and choose among the fits by its clear cells.

    member (cells,) bool: its cells; inside (lights,) bool: lamps that the others surround; clear (cells,) bool, or all.
    """
    from nishiki.brdf.gloss_profile import GlossProfile
    from nishiki.model_selection.relighting import CandidateFit, joint_fit_counts, left_out_errors

    joint = {} if gloss is None else {"joint": gloss.found, "first": gloss.first, "bare": gloss.found.bare()}

    def fit(piece: RelightingSample) -> dict[str, CandidateFit]:
        given = piece.observations, piece.usable, piece.valid, piece.parcel
        maps = solve(*given, settings)
        fits = {"normals": CandidateFit(maps)}
        for name in models:
            fits[name] = CandidateFit(maps | relit(piece.observations, piece.valid, piece.parcel, maps, name))
        for name, profile in joint.items():
            together = {key: np.array(values) for key, values in maps.items()}
            labels = np.zeros(piece.valid.shape[1:], int)
            fit_finishes(together, piece.observations, piece.valid, piece.parcel, settings, [profile], labels)
            fits[name] = CandidateFit(together, profile)
        matt = GlossProfile(np.zeros(1), np.ones(1), transmission=0.0)
        for name in models:
            fits[f"{name}, matt"] = CandidateFit(fits[name].maps, matt)
        if joint:
            fits["joint, matt"] = fits["bare"]
        return fits

    total = sum(piece.valid.shape[2] for piece in pieces)
    here, surely = (
        [part for piece in pieces if (part := piece.only(cells[piece.cells[0]])).valid.any()]
        for cells in (member, member & clear)
    )
    share = sum(piece.valid.shape[2] for piece in here) / total if total else 1.0
    if not here:
        found = None if gloss is None else gloss.found
        return Finish(gloss, share, found, gloss is not None and gloss.significant, {})
    errors = left_out_errors(here, fit, pieces)
    if gloss is None:
        return Finish(None, share, None, False, errors, inside)
    told = errors if clear is True or not surely else left_out_errors(surely, fit, pieces)
    counts = any(joint_fit_counts({"normals": told["normals"], "joint": told[name]}) for name in joint)
    best = min(joint, key=lambda name: told[name].mean())
    errors["joint"] = errors[best]
    return Finish(gloss, share, joint[best], counts, errors, inside)


def predicted_error(parts: Sequence[Finish]) -> float:
    """Return the CIEDE2000 of captured lamps held out, under the best fit of each finish."""
    fits = ((part, ("joint",) if part.joint else MODELS) for part in parts if part.errors)
    return float(sum(part.share * min(part.errors[name].mean() for name in names) for part, names in fits))


def choose_count(tried: Sequence[tuple[Finish, ...]]) -> tuple[tuple[Finish, ...], Decision | None]:
    """Choose the partition that best predicts held-out lamps; one more finish must improve it by LEAST_GAIN."""
    from nishiki.model_selection.relighting import LEAST_GAIN

    chosen = tried[0]
    for parts in tried[1:]:
        if predicted_error(parts) < (1 - LEAST_GAIN) * predicted_error(chosen):
            chosen = parts
    if len(tried) < 2:
        return chosen, None
    gain = predicted_error(tried[0]) - min(predicted_error(parts) for parts in tried[1:])
    words = "one finish explains the scene" if len(chosen) == 1 else f"{len(chosen)} finishes"
    loss = "nothing" if len(chosen) > 1 or gain <= 0 else f"at most {gain:.2g} CIEDE2000"
    return chosen, Decision(
        "finishes", words, "CIEDE2000 of captured lamps left out that several finishes take off", gain,
        LEAST_GAIN * predicted_error(tried[0]), loss, "a label picture of the capture (regions)",
    )  # fmt: skip


def describe_refinement(parts: Sequence[Finish], settings: NormalsSettings) -> Decision | None:
    """List the finishes whose normals are fitted together with gloss, and the gain."""
    looked_for = [part for part in parts if part.gloss is not None]
    if not looked_for:
        return None
    joint = sum(part.joint for part in parts)
    words = "normals fitted together with gloss" if joint else "no joint fit of normals and gloss"
    if 0 < joint < len(parts):
        words += f" on {joint} of {len(parts)} finishes"
    if settings.refine == "gloss":
        words += " (set)"
    told = [part for part in looked_for if part.errors]
    criterion = "CIEDE2000 of captured lamps left out that the joint fit takes off"
    gain = float(sum(part.share * (part.errors["normals"] - part.errors["joint"]).mean() for part in told))
    if not told:
        criterion = "robust cost a value (light and channel) that gloss takes off, on a sample"
        gain = max(part.gloss.gain for part in looked_for)
    return Decision("refine", words, criterion, gain, None, "nothing", "normals.refine: gloss")


def finish_labels(
    frames: Observations,
    selection: Maps | None,
    lights: np.ndarray,
    band: slice,
    finishes: Finishes,
    settings: NormalsSettings,
) -> np.ndarray:
    """Return the finish of each pixel of a band, (rows, columns) uint8: regions of the capture, else the cheapest fit.

    Every STRIDE-th pixel of every STRIDE-th row is fitted with the gloss of each finish; costs are averaged over
    a cell of the picture, so that the bytes do not depend on the band.
    """
    if frames.regions is not None:
        return frames.regions[band]
    from scipy.ndimage import correlate1d

    from nishiki.photometric.gloss_scene import SIDE, refine_tile

    reach = SIDE // STRIDE // 2
    rows, columns = frames.shape
    first, last = max(band.start // STRIDE - reach, 0), min((band.stop - 1) // STRIDE + reach, (rows - 1) // STRIDE)
    wide = slice(first * STRIDE, min(last * STRIDE + STRIDE, rows))
    shape = (last - first + 1, -(-columns // STRIDE))
    costs, values = np.zeros((len(finishes.parts), *shape)), np.zeros(shape)
    for piece, places in strided_pieces(frames, selection, lights, wide):
        (tile,) = gloss_tiles([piece], settings)
        at = (places[0] // STRIDE - first, places[1] // STRIDE)
        values[at] = tile.valid.sum(axis=0)[0]
        for cost, part in zip(costs, finishes.parts, strict=True):
            cost[at] = refine_tile(tile, part.profile).cost[0] / len(frames.channels)
    costs = np.minimum(costs, costs.min(axis=0) + CLEAR * values)
    window = np.ones(2 * reach + 1)
    for axis in (0, 1):
        values = correlate1d(values, window, axis=axis, mode="constant")
        costs = correlate1d(costs, window, axis=axis + 1, mode="constant")
    cheapest = (costs / np.maximum(values, 1)).argmin(axis=0).astype(np.uint8)
    whole = cheapest.repeat(STRIDE, axis=0).repeat(STRIDE, axis=1)
    return whole[band.start - wide.start :][: band.stop - band.start, :columns]


def refitted_error(
    observations: np.ndarray,
    usable: np.ndarray,
    valid: np.ndarray,
    parcel: Parcel,
    groups: np.ndarray,
    settings: NormalsSettings,
) -> np.ndarray:
    """Compute the error of normals (rows, columns), radians, from held-out lamps; 0 where there is no estimate.

    Neighbouring lamps see the same wrong model, so that groups of them are left out in turn (delete-a-group jackknife;
    R. G. Miller, Biometrika 61, 1974). observations, usable, valid as of `solve`; groups (lights,) of
    `nishiki.photometric.expected_error.direction_groups`.
    """
    count, normals = int(groups.max()) + 1, []
    for number in range(count):
        kept = groups != number
        part = replace(parcel, directions=parcel.directions[kept], scale=parcel.scale[kept])
        normals.append(solve(observations[kept], usable[kept], valid[kept], part, settings)["normals"])
    apart = np.square(normals - np.mean(normals, axis=0)).sum(axis=-1)
    return np.sqrt((count - 1) / count * np.minimum(apart, LARGEST_SIGMA**2).sum(axis=0))


def strided_pieces(
    frames: Observations, selection: Maps | None, lights: np.ndarray, rows: slice
) -> Iterator[tuple[RelightingSample, tuple[np.ndarray, np.ndarray]]]:
    """Yield every STRIDE-th pixel of the object in some rows, with their (rows, columns) in the picture."""
    from nishiki.model_selection.relighting import RelightingSample

    for strip, observations, valid in frames.strips(rows, lights=lights):
        usable = valid if selection is None else unpack_lights(selection.read("usable", strip), len(lights))
        for parcel in parcels(frames, strip, lights):
            area = np.s_[:, parcel.rows, parcel.columns]
            row, column = np.mgrid[parcel.rows, parcel.columns]
            row += strip.start
            chosen = (row % STRIDE == 0) & (column % STRIDE == 0) & frames.mask[row, column]
            if chosen.any():
                values, lit, known = (
                    np.ascontiguousarray(array[area][:, chosen][:, None]) for array in (observations, usable, valid)
                )
                yield RelightingSample(values, lit, known, parcel), (row[chosen], column[chosen])


def sampled_pixels(
    frames: Observations, selection: Maps | None, lights: np.ndarray, pixels: int
) -> list[RelightingSample]:
    """Sample about `pixels` pixels of the object by cells, or regions of the capture, the same on every machine."""
    from nishiki.model_selection.relighting import RelightingSample
    from nishiki.photometric.gloss_scene import SIDE

    groups: dict[int, list[RelightingSample]] = {}
    for piece in sample(frames, lights, pixels, channel=None, cell=SIDE):
        usable = piece.valid
        if selection is not None:
            usable = unpack_lights(selection.read("usable", piece.band), len(lights))
            usable = np.stack([piece.of(values) for values in usable])
        row, column = (piece.of(place) for place in np.mgrid[piece.band, 0 : frames.shape[1]])
        squares = row // SIDE * -(-frames.shape[1] // SIDE) + column // SIDE
        cells = squares if frames.regions is None else frames.regions[row, column].astype(np.int64)
        parcel = replace(piece.parcel, scale=np.ones(len(lights), np.float32))  # the piece is scaled
        near = 0 if frames.positions_mm is None else int(squares[0, 0])  # near lamps have parcels of few pixels
        groups.setdefault(near, []).append(RelightingSample(piece.observations, usable, piece.valid, parcel, cells))
    pieces = [join_pieces(same) for same in groups.values()]
    if frames.regions is None and pieces:
        known = np.unique(np.concatenate([piece.cells[0] for piece in pieces]))
        pieces = [replace(piece, cells=np.searchsorted(known, piece.cells)) for piece in pieces]
    return pieces


def join_pieces(pieces: Sequence[RelightingSample]) -> RelightingSample:
    """Join pieces, under the means of their directions."""
    arrays = {
        name: np.concatenate([getattr(piece, name) for piece in pieces], axis=axis)
        for name, axis in (("observations", 2), ("usable", 2), ("valid", 2), ("cells", 1))
    }
    directions = np.stack([piece.parcel.directions for piece in pieces])
    if (directions != directions[0]).any():
        directions = directions.mean(axis=0, keepdims=True)
        directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    return replace(pieces[0], parcel=replace(pieces[0].parcel, directions=directions[0]), **arrays)


def gloss_tiles(pieces: Sequence[RelightingSample], settings: NormalsSettings) -> list[GlossTile]:
    """Return sampled pixels with their estimates from the selected lights."""
    from nishiki.photometric.gloss import GlossTile

    tiles = []
    for piece in pieces:
        maps = solve(piece.observations, piece.usable, piece.valid, piece.parcel, settings)
        start = {name: maps[name] for name in ("normals", "flags", "sigma", "reflectance")}
        observed = piece.parcel.scale_to_centre(piece.observations)
        tiles.append(GlossTile(observed, piece.valid, piece.parcel.directions, cells=piece.cells, **start))
    return tiles
