"""The calibration of a polarimeter: what its generator and its analyser are made of."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from nishiki.artifacts.closed import Closed, parse
from nishiki.errors import UserError
from nishiki.formats import plain_yaml
from nishiki.formats.files import read_text
from nishiki.formats.matlab import read_matlab
from nishiki.polarisation.mueller import Arm, retardance_of

MATLAB = ("k_1_g", "k_2_g", "k_1_a", "k_2_a")


class ArmFile(Closed):
    """One arm as a file describes it, in degrees. What turns by the angle in a state's name is the retarder, or,
    without one, the polariser. retardance_deg, or its dispersion k1 / wavelength + k2 / wavelength^3 (radians, nm)."""

    polariser_deg: float = 0.0
    offset_deg: float = 0.0
    retardance_deg: float | None = None
    dispersion: tuple[float, float] | None = None


class InstrumentFile(Closed):
    """calibration.yaml."""

    kind: Literal["polarimeter"] = "polarimeter"
    generator: ArmFile = Field(default_factory=ArmFile)
    analyser: ArmFile = Field(default_factory=ArmFile)


def read_instrument(path: Path) -> InstrumentFile:
    """Read a calibration: YAML as `InstrumentFile`, or MATLAB with k_1_g, k_2_g, k_1_a, k_2_a (dispersion of the
    retarders of generator and analyser). UserError where it is neither."""
    if path.suffix.lower() in (".yaml", ".yml"):
        import yaml

        try:
            values = plain_yaml.load(read_text(path, "settings_bytes"))
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
    """Generator and analyser in radians; (None, None) without a calibration. UserError where a dispersion is given and
    no wavelength."""
    if file is None:
        return None, None
    arms = []
    for arm in (file.generator, file.analyser):
        retardance = None if arm.retardance_deg is None else float(np.radians(arm.retardance_deg))
        if arm.dispersion is not None:
            if wavelength_nm is None:
                raise UserError(
                    "polarise: the calibration gives the retarders' dispersion, and the wavelength is not known. "
                    "Remedy: set "
                    "polarise.wavelength_nm, or name the channel by it ('630 nm')"
                )
            retardance = retardance_of(*arm.dispersion, wavelength_nm)
        arms.append(Arm(retardance, float(np.radians(arm.polariser_deg)), float(np.radians(arm.offset_deg))))
    return arms[0], arms[1]
