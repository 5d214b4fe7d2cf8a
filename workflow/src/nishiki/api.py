"""Public functions of `nishiki` on whole captures and results, beside the functions that the stages call.

The workflow works band by band on files; these functions hold one capture or one object in memory.
"""

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from nishiki.errors import UserError, require

if TYPE_CHECKING:
    from nishiki.brdf.gloss_profile import GlossProfile
    from nishiki.photometric.solve import NormalField
    from nishiki.render.object.renderer import DecodedObject

STAGES_OF_OBJECT = ("cameras", "mesh", "texels", "object_brdf", "residual")


class Observed(NamedTuple):
    """Photographs of a flat object as linear values relative to a white board.

    Parameters
    ----------
    values : (lights, rows, columns, channels) float32 ndarray
        1 where a perfect white diffuser that faces the lamp would be; 0 where no value can be formed. Glossy
        highlights exceed 1.
    valid : (lights, rows, columns) bool ndarray
        Inside the object's mask, neither saturated nor at the lowest code nor defect.
    directions : (lights, 3) float64 or (lights, rows, columns, 3) float32 ndarray
        Unit vectors from the object's centre to the lamps; x right, y up, z towards the camera. Of lamps at a stated
        position those from each pixel, and without a white board their fall-off with the square of the distance is
        taken off the values.
    lights : tuple of str
        Names of the lamps.
    check : (lights,) bool ndarray
        Lamps kept for evaluation, which fits should not see.
    channels : tuple of str
        Names of the channels.

    See Also
    --------
    read_observations : Reads them from a capture folder.

    Examples
    --------
    >>> import nishiki
    >>> observed = nishiki.read_observations("captures/painting")
    >>> fit = ~observed.check
    >>> observed.values[fit].shape
    (4, 24, 32, 3)
    """

    values: np.ndarray
    valid: np.ndarray
    directions: np.ndarray
    lights: tuple[str, ...]
    check: np.ndarray
    channels: tuple[str, ...]

    def __repr__(self) -> str:
        lights, rows, columns, channels = self.values.shape
        return f"Observed({lights} lights, {rows} x {columns} pixels, {channels} channels)"


def read_observations(capture: str | Path, *, white_block: int = 16) -> Observed:
    """Read the photographs of a flat object under many lamps, relative to the white board.

    The dark level is subtracted and each lamp is divided by the white board under the same lamp, so that uneven light,
    exposure and gain cancel. The observations of all lamps are held in memory: 4 bytes for each lamp, pixel and
    channel.

    Parameters
    ----------
    capture : str or Path
        Capture folder of geometry `plane`, sealed or not; see "Capture folders" in the documentation.
    white_block : int, optional
        Side in pixels of the blocks over which the white board is averaged; 1 divides pixel by pixel
        (Tominaga and Tanaka, 2004, eq. 3).

    Returns
    -------
    Observed
        Values, what of them is valid, and the directions of the lamps.

    Raises
    ------
    nishiki.errors.UserError
        Where the capture cannot be used; the message lists everything that is wrong. Also for other geometries.

    References
    ----------
    S. Tominaga and N. Tanaka (2004), Measuring and rendering art paintings using a color camera, eq. 3.

    Examples
    --------
    >>> import nishiki
    >>> observed = nishiki.read_observations("captures/painting")
    >>> observed.lights
    ('L01', 'L02', 'L03', 'L04', 'L05')
    >>> observed.values.dtype, observed.values.shape
    (dtype('float32'), (5, 24, 32, 3))
    >>> bool(observed.valid.all())
    True
    """
    from nishiki.capture.folder import Capture, load_capture
    from nishiki.observations.plane import Observations
    from nishiki.observations.plane_store import write_observations
    from nishiki.stages.ingest import IngestSettings

    described = load_capture(capture)
    if not isinstance(described, Capture):
        raise UserError(
            f"{capture}: expected a capture of geometry plane, found {described.geometry}. Remedy: digitise it with "
            "the command `nishiki run`, and read the results"
        )
    with tempfile.TemporaryDirectory() as folder:
        settings: Any = IngestSettings(white_block=white_block)
        write_observations(described, folder, settings=settings)
        stored = Observations(folder)
        values, valid = stored.read(slice(0, stored.shape[0]))
        directions = stored.directions
        if stored.positions_mm is not None:
            directions = np.empty((*values.shape[:3], 3), np.float32)
            (rows, columns), (row, column) = stored.shape, stored.image_centre
            x, y = np.arange(columns) - column, row - np.arange(rows)
            for i, position in enumerate(stored.positions_mm):
                near = position / stored.pixel_pitch_mm
                away = np.broadcast_arrays(near[0] - x[None], near[1] - y[:, None], near[2])
                towards = np.stack(away, axis=-1)
                distance = np.linalg.norm(towards, axis=2, keepdims=True)
                directions[i] = towards / distance
                if not stored.white_board:
                    values[i] *= (distance / np.linalg.norm(near)) ** 2
        check = np.array([role == "check" for role in stored.roles])
        return Observed(values, valid, directions, stored.lights, check, stored.channels)


def read_photographs(folder: str | Path, **options) -> Observed:
    """Read a folder of photographs of a flat object, with the lamps that are found in it.

    Parameters
    ----------
    folder : str or Path
        Folder of photographs with a lights file, or with mirror balls in the frame; anything that `nishiki convert`
        takes for a flat object.
    **options
        Fields of `nishiki.capture.options.ConvertOptions`, which are the options of `nishiki convert`: `lights_file`,
        `white`, `mask`, `encoding` and others.

    Returns
    -------
    Observed
        Values, what of them is valid, and the directions of the lamps.

    Raises
    ------
    nishiki.errors.UserError
        Where no lamps are found, and where a photograph cannot be used; the message names the remedy.

    See Also
    --------
    read_observations : Reads a capture folder.

    Examples
    --------
    >>> import nishiki
    >>> observed = nishiki.read_photographs("photographs", encoding="linear")
    >>> observed.values.shape[0] == len(observed.lights)
    True
    """
    from nishiki.capture.convert import convert

    with tempfile.TemporaryDirectory() as parent:
        return read_observations(convert(folder, Path(parent, "capture"), **options).folder)


def find_lights(folder: str | Path, **options) -> dict[str, np.ndarray]:
    """Find the lamps of a folder of photographs: in its lights file, or on mirror balls in the frame.

    Parameters
    ----------
    folder : str or Path
        Folder of photographs of a flat object.
    **options
        As of `read_photographs`.

    Returns
    -------
    dict of str to (3,) float64 ndarray
        Unit vector to each lamp by its name; x right, y up, z towards the camera.

    Raises
    ------
    nishiki.errors.UserError
        Where no lamps are found.

    Examples
    --------
    >>> import nishiki
    >>> for name, direction in nishiki.find_lights("photographs").items():
    ...     print(name, direction.shape)
    a0 (3,)
    a1 (3,)
    a2 (3,)
    a3 (3,)
    """
    from nishiki.capture.convert import read_source
    from nishiki.capture.layouts import Layout
    from nishiki.capture.options import ConvertOptions
    from nishiki.capture.relightable import RelightableRendering

    layout = read_source(Path(folder), ConvertOptions(**options))
    if not isinstance(layout, Layout | RelightableRendering):
        raise UserError(f"{folder}: expected photographs of a flat object, found {layout.name}")
    return dict(zip(layout.lights.names, layout.lights.directions, strict=True))


def shade(normals, lights, reflectance=1.0, *, gloss: "GlossProfile | None" = None) -> np.ndarray:
    """Shade a normal map under distant lamps, seen from the front, without cast shadows.

    Parameters
    ----------
    normals : (rows, columns, 3) array_like of float
        Unit vectors; x right, y up, z towards the camera.
    lights : (lights, 3) or (3,) array_like of float
        Unit vectors to the lamps.
    reflectance : float, (rows, columns) or (rows, columns, channels) array_like, optional
        Reflectance of the body, relative to a perfect white.
    gloss : GlossProfile, optional
        Lobes of the surface, from `fit_gloss`. Default: a matt surface.

    Returns
    -------
    (lights, rows, columns, channels) float64 ndarray
        1 where a perfect white diffuser that faces the lamp would be; without the axis of the lights for one light,
        and without channels where the reflectance has none.

    Raises
    ------
    nishiki.errors.UserError
        For a lamp behind the object.

    Examples
    --------
    A matt plane of half the reflectance of white, under a lamp 30 degrees above it:

    >>> import numpy as np
    >>> import nishiki
    >>> normals = np.broadcast_to([0.0, 0.0, 1.0], (2, 3, 3))
    >>> picture = nishiki.shade(normals, [0.75**0.5, 0, 0.5], 0.5)
    >>> picture.shape, bool(np.allclose(picture, 0.25))
    ((2, 3), True)
    """
    from nishiki.brdf.gloss_profile import GlossProfile, predicted_radiance

    normals, reflectance, lights = (np.asarray(values, np.float64) for values in (normals, reflectance, lights))
    colours = reflectance if reflectance.ndim == normals.ndim else reflectance[..., None]
    colours = np.broadcast_to(colours, (*normals.shape[:-1], colours.shape[-1]))
    gloss = gloss or GlossProfile(np.zeros(1), np.ones(1), transmission=0.0)
    values = predicted_radiance(np.atleast_2d(lights), normals, colours, gloss)
    values = values if reflectance.ndim == normals.ndim else values[..., 0]
    return values if lights.ndim == 2 else values[0]


def fit_gloss(observations, directions, field: "NormalField", *, valid=None, refractive_index=1.45) -> "GlossProfile":
    """Fit the gloss that all pixels share to what the body's light leaves of their observations.

    Parameters
    ----------
    observations : (lights, rows, columns) array_like of float
        As of `estimate_normals`.
    directions : (lights, 3) array_like of float
        Unit vectors to the lamps.
    field : NormalField
        Normals and albedo of the same observations, from lights that `select_lights` chose; normals that are
        uncertain by more than 0.1 rad are left out.
    valid : (lights, rows, columns) array_like of bool, optional
        Samples to use. Default: all.
    refractive_index : float, optional
        Refractive index of the surface, above 1.

    Returns
    -------
    GlossProfile
        `beta` (lobes,), strengths relative to the white reference, all 0 for a matt surface, and `gamma` (lobes,),
        half widths at half maximum in radians.

    Raises
    ------
    nishiki.errors.UserError
        For a refractive index of 1 or less, and a lamp behind the object.

    References
    ----------
    S. Tominaga and N. Tanaka (2004), Measuring and rendering art paintings using a color camera, eq. 14 to 18.

    Examples
    --------
    A glossy ball under lamps all round, with its normals known:

    >>> import numpy as np
    >>> import nishiki
    >>> from nishiki.brdf.gloss_profile import GlossProfile
    >>> y, x = np.mgrid[0.7:-0.7:64j, -0.7:0.7:64j]
    >>> normals = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=-1)
    >>> angles = np.radians(np.arange(0, 360, 30))
    >>> lights = np.stack([0.6 * np.cos(angles), 0.6 * np.sin(angles), np.full(12, 0.8)], axis=1)
    >>> field = nishiki.estimate_normals(nishiki.shade(normals, lights, 0.4), lights, solver="least_squares")
    >>> gloss = GlossProfile(np.array([20.0]), np.array([0.1]), transmission=0.0)
    >>> glossy = nishiki.shade(normals, lights, 0.4, gloss=gloss)
    >>> found = nishiki.fit_gloss(glossy, lights, field)
    >>> bool(abs(found.value(0.05) / gloss.value(0.05) - 1) < 0.05)
    True
    """
    from nishiki.brdf import gloss_profile
    from nishiki.photometric.gloss import LARGEST_SIGMA

    matt = gloss_profile.GlossProfile(np.zeros(1), np.ones(1), refractive_index, transmission=0.0)
    values = np.asarray(observations, np.float64)
    known = field.valid & (field.sigma < LARGEST_SIGMA) & (True if valid is None else valid)
    samples = gloss_profile.specular_samples(
        values[..., None], directions, field.normals, field.albedo[..., None], matt, valid=known, shading=field.shading
    )
    histogram = gloss_profile.SpecularHistogram.empty(refractive_index=refractive_index)
    return gloss_profile.fit_gloss(histogram.add_samples(*samples, sigma=field.sigma), transmission=0.0)


def save_picture(path: str | Path, linear: np.ndarray, *, exposure: float = 1.0) -> None:
    """Save a picture: 8 bits of sRGB as .png, or the linear values as .exr.

    Parameters
    ----------
    path : str or Path
        File to write, .png or .exr.
    linear : (rows, columns, 3) or (rows, columns) array_like of float
        Linear sRGB, or linear grey; 1 is white.
    exposure : float, optional
        Factor of a .png.

    Returns
    -------
    None

    Raises
    ------
    nishiki.errors.UserError
        For another ending, another shape, and values that are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> import nishiki
    >>> nishiki.save_picture("ramp.png", np.linspace(0, 1, 256).reshape(1, 256).repeat(16, axis=0))
    """
    from nishiki.render.display import encode_display, write_exr, write_png

    path, values = Path(path), np.asarray(linear, np.float32)
    values = np.repeat(values[..., None], 3, axis=-1) if values.ndim == 2 else values
    if values.ndim != 3 or values.shape[2] != 3 or not np.isfinite(values).all():
        expected = "finite values of shape (rows, columns, 3) or (rows, columns)"
        raise UserError(f"picture: expected {expected}, found {np.shape(linear)}")
    if path.suffix == ".png":
        write_png(path, encode_display(values * np.float32(exposure)).pixels, stamp={})
    elif path.suffix == ".exr":
        write_exr(path, values, stamp={}, colours="srgb")
    else:
        raise UserError(f"{path}: expected a name that ends in .png or .exr")


def read_object(folder: str | Path) -> "DecodedObject":
    """Open a digitised and coded object: mesh, reflection model, and the residual that is decoded on demand.

    Parameters
    ----------
    folder : str or Path
        Folder `results/SCENE/current` of a finished turntable scene.

    Returns
    -------
    DecodedObject
        `views` and `lights` are the names of what was captured; `residual.decode(tile)` gives the decoded residual of
        one tile, a (observations, T, T, channels) float32 ndarray in the encoding of the capture; `renderer()` makes
        pictures of any view of the turn.

    Raises
    ------
    nishiki.errors.UserError
        Where a stage of the object is missing or damaged.

    See Also
    --------
    render_view : Renders a captured view of the object.

    References
    ----------
    D. Miyazaki, T. Shibata and K. Ikeuchi (2007), Wavelet-Texture method.

    Examples
    --------
    >>> import nishiki
    >>> jar = nishiki.read_object("results/jar/current")
    >>> len(jar.views), jar.channels
    (12, 3)
    >>> residual = jar.residual.decode(0)
    >>> residual.shape == (len(jar.views) * len(jar.lights), jar.residual.size, jar.residual.size, 3)
    True
    """
    from nishiki.artifacts.artifact import open_artifact
    from nishiki.render.object.renderer import DecodedObject

    folder = Path(folder)
    missing = [stage for stage in STAGES_OF_OBJECT if not (folder / stage).is_dir()]
    if missing:
        raise UserError(
            f"{folder}: expected the results of {', '.join(STAGES_OF_OBJECT)}, found no {missing[0]}. Remedy: give the "
            "folder `current` of a finished turntable scene"
        )
    stages = [stage for stage in ("ingest", *STAGES_OF_OBJECT) if (folder / stage).is_dir()]
    return DecodedObject.open({stage: open_artifact((folder / stage).resolve()) for stage in stages})


def render_view(
    decoded: "DecodedObject", view: str, *, lights: dict[str, float] | None = None, predicted: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Render a captured view of a coded object, from its own residual or from that of its neighbours.

    Parameters
    ----------
    decoded : DecodedObject
        Object, from `read_object`.
    view : str
        Name of the view, one of `decoded.views`.
    lights : dict of str to float, optional
        Weights of the captured lights, by name. Default: the first light, with weight 1.
    predicted : bool, optional
        True: interpolate the residual between the neighbouring views, as for a view that was never photographed.

    Returns
    -------
    linear : (rows, columns, channels) float32 ndarray
        Linear light relative to the white board, 0 beyond the object.
    covered : (rows, columns) bool ndarray
        Pixels whose centre shows the object.

    Raises
    ------
    nishiki.errors.UserError
        Where a view or a light of that name does not exist, or the residual is damaged.

    References
    ----------
    D. Miyazaki, T. Shibata and K. Ikeuchi (2007), Wavelet-Texture method, eq. 12 to 16.

    Examples
    --------
    >>> import nishiki
    >>> jar = nishiki.read_object("results/jar/current")
    >>> linear, covered = nishiki.render_view(jar, jar.views[0])
    >>> linear.shape, linear.dtype
    ((96, 96, 3), dtype('float32'))
    >>> bool((linear[covered] > 0).mean() > 0.9)
    True
    """
    number, weights = decoded.number(view), decoded.light_weights(lights or {})
    renderer = decoded.renderer()
    shot = renderer.predicted(number) if predicted else renderer.captured(number)
    picture = next(renderer.render([shot.lit_by(weights)]))
    return picture.linear, picture.covered


def fit_cloth(
    incident: np.ndarray,
    outgoing: np.ndarray,
    values: np.ndarray,
    *,
    model: str = "yarn_facets",
    symmetry: str = "quarter",
    oblique: int = 20,
):
    """Fit a reflection model of a woven cloth to measured reflectances.

    Every model needs measurements that are lit along the normal; `yarns` and `yarn_facets` also use oblique ones.

    Parameters
    ----------
    incident, outgoing : (n, 3) array_like of float
        Directions from the cloth to the lamp and to the camera, in the frame x weft, y warp, z normal. They need not
        have unit length.
    values : (n, channels) array_like of float
        Bidirectional reflectance, in 1 / sr, zero or more. (n,) is taken as one channel.
    model : str, optional
        `yarns` (interlaced yarns, whose weave is searched: about half a minute), `yarn_facets`, `bard_linear` or
        `bard_great_circle`.
    symmetry : {'quarter', 'half', 'none'}, optional
        Symmetry of the reflectance at normal incidence: two mirror planes, a half turn, or none.
    oblique : int, optional
        Largest number of obliquely lit measurements that the fit uses; they are chosen where they tell most.

    Returns
    -------
    model of `nishiki.brdf.cloth`
        Its method `evaluate(incident, outgoing)` takes unit vectors (..., 3) that broadcast against each other and
        gives the bidirectional reflectance in 1 / sr, (..., channels) float64, 0 below the horizon.

    Raises
    ------
    nishiki.errors.UserError
        For an unknown model, too few measurements, or measurements that are all black.
    ValueError
        For arrays whose shapes disagree and values that are not finite.

    See Also
    --------
    read_cloth, write_cloth : Store a fitted model.

    References
    ----------
    Y. Takeda, V. H. Q. Huy, S. Takemura, Y. Sakaguchi and H. T. Tanaka, Image-based anisotropic reflectance modeling
    of woven fabrics for digital archive of Noh costume, eq. 5 to 9 (the models `bard_linear` and `bard_great_circle`).

    Examples
    --------
    A cloth with a broad gloss, measured from 60 directions under each of two lamps:

    >>> import numpy as np
    >>> import nishiki
    >>> angles = np.radians(np.stack(np.meshgrid(np.arange(0, 75, 15), np.arange(0, 360, 30)), -1).reshape(-1, 2))
    >>> polar, azimuth = angles.T
    >>> views = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)
    >>> lamps = np.array([[0, 0, 1], [0.6, 0, 0.8]])
    >>> incident, outgoing = np.repeat(lamps, 60, axis=0), np.tile(views, (2, 1))
    >>> half = incident + outgoing
    >>> half /= np.linalg.norm(half, axis=1, keepdims=True)
    >>> values = 0.05 + 0.01 * half[:, 2:] ** 40 / (incident[:, 2:] * outgoing[:, 2:])
    >>> cloth = nishiki.fit_cloth(incident, outgoing, values)
    >>> predicted = cloth.evaluate(incident, outgoing)
    >>> predicted.shape
    (120, 1)
    >>> bool(np.abs(predicted / values - 1).max() < 0.1)
    True
    """
    from nishiki.brdf.cloth.models import MODELS, fit_models
    from nishiki.brdf.cloth.yarn_fit import Measured
    from nishiki.goniometry.hemisphere import complete
    from nishiki.goniometry.table import ReflectanceSet

    if model not in MODELS:
        raise UserError(f"model of a cloth: expected one of {', '.join(MODELS)}, found {model!r}")
    measured = ReflectanceSet.of(np.asarray(incident), np.asarray(outgoing), np.asarray(values), symmetry=symmetry)
    measured = complete(measured)[0]
    completed = require(measured.basic)
    basic = (completed.evaluate, completed.values[0])
    of, yarns = Measured.of(measured), None
    if model == "yarns":
        from nishiki.weave.yarn_search import search_yarns
        from nishiki.weave.yarn_weave import bindings

        best = search_yarns(of, bindings()).best
        yarns = best.brdf, {"rms_rel_normal": best.rms_rel}
    return fit_models(of, basic, (model,), oblique=oblique, yarns=yarns)[model].brdf
