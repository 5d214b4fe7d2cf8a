"""Interpret a lights file of any program and dialect: directions, positions or angles, decided by evidence.

A file that can be read in two ways is decided by the photographs (below), or refused with the options
that say which it is.

The photographs, reduced to a few hundred samples, are fitted by Lambert's law with a free strength of every lamp; what
is left, the width of the picture in the unit of the lamps, and the strengths tell which reading is right.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nishiki.capture.lights import Lights, is_unicode, light_name, lights_from_vectors, read_numbers
from nishiki.capture.options import ANGLES
from nishiki.capture.taking import SATURATED
from nishiki.formats.files import same_name
from nishiki.formats.images import read_coarse, read_header
from nishiki.formats.problems import CaptureError, Problem, error, refuse, warning
from nishiki.formats.text_tables import number_of
from nishiki.goniometry.directions import unit
from nishiki.photometric.consistency import SURE, NearLamps, measure_width, split_course
from nishiki.photometric.lambert_fit import fit_lambert, return_none_if_undetermined, spread_pixels

MOST_PHOTOGRAPHS = 32  # read, spread over the lamps
FEWEST_PHOTOGRAPHS = 5  # of a folder whose lamps are judged by them
CLEARLY = 0.85  # ratio of misfits below which one reading is better, beyond noise and gloss
TRIED_WIDTH = 0.5  # of the lamps' distance: near lamps that would show if there were any
MILLIMETRES = (40.0, 5000.0)  # distance of lamps whose unit is taken to be the millimetre
UNITS = {"millimetres": 1.0, "centimetres": 10.0, "inches": 25.4, "metres": 1000.0}
SAME_UNIT = 0.2  # by which a width may be off for its unit to be known
OFF_UNIT = 0.1  # of lengths from 1: nearer, vectors state directions alone, and their unit is the lamps' distance
IN_PLANE = 0.05  # height of lamps beside their distance from the axis, three degrees: no relief is photographed so
LEAST_STRENGTH = 0.01  # by which strengths differ that can be told from noise


@dataclass(frozen=True)
class PhotoSamples:
    """Samples of photographs."""

    values: np.ndarray  # (photographs, rows, columns) float64: linear mean of the channels, NaN where saturated
    chosen: np.ndarray  # (photographs,) int: number of each photograph among those given


def sample_photographs(photographs: Sequence[Path], encoding: str | None) -> PhotoSamples | None:
    """Read samples on a grid; None where the photographs are too few or of several sizes.

    CaptureError where one cannot be decoded.
    """
    if len(photographs) < FEWEST_PHOTOGRAPHS:
        return None
    chosen = np.unique(np.linspace(0, len(photographs) - 1, MOST_PHOTOGRAPHS).round().astype(int))
    pictures = [read_coarse(photographs[i], encoding) for i in chosen]
    if len({picture.shape for picture in pictures}) > 1:
        return None
    stored = np.array(pictures, np.float64)
    values = np.where(stored < SATURATED * max(float(stored.max()), 1e-9), stored, np.nan)
    records = [read_header(photographs[i]).exif for i in chosen]
    exposures = [(e.exposure_s or 0.0) * (e.iso or 1.0) / (e.f_number or 1.0) ** 2 for e in records]
    if all(exposures):
        values = values / np.array(exposures)[:, None, None] * np.median(exposures)
    return PhotoSamples(values, chosen)


@return_none_if_undetermined
def misfit_of(samples: PhotoSamples, directions: np.ndarray) -> float | None:
    """Compute the median misfit relative to the albedo under lamps in these directions (lights, 3)."""
    places, patches = spread_pixels(samples.values)
    values = samples.values.reshape(len(samples.values), -1)[:, places]
    fit = fit_lambert(values, directions[samples.chosen], patches)
    return float(np.nanmedian(np.abs(fit.residuals) / np.linalg.norm(fit.normals, axis=1)))


@dataclass(frozen=True)
class Verdict:
    """Evidence for near lamps at some positions, or far ones in those directions; both may stay open."""

    near: bool  # near, far: one explains the photographs clearly better, and the other would have shown
    far: bool
    width_mm: float = 0.0  # of the photographs on the object, where lamps are near; 0 where they do not show it
    factor: float = 0.0  # millimetres a unit of the positions; 0 where it is not known
    unit: str = ""  # name of that unit
    nearest: bool = False  # whether positions in millimetres are nearer than the photographs are wide, and not so near


def judge(samples: PhotoSamples, vectors: np.ndarray, columns: int, width_mm: float | None) -> Verdict:
    """Compare vectors (lights, 3) as directions and as positions, of lamps of any strength.

    columns : of the photographs; width_mm : on the object, where the user states it.
    """
    vectors = vectors[samples.chosen]
    lengths = np.linalg.norm(vectors, axis=1)
    found, distance = measure_width(samples.values, vectors), float(np.median(lengths))
    if found is None:
        return Verdict(False, False)
    if not found.is_certain:
        widest = max(found.width, 0.0) + SURE * found.sigma
        return Verdict(False, widest < TRIED_WIDTH * distance, nearest=max(distance, 2 * widest) < (width_mm or 0.0))
    if width_mm:
        exact = width_mm / found.width
        units = {**UNITS, "pixels": width_mm / columns}
        unit = min(units, key=lambda name: (abs(np.log(exact / units[name])), name))
        if abs(np.log(exact / units[unit])) < SAME_UNIT and np.abs(lengths - 1).max() > OFF_UNIT:
            return Verdict(True, False, width_mm, units[unit], unit)
        return Verdict(True, False, width_mm, exact, f"units of {exact:.4g} mm")
    known = MILLIMETRES[0] <= distance <= MILLIMETRES[1] and abs(found.width / columns - 1) > SAME_UNIT
    return Verdict(True, False, found.width, 1.0, "millimetres") if known else Verdict(True, False)


def choose_strengths(
    samples: PhotoSamples, vectors: np.ndarray, candidates: dict[str, np.ndarray], *, near: bool
) -> tuple[str, dict[str, float]]:
    """Choose the strengths (lights,) of the lamps that fit the photographs, by name, and report each residual.

    near: vectors (lights, 3) are positions, at which a lamp of strength 1 lights the middle by the inverse square of
    its distance. A course of strengths that is linear over the directions is like a tilt of the object, and left out.
    """
    lamps = vectors[samples.chosen]
    directions = lamps / np.linalg.norm(lamps, axis=1, keepdims=True)
    found = measure_gains(samples, lamps if near else directions, near=near)
    left: dict[str, float] = {}
    if found is None:
        return "", left
    for name, strengths in candidates.items():
        _, rest = split_course(found / strengths[samples.chosen], directions)
        left[name] = float(np.hypot(LEAST_STRENGTH, np.sqrt(np.mean(rest**2))))
    return min(left, key=lambda name: left[name]), left


@return_none_if_undetermined
def measure_gains(samples: PhotoSamples, vectors: np.ndarray, *, near: bool) -> np.ndarray | None:
    """Measure the strengths of the lamps at positions or in directions (photographs, 3)."""
    if near:
        found: NearLamps | None = measure_width(samples.values, vectors)
        return None if found is None else found.gains
    places, patches = spread_pixels(samples.values)
    return fit_lambert(samples.values.reshape(len(vectors), -1)[:, places], vectors, patches).gains


CODE_PAGES = "cp932 gbk big5 cp949 euc_jp cp1251 cp1253 cp1250 cp1252 mac_roman cp850 cp437 latin-1".split()
EVEN = 0.05  # spread of the lengths of one set of directions
SCALED = (0.1, 10.0)  # lengths of directions that were not normalised; equal ones beyond may be the radius of a dome
Sampler = Callable[[], PhotoSamples | None]


@dataclass(frozen=True)
class StatedLights:
    """Lamps of a file and its further statements."""

    lights: Lights  # names and vectors
    kind: str = "direction"  # `direction` or `position_mm`
    width_mm: float = 0.0  # width of the whole photographs on the object, 0 if it is not known
    pitch_mm: float = 0.0  # width of a pixel on the object, 0 if it is not known
    intensities: np.ndarray | None = None  # (lights, 1 or 3) float64 or None: relative strengths
    region: tuple[int, int, int, int] | None = None  # row, column, rows, columns that the file crops to
    # whether photographs have to tell directions from positions, see `decide`; without evidence they are directions
    # where `scaled`
    open_kind: bool = False
    scaled: bool = False  # whether the vectors are of one length near 1
    # (lights, 3) float64 or None: directions where the angles of the file are of another kind, `rival_kind`, or where
    # lamps turn out to be far
    rival: np.ndarray | None = None
    rival_kind: str = ""
    open_strengths: bool = False  # whether photographs have to tell what the intensities are, see `decide_strengths`
    shifts: np.ndarray | None = None  # (lights, 2) float64 or None: columns and rows in pixels, see `Frame.shift_px`


def read_lights_file(file: Path, kind: str | None, present: Collection[str]) -> StatedLights:
    """Read a `.lp`, a `.csv` or a list, as far as the file alone determines it.

    kind : one of LIGHT_KINDS, or None; present : names of the photographs, by which an old code page is recognised.
    CaptureError: those of `read_numbers` and `lights_from_vectors`, and lights-angles.
    """
    names, numbers = _read_names(file, present)
    stems, counts = {same_name(light_name(name)) for name in present}, [str(i + 1) for i in range(len(names))]
    names = [None] * len(names) if names == counts and not stems & set(counts) else names
    strengths = None
    first = np.array([number_of(name or "") for name in names])
    if numbers.shape[1] == 3 and names and np.isfinite(first).all() and (first % 1 != 0).all():  # no counts, no names
        names, numbers = [None] * len(names), np.column_stack([first, numbers])
    if numbers.shape[1] in (4, 6) and not _are_unit(numbers[:, -3:]):
        numbers, strengths = numbers[:, :3], numbers[:, 3:]
    elif numbers.shape[1] > 3:
        numbers = numbers[:, -3:]
    rival, rival_kind = None, ""
    if kind is None and _are_angles(numbers):
        raise CaptureError(_refuse_angles(file, numbers))
    if kind in ANGLES:
        swap = {"polar": "elevation", "elevation": "polar"}
        rival_kind = "_".join(swap.get(word, word) for word in str(kind).split("_"))
        numbers, rival, kind = _from_angles(numbers, str(kind)), _from_angles(numbers, rival_kind), "direction"
    if numbers.shape[1] != 3:
        what = f"expected three numbers x y z at the end of each line, found {numbers.shape[1]}"
        refuse("lights-unreadable", file.name, what)
    lengths = np.linalg.norm(numbers, axis=1)
    even = len(lengths) > 0 and np.ptp(lengths) <= EVEN * lengths.max()
    scaled = bool(even and SCALED[0] <= lengths.min() and lengths.max() <= SCALED[1])
    sound = len(lengths) > 0 and np.isfinite(lengths).all() and (lengths > 1e-9).all()
    open_kind = bool(kind is None and sound and (np.abs(lengths - 1) > OFF_UNIT).any())
    read_as = "position_mm" if open_kind else kind or "direction"
    lights = lights_from_vectors(names, numbers, file=file.name, kind=read_as)
    if strengths is not None and np.ptp(strengths, axis=0).max() < 1e-9:
        strengths = None
    stated = StatedLights(lights, kind or "direction", intensities=strengths, rival=rival, rival_kind=rival_kind)
    return replace(stated, open_kind=open_kind, scaled=scaled, open_strengths=strengths is not None)


def _read_names(file: Path, present: Collection[str]) -> tuple[list[str | None], np.ndarray]:
    """Read names and numbers, with the old code page in which the names match the photographs."""
    if is_unicode(file):
        return read_numbers(file)
    known = {same_name(name) for name in present} | {same_name(light_name(name)) for name in present}
    for encoding in CODE_PAGES:
        try:
            names, numbers = read_numbers(file, encoding)
        except CaptureError:
            if encoding == CODE_PAGES[-1]:  # decodes anything, so that something else is wrong
                raise
            continue
        if all(name is None or same_name(light_name(name)) in known for name in names):
            return names, numbers
    what = "the text encoding of the names is not known"
    remedy = "Save the file as UTF-8, or rename the photographs, there and in the folder, with plain letters a to z"
    refuse("lights-unreadable", file.name, what, expected="UTF-8", remedy=remedy)


def decide(stated: StatedLights, file: str, samples: Sampler, columns: int, width_mm: float | None) -> StatedLights:
    """Decide from the photographs whether open numbers are directions or positions, and in which unit.

    samples : gives samples of the photographs in the order of the lights; columns : of the photographs; width_mm : that
    the user states. CaptureError: lights-ambiguous where they do not tell, lights-contradicted where angles are of the
    other kind.
    """
    if stated.rival is not None and stated.rival_kind and (taken := samples()) is not None:
        own, other = (misfit_of(taken, directions) for directions in (stated.lights.directions, stated.rival))
        if own is not None and other is not None and other < CLEARLY * own:
            what = "the photographs contradict the kind of these angles"
            found = f"residual {own:.3g}, and {other:.3g} with the other kind"
            refuse("lights-contradicted", file, what, found=found, remedy=f"Give --lights-kind {stated.rival_kind}")
    if stated.kind == "direction" and not stated.open_kind:
        return replace(stated, width_mm=width_mm or stated.width_mm)
    if stated.kind == "position_mm" and stated.width_mm:  # as the file says itself
        return stated
    vectors, taken = stated.lights.vectors, samples()
    width = width_mm or stated.width_mm
    verdict = judge(taken, vectors, columns, width) if taken else Verdict(False, False)
    if verdict.near and verdict.factor:
        return _as_positions(stated, file, verdict, told=bool(width_mm))
    if stated.kind == "position_mm" and width_mm and not _are_unit(vectors) and not verdict.nearest:
        return replace(stated, width_mm=width_mm)
    if stated.open_kind and not verdict.near and (verdict.far or stated.scaled):
        far = vectors if stated.rival is None else stated.rival
        lights = lights_from_vectors(list(stated.lights.files), far, file=file, kind="direction")
        return replace(stated, lights=lights, open_kind=False, width_mm=width_mm or stated.width_mm)
    lengths = np.linalg.norm(vectors, axis=1)
    found = f"lengths {lengths.min():.4g} to {lengths.max():.4g}"
    if stated.kind == "position_mm" and width_mm:
        what = "the photographs do not show how far away the lamps are"
        if verdict.nearest:
            what = "the lamps are listed nearer than the photographs are wide, and do not light them so unevenly"
        remedy = "List the positions of the lamps in millimetres: multiply inches by 25.4, centimetres by 10"
    elif verdict.near or stated.kind == "position_mm":
        what = "the unit of the lamps' positions is not known"
        remedy = "Give the width of the whole photographs on the object in millimetres: --width-mm WIDTH"
    else:
        what = "the vectors may be directions or positions, and the photographs do not show which"
        remedy = "If they are positions, give --lights-kind position_mm --width-mm WIDTH (of the whole photographs)"
    refuse("lights-ambiguous", file, what, found=found, remedy=f"{remedy}; if directions, --lights-kind direction")


def _as_positions(stated: StatedLights, file: str, verdict: Verdict, *, told: bool) -> StatedLights:
    """Convert to positions in millimetres; warn where the photographs decided on them or on their unit."""
    lights = replace(stated.lights, vectors=stated.lights.vectors * verdict.factor)
    if stated.open_kind or verdict.factor != 1:
        what = (
            f"the numbers are read as positions in {verdict.unit}, because the light of the lamps falls off across the "
            f"photographs as it does over a width of {verdict.width_mm:.4g} mm"
        )
        remedy = "" if told else "Give the true width of the photographs on the object: --width-mm WIDTH"
        lights = replace(lights, warnings=(*lights.warnings, warning("lights-positions", file, what, remedy=remedy)))
    return replace(stated, lights=lights, kind="position_mm", width_mm=verdict.width_mm, open_kind=False)


def decide_strengths(stated: StatedLights, file: str, samples: Sampler) -> StatedLights:
    """Decide from the photographs whether further numbers of each line are strengths of the lamps or their factors."""
    if stated.intensities is None or not stated.open_strengths:
        return stated
    taken = samples()
    note, chosen = "were not used: the photographs do not show that they are strengths", None
    positive = np.isfinite(stated.intensities).all() and (stated.intensities > 0).all()
    if taken is not None and positive:
        strengths = stated.intensities / np.median(stated.intensities, axis=0)
        mean = strengths.mean(axis=1)
        names = ("", "strengths of the lamps", "factors that even the lamps out")
        candidates = dict(zip(names, (np.ones_like(mean), mean, 1 / mean), strict=True))
        near = stated.kind == "position_mm"
        best, left = choose_strengths(taken, stated.lights.vectors, candidates, near=near)
        if best and left[best] < CLEARLY * left[""]:
            chosen = strengths if best == names[1] else 1 / strengths
            note = f"are read as {best}"
    what = f"the further numbers of each line {note}"
    lights = replace(stated.lights, warnings=(*stated.lights.warnings, warning("lights-further-numbers", file, what)))
    return replace(stated, lights=lights, intensities=chosen)


def scale_to_middle(stated: StatedLights, file: str, samples: Sampler) -> StatedLights:
    """Convert strengths of near lamps at different distances to those of their light on the middle of the object.

    Lamps are taken to be equal where no strengths are stated, unless the photographs clearly show that each lights the
    middle alike.
    """
    lengths = np.linalg.norm(stated.lights.vectors, axis=1)
    if stated.kind != "position_mm" or np.ptp(lengths) <= EVEN * lengths.max():
        return stated
    light = (np.median(lengths) / lengths[:, None]) ** 2
    given = np.ones_like(light) if stated.intensities is None else stated.intensities
    if (taken := samples()) is not None:
        candidates = {"equal": given.mean(axis=1), "alike": given.mean(axis=1) / light[:, 0]}
        best, left = choose_strengths(taken, stated.lights.vectors, candidates, near=True)
        if best == "alike" and left["alike"] < CLEARLY * left["equal"]:
            return stated
    what = "lamps at different distances are assumed equally strong; intensities.csv lists their light on the middle"
    note = warning("lights-equal", file, what, found=f"{lengths.min():.4g} to {lengths.max():.4g} mm")
    notes = () if stated.intensities is not None else (note,)
    lights = replace(stated.lights, warnings=(*stated.lights.warnings, *notes))
    return replace(stated, lights=lights, intensities=given * light)


def _are_unit(vectors: np.ndarray) -> bool:
    return bool((np.abs(np.linalg.norm(vectors, axis=1) - 1) <= OFF_UNIT).all())


def _are_angles(numbers: np.ndarray) -> bool:
    """Check whether rows are two angles, or two angles and one radius for all."""
    if len(numbers) < 3 or not np.isfinite(numbers).all() or _are_unit(numbers):
        return False
    if numbers.shape[1] == 3 and np.ptp(numbers[:, 2]) > 1e-6 * np.abs(numbers[:, 2]).max():
        return False
    return any(_azimuth_at(numbers, column) for column in (0, 1))


def _full_turn(numbers: np.ndarray) -> float:
    """Return a full turn in the unit of angles in the first two columns: degrees where one exceeds it in radians."""
    return 360.0 if np.abs(numbers[:, :2]).max(initial=0.0) > 2 * np.pi + 0.01 else 2 * np.pi


def _azimuth_at(numbers: np.ndarray, column: int) -> bool:
    """Check that a column can be azimuths, and the other stays between plane and normal.

    Azimuths cover more than a third of the full turn, or else more than the other angle where the numbers are no
    vectors: two a line, or a radius so small beside them that all lamps would lie in the object's plane.
    """
    own, other, full = numbers[:, column], numbers[:, 1 - column], _full_turn(numbers)
    within = np.abs(own).max() <= 1.01 * full and other.min() >= 0 and other.max() <= full / 4 * 1.001
    none = (np.abs(numbers[:, 2:]) < IN_PLANE * np.linalg.norm(numbers[:, :2], axis=1, keepdims=True)).all()
    return bool(within and np.ptp(own) > (np.ptp(other) if none else full / 3))


def _refuse_angles(file: Path, numbers: np.ndarray) -> Problem:
    first = _azimuth_at(numbers, 0)
    kinds = [kind for kind in ANGLES if kind.startswith("azimuth") == first]
    unit, place = "degrees" if _full_turn(numbers) == 360 else "radians", "first" if first else "second"
    what = f"the lamps are given by angles in {unit}, with the azimuth {place}"
    remedy = (
        f"Give --lights-kind {kinds[0]} where the other angle counts from the object's plane, --lights-kind {kinds[1]} "
        "where from the normal. Write directions where the azimuth does not count from x (right) towards y (up)"
    )
    found = " ".join(f"{value:g}" for value in numbers[0])
    return error("lights-angles", file.name, what, expected="directions x y z", found=found, remedy=remedy)


def _from_angles(numbers: np.ndarray, kind: str) -> np.ndarray:
    """Compute directions (lights, 3) from two angles in the order that the kind names."""
    angles = numbers[:, :2] * (2 * np.pi / _full_turn(numbers))
    azimuth, height = angles.T if kind.startswith("azimuth") else angles.T[::-1]
    polar = height if "polar" in kind else np.pi / 2 - height
    return unit(polar, azimuth)
