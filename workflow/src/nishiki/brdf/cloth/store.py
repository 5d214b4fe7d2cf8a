"""Store the reflection model of a cloth in one `.npz` file, and sample any model as rows."""

import io
import zipfile
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path

import numpy as np

from nishiki.artifacts.declaration import Output, convert_to_declared
from nishiki.errors import UserError
from nishiki.formats.stored import load_arrays, understood
from nishiki.goniometry.directions import unit


def goniometer_rows(brdf, *, incident_deg, outgoing_deg) -> np.ndarray:
    """Tabulate theta_i, phi_i, theta_r, phi_r (degrees), then a value a channel (1 / sr), of all pairs of two lists.

    incident_deg (m, 2), outgoing_deg (n, 2): theta, phi.  The very columns of a capture's table of reflectances, so
    that an exported BRDF can be read as a measurement.
    """
    incident_deg, outgoing_deg = np.asarray(incident_deg, float), np.asarray(outgoing_deg, float)
    values = brdf.evaluate(unit(*np.radians(incident_deg.T))[:, None], unit(*np.radians(outgoing_deg.T))[None])
    angles = np.concatenate(
        [np.repeat(incident_deg, len(outgoing_deg), axis=0), np.tile(outgoing_deg, (len(incident_deg), 1))], axis=1
    )
    return np.concatenate([angles, values.reshape(len(angles), -1)], axis=1)


KINDS = {  # where the class of a kind is
    "bard_linear": "nishiki.brdf.cloth.normal_incidence:LinearBard",
    "bard_great_circle": "nishiki.brdf.cloth.normal_incidence:GreatCircleBard",
    "yarn_facets": "nishiki.brdf.cloth.yarn_facets:YarnFacets",
    "yarns": "nishiki.weave.yarn_weave:InterlacedYarns",
}
_KIND = "kind"
_EPOCH = (1980, 1, 1, 0, 0, 0)  # of every member: a file's bytes do not depend on when it was written


def save_brdf(path: Path, brdf, outputs: Iterable[Output] = ()) -> None:
    """Write a reflection model of a cloth to a `.npz` file.

    The same numbers give the same bytes; nothing is pickled.

    Parameters
    ----------
    path : str or Path
        File to write; one that exists is replaced.
    brdf : ClothBrdf
        Model, from `nishiki.fit_cloth` for example.
    outputs : iterable of Output
        Declarations that its arrays follow, of a stage that writes it.

    Raises
    ------
    OSError
        Where the file cannot be written.

    See Also
    --------
    read_cloth : Reads it back.

    Examples
    --------
    >>> import numpy as np
    >>> import nishiki
    >>> cloth = nishiki.read_cloth("results/satin/current/brdf.npz")
    >>> nishiki.write_cloth("cloth.npz", cloth)
    >>> again = nishiki.read_cloth("cloth.npz")
    >>> light, view = np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.0, 1.0])
    >>> bool((again.evaluate(light, view) == cloth.evaluate(light, view)).all())
    True
    """
    arrays = {name: np.asarray(values) for name, values in brdf.as_arrays().items()}
    arrays = {_KIND: np.array(brdf.KIND), **(convert_to_declared(outputs, arrays) if outputs else arrays)}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(arrays):
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(arrays[name], order="C"), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _EPOCH), member.getvalue(), zipfile.ZIP_DEFLATED)


def load_brdf(path: Path):
    """Read a reflection model of a cloth: a result of the stage cloth_brdf, or a file of `nishiki.write_cloth`.

    Parameters
    ----------
    path : str or Path
        The `.npz` file.

    Returns
    -------
    ClothBrdf
        Its method `evaluate(incident, outgoing)` takes unit vectors (..., 3), x weft, y warp, z normal, and gives the
        bidirectional reflectance in 1 / sr, (..., channels) float64.

    Raises
    ------
    nishiki.errors.UserError
        Where the file is missing, damaged, or holds no such model.

    See Also
    --------
    fit_cloth : Fits a model to measurements.

    Examples
    --------
    >>> import numpy as np
    >>> import nishiki
    >>> cloth = nishiki.read_cloth("results/satin/current/brdf.npz")
    >>> lights, view = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]]), np.array([0.0, 0.0, 1.0])
    >>> values = cloth.evaluate(lights, view)
    >>> values.shape == (2, cloth.channels)
    True
    """
    arrays = load_arrays(path, name=f"{path}: expected a stored BRDF (.npz)")
    if _KIND not in arrays:
        raise UserError(f"{path}: expected a stored BRDF with its kind, found arrays {sorted(arrays)}")
    kind = str(arrays.pop(_KIND))
    if kind not in KINDS:
        raise UserError(f"kind of BRDF: expected one of {', '.join(sorted(KINDS))}, found {kind!r}")
    module, name = KINDS[kind].split(":")
    with understood(path):
        return getattr(import_module(module), name).from_arrays(arrays)
