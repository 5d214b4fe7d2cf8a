"""Compute from polariser states which weighted sums of photographs give the components.

Stokes vectors (I, Q, U, V); angles from the first axis, the same way round for generator and analyser seen along the
light. Intensities are relative to the light that leaves the generator, as it would be without an analyser.

Every method here is linear in the photographs up to the last step, so that a view is separated by reading each of its
photographs once and adding it, weighted, to a few planes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from nishiki.artifacts.declaration import Closed, parse
from nishiki.errors import UserError
from nishiki.formats.files import read_text
from nishiki.formats.picture_process import read_matlab
from nishiki.formats.text_tables import load_plain


def polariser(angle: float) -> np.ndarray:
    """Return the Mueller matrix (4, 4) of an ideal linear polariser at `angle` (radians)."""
    c, s = np.cos(2 * angle), np.sin(2 * angle)
    return 0.5 * np.outer([1, c, s, 0], [1, c, s, 0])


def retarder(retardance: float, angle: float) -> np.ndarray:
    """Return a linear retarder (4, 4), fast axis at `angle`, radians: E. Collett, Field Guide to Polarization, 2005."""
    c, s, cd, sd = np.cos(2 * angle), np.sin(2 * angle), np.cos(retardance), np.sin(retardance)
    return np.array(
        [
            [1, 0, 0, 0],
            [0, c * c + s * s * cd, c * s * (1 - cd), -s * sd],
            [0, c * s * (1 - cd), s * s + c * c * cd, c * sd],
            [0, s * sd, -c * sd, cd],
        ]
    )


@dataclass(frozen=True)
class Arm:
    """One side of the instrument.

    A linear polariser, and before the object a retarder that turns (None: the polariser itself turns). retardance,
    polariser_angle, offset (of the turning part): radians.
    """

    retardance: float | None = None
    polariser_angle: float = 0.0
    offset: float = 0.0

    def generate(self, angle: float) -> np.ndarray:
        """Compute the Stokes vector (4,) of unit intensity that leaves the generator turned to `angle`."""
        if self.retardance is None:
            return 2 * polariser(angle + self.offset)[:, 0]
        return retarder(self.retardance, angle + self.offset) @ (2 * polariser(self.polariser_angle)[:, 0])

    def analyse(self, angle: float) -> np.ndarray:
        """Compute the row (4,) by which the analyser turned to `angle` weighs an incoming Stokes vector."""
        if self.retardance is None:
            return polariser(angle + self.offset)[0]
        return (polariser(self.polariser_angle) @ retarder(self.retardance, angle + self.offset))[0]


def design_matrix(generator: Arm, analyser: Arm, angles: np.ndarray) -> np.ndarray:
    """Build the design (n, 16): intensity of state k = row k times the surface's Mueller matrix, row by row.

    angles (n, 2) radians: generator, analyser.
    """
    return np.array([np.kron(analyser.analyse(a), generator.generate(g)) for g, a in angles])


LINEAR = tuple(4 * row + column for row in range(3) for column in range(3))


def solvable(design: np.ndarray) -> tuple[tuple[int, ...], float] | None:
    """Return the elements of the Mueller matrix (indices into 16) that a design determines, and its condition.

    They are all, or the nine of linear polarisation where nothing in the design depends on the others; None: neither.
    """
    for elements in (tuple(range(16)), LINEAR):
        rest = [k for k in range(16) if k not in elements]
        if len(design) < len(elements) or np.abs(design[:, rest]).max(initial=0) > 1e-9:
            continue
        sizes = np.linalg.svd(design[:, elements], compute_uv=False)
        if sizes[-1] > 1e-9 * sizes[0]:
            return elements, float(sizes[0] / sizes[-1])
    return None


def equal_steps(angles_deg: np.ndarray) -> np.ndarray:
    """Replace rounded angles by the n equal steps of 180/n that they stand for.

    Names like 23 and 68 mean 22.5 and 67.5; other angles are returned as they are.
    """
    angles_deg = np.asarray(angles_deg, np.float64)
    count = len(np.unique(angles_deg))
    step = 180 / max(count, 1)
    multiples = step * np.rint(angles_deg / step)
    rounded = np.abs(angles_deg - multiples) <= 0.5
    if rounded.all() and (angles_deg == np.rint(angles_deg)).all() and len(np.unique(multiples)) == count:
        return multiples
    return angles_deg


MATLAB = ("k_1_g", "k_2_g", "k_1_a", "k_2_a")


class ArmFile(Closed):
    """One arm in a file, in degrees.

    The angle in a state's name turns the retarder, or, without one, the polariser. retardance_deg, or its dispersion k1
    / wavelength + k2 / wavelength^3 (radians, nm).
    """

    polariser_deg: float = 0.0
    offset_deg: float = 0.0
    retardance_deg: float | None = None
    dispersion: tuple[float, float] | None = None


class InstrumentFile(Closed):
    """The content of calibration.yaml."""

    kind: Literal["polarimeter"] = "polarimeter"
    generator: ArmFile = Field(default_factory=ArmFile)
    analyser: ArmFile = Field(default_factory=ArmFile)


def read_instrument(path: Path) -> InstrumentFile:
    """Read a calibration: YAML as `InstrumentFile`, or MATLAB. UserError where it is neither.

    MATLAB: k_1_g, k_2_g, k_1_a, k_2_a (dispersion of the retarders of generator and analyser).
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        import yaml

        try:
            values = load_plain(read_text(path, "settings_bytes"))
        except (OSError, ValueError, yaml.YAMLError) as error:
            raise UserError(f"{path.name}: cannot be read ({error}). Remedy: check turntable.calibration") from None
        return parse(InstrumentFile, values, path.name)
    try:
        values = read_matlab(path, MATLAB)
        k = [float(values[name].ravel()[0]) for name in MATLAB]
    except (OSError, ValueError, TypeError, KeyError, IndexError) as error:
        raise UserError(
            f"{path.name}: no calibration of a polarimeter ({error}); expected YAML, or MATLAB with {', '.join(MATLAB)}"
        ) from None
    return InstrumentFile(generator=ArmFile(dispersion=(k[0], k[1])), analyser=ArmFile(dispersion=(k[2], k[3])))


def arms_of(file: InstrumentFile | None, *, wavelength_nm: float | None) -> tuple[Arm | None, Arm | None]:
    """Return generator and analyser in radians; (None, None) without a calibration.

    UserError where a dispersion is given and no wavelength.
    """
    if file is None:
        return None, None
    arms = []
    for arm in (file.generator, file.analyser):
        retardance = None if arm.retardance_deg is None else float(np.radians(arm.retardance_deg))
        if arm.dispersion is not None:
            if wavelength_nm is None:
                raise UserError(
                    "polarise: the dispersion of the calibration needs a wavelength. Remedy: set "
                    "polarise.wavelength_nm, or name the channel by it ('630 nm')"
                )
            k1, k2 = arm.dispersion  # Y. Queau et al., Optics Letters 43, 2018
            retardance = k1 / wavelength_nm + k2 / wavelength_nm**3
        arms.append(Arm(retardance, float(np.radians(arm.polariser_deg)), float(np.radians(arm.offset_deg))))
    return arms[0], arms[1]


MOST_CONDITION = 1e3  # of the least squares over angles
NEARLY = 1.0  # degrees: angles that count as parallel or crossed


@dataclass(frozen=True)
class StateSums:
    """method: none | circular | crossed | linear | pairs | mueller. states: names, in order; used: those that count."""

    method: str
    states: tuple[str, ...]
    # (planes, states) float64: plane p is sum_k weights[p, k] I_k. Planes: none: the photograph; circular: off, on;
    # crossed and pairs: parallel, crossed; linear: mean a, then the cosine and sine parts of twice the angle;
    # mueller: m00, m11, m22
    weights: np.ndarray
    condition: float  # of the least squares, 1 for plain sums
    design: np.ndarray  # (states, e): the way back; empty for plain sums
    inverse: np.ndarray  # (e, states): their weights
    elements: tuple[int, ...] = ()  # (e,): indices of the Mueller matrix that are solved for
    angles_deg: tuple[tuple[float, ...], ...] = ()  # as taken (equal steps whose names are rounded count as equal)
    used: int = 0


def sums_of(
    states: Sequence[str], *, generator: Arm | None = None, analyser: Arm | None = None, method: str = "auto"
) -> StateSums:
    """Build the sums for states: '' (none), off/on, analyser angles, or generator/analyser angles (degrees).

    generator, analyser: the instrument's arms where calibrated; without, angles are those of linear polarisers.
    method auto: generator/analyser series use the Mueller matrix where the arms are given or no parallel and crossed
    pair exists, else the pairs. Raises UserError where the states cannot be separated.
    """
    states = tuple(states)
    if method == "none" or len(states) == 1:
        first = states.index("off") if "off" in states else 0
        return _plain("none", states, np.eye(len(states))[first : first + 1])
    if set(states) == {"off", "on"}:
        order = np.array([[state == "off" for state in states], [state == "on" for state in states]], float)
        return _plain("circular", states, order)
    angles = _angles(states)
    if len(angles[0]) == 1:
        return _linear(states, angles[:, 0])
    return _series(states, angles, generator, analyser, method)


def _plain(method: str, states: tuple[str, ...], weights: np.ndarray, **rest) -> StateSums:
    nothing = np.zeros((len(states), 0))
    return StateSums(
        method, states, weights, 1.0, nothing, nothing.T, used=int((weights != 0).any(axis=0).sum()), **rest
    )


def _angles(states: tuple[str, ...]) -> np.ndarray:
    try:
        angles = [[float(part) for part in state.split("/")] for state in states]
        table = np.array(angles, np.float64).reshape(len(states), len(angles[0]))
        if not np.isfinite(table).all() or table.shape[1] > 2:
            raise ValueError("no angles")
        return table
    except ValueError:
        raise UserError(
            f"polariser states {', '.join(map(repr, states[:6]))}: expected off and on, analyser angles, or "
            "generator/analyser angles, all of one kind. Remedy: correct the column polariser of frames.csv"
        ) from None


def _linear(states: tuple[str, ...], angles: np.ndarray) -> StateSums:
    """Solve a + b cos 2(psi - psi0) = a + c cos 2 psi + s sin 2 psi, linear in a, c, s."""
    reported_angles = tuple((float(angle),) for angle in angles)
    distinct = np.unique(np.round(np.remainder(angles, 180.0), 6))
    if len(distinct) == 2 and abs(abs(distinct[1] - distinct[0]) - 90) <= NEARLY:
        groups = np.isclose(np.remainder(angles, 180.0)[None], distinct[:, None], atol=1e-5)
        return _plain("crossed", states, groups / groups.sum(axis=1, keepdims=True), angles_deg=reported_angles)
    psi = np.radians(equal_steps(angles))
    design = np.column_stack([np.ones(len(psi)), np.cos(2 * psi), np.sin(2 * psi)])
    sizes = np.linalg.svd(design, compute_uv=False)
    if len(distinct) < 3 or sizes[-1] * MOST_CONDITION < sizes[0]:
        raise UserError(
            f"analyser angles {', '.join(states)}: expected three or more well spread ones (0, 60, 120; 0, 45, 90, "
            "135), or two that are 90 degrees apart. Remedy: photograph more angles"
        )
    inverse = np.linalg.pinv(design)
    return StateSums(
        "linear",
        states,
        inverse,
        float(sizes[0] / sizes[-1]),
        design,
        inverse,
        angles_deg=reported_angles,
        used=len(states),
    )


def _series(states, angles, generator, analyser, method) -> StateSums:
    calibrated = generator is not None and analyser is not None
    steps = np.column_stack([equal_steps(angles[:, 0]), equal_steps(angles[:, 1])])
    reported_angles = tuple(map(tuple, steps.tolist()))
    parallel, crossed = _pairs(steps)
    if method == "pairs" or (method == "auto" and not calibrated and parallel.any()):
        if calibrated and (generator.retardance is not None or analyser.retardance is not None):
            raise UserError("method pairs needs linear polarisers; these states turn retarders. Remedy: method auto")
        if not parallel.any():
            raise UserError("polariser states: no generator angle has both its parallel and its crossed analyser")
        weights = np.stack([_each_generator(steps[:, 0], chosen) for chosen in (parallel, crossed)])
        return _plain("pairs", states, weights, angles_deg=reported_angles)
    design = design_matrix(generator or Arm(), analyser or Arm(), np.radians(steps))
    solution = solvable(design)
    if solution is None or solution[1] > MOST_CONDITION:
        raise UserError(
            f"{len(states)} generator/analyser states determine neither parallel and crossed images nor the Mueller "
            "matrix. Remedy: photograph some generator angles with the same analyser angle and one 90 degrees from it"
        )
    elements, condition = solution
    part = design[:, elements]
    inverse = np.linalg.pinv(part)
    places = [elements.index(k) for k in (0, 5, 10)]
    return StateSums(
        "mueller", states, inverse[places], condition, part, inverse, elements, reported_angles, used=len(states)
    )


def _pairs(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find parallel and crossed states, (states,) bool each, of the generator angles that have both."""
    apart = np.remainder(angles[:, 1] - angles[:, 0] + 90, 180) - 90
    parallel, crossed = np.abs(apart) <= NEARLY, 90 - np.abs(apart) <= NEARLY
    generators = np.remainder(angles[:, 0], 180)
    both = np.isin(generators, generators[parallel]) & np.isin(generators, generators[crossed])
    return parallel & both, crossed & both


def _each_generator(generators: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Compute weights (states,) of the mean over generator angles of the mean over the chosen states of each."""
    generators = np.round(np.remainder(generators, 180), 6)
    angles = np.unique(generators[chosen])
    counts = np.array([(chosen & (generators == angle)).sum() for angle in angles])
    places = np.searchsorted(angles, generators)
    return np.array([1 / (counts[k] * len(angles)) if c else 0.0 for k, c in zip(places, chosen, strict=True)])
