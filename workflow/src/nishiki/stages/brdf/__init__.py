"""Declare the stages of paintings, objects and cloths that fit a reflection model."""

from typing import Literal

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, Output, at, extreme
from nishiki.stages.base import ARRAYS, Cost, Measurements, Stage

PAINTING_LIMITS = (
    Limit("samples", "samples of the gloss, least region", extreme("samples", min)),
    Limit("residual", "rms residual of the gloss, worst region", extreme("residual")),
)


class BrdfSettings(Guarded, stage="brdf", version=6, limits=PAINTING_LIMITS):
    """Torrance-Sparrow parameters of a scene or of each region."""

    refractive_index: float = Field(
        1.45, gt=1, le=3, description="of the varnish or binder (Tominaga and Tanaka: 1.45)"
    )
    specular: Literal["auto", "keep", "drop"] = Field(
        "auto", description="auto: omitted where it does not better the prediction of captured lamps"
    )
    hold_out: tuple[str, ...] = Field((), description="lights left out of the fit; filled in by the plan")


PAINTING_OUTPUTS = (Output("labels", "uint8", "", "row of parameters.json; only where there are several"),)


PAINTING = Stage(
    settings=BrdfSettings,
    does="Torrance-Sparrow parameters",
    outputs=PAINTING_OUTPUTS,
    requires=("ingest", "normals"),
    libraries=ARRAYS,
    cost=lambda facts: Cost(mib=260, tiles=0.9, seconds=2.2, us_per_pixel=6, us_per_sample=0.02),
)


OBJECT_LIMITS = (
    Limit(
        "unseen_share",
        "share of the texels that no view shows",
        at("unseen_share"),
        most=0.5,
        doubt=0.2,
        remedy="views from more sides, or a mesh without inner surfaces",
        why="captures gave 0.02 to 0.07; a misplaced mesh gave 0.98",
    ),
    Limit(
        "psnr",
        "PSNR of the model over the samples, dB",
        at("psnr_db"),
        least=12,
        doubt=18,
        remedy="check object_brdf.lighting and the capture's lamp; cameras and mesh",
        why="captures gave 22 to 41; cameras in the reverse order gave 30 in place of 39.5 on an almost round jar",
    ),
    Limit("once_share", "share of the texels that one observation shows", at("once_share")),
    Limit("filled_share", "share of the texels whose gloss is their neighbours'", at("filled_share")),
    Limit("highlight_share", "share of the texels that a view shows near the mirror direction", at("highlight_share")),
)


class ObjectBrdfSettings(Guarded, stage="object_brdf", version=13, limits=OBJECT_LIMITS):
    """Lambert's term and a lobe of facets at every texel of an object."""

    lighting: Literal["auto", "camera", "fitted"] = Field(
        "auto",
        description="auto: the capture's lamps, fitted where it states none; one stated at the camera is placed beside "
        "it where that lowers the model's residual by a tenth; camera: a lamp at the camera; fitted: an irradiance "
        "over the normal whatever the capture states",
    )
    components: Literal["auto", "total"] = Field(
        "auto", description="where polarisation separated them, auto: the gloss from the specular part; total: not used"
    )
    specular: Literal["auto", "keep", "drop"] = Field(
        "auto", description="auto: Lambert alone where a sample of texels shows no gloss (docs/notes/economy.md)"
    )
    falloff: Literal["auto", "none", "inverse_square"] = Field(
        "auto", description="of a lamp at a place, over the depth of the object; auto: whichever fits better"
    )
    normals: Literal["auto", "mesh"] = Field(
        "auto", description="auto: turned to what the shading shows where that predicts hidden views; mesh: its own"
    )
    hold_out: tuple[str, ...] = Field((), description="views left out of the fit; filled in by the plan")


OBJECT_OUTPUTS = (  # (tile, row, column[, channel])
    Output("kd", "float32", "relative to white", "strength of the diffuse light in each channel"),
    Output("ks", "float32", "relative to white", "strength of the gloss in each channel"),
    Output("sigma", "float32", "radians", "width of the gloss"),
    Output(
        "flags",
        "uint8",
        "bits",
        "1 outside of the chart, 2 no certain value, 4 once, 8 never near a highlight, 16 gloss of neighbours",
    ),
)


OBJECT = Stage(
    settings=ObjectBrdfSettings,
    does="diffuse and specular parameters of every texel",
    outputs=OBJECT_OUTPUTS,
    store="parameters.zarr",
    geometry="turntable",
    requires=("ingest", "mesh", "texels"),
    libraries=ARRAYS,
    # with polarisers diffuse and specular part
    cost=lambda facts: Cost(
        mib=330, bytes_per_sample=40, seconds=3.5, us_per_sample=4.4 if len(facts.states) > 1 else 3.4
    ),
)


CLOTH_LIMITS = (
    Limit(
        "misfit",
        "relative rms error of the default model at the incidences that it was fitted to, worst region",
        lambda diagnostics: extreme(f"regions.*.{diagnostics.get('default')}.rms_rel_used")(diagnostics),
        most=1.5,
        doubt=1.0,
        remedy="set cloth_brdf.model, and check directions and regions of the capture",
        why="models gave 0.0003 to 0.95 where they were fitted; at 1.5 the errors are larger than the light",
    ),
)


Model = Literal["yarns", "yarn_facets", "bard_linear", "bard_great_circle"]


class ClothBrdfSettings(Guarded, stage="cloth_brdf", version=7, limits=CLOTH_LIMITS):
    """The BRDF of the whole hemisphere of every region, from normal incidence and a few oblique measurements."""

    model: Literal["auto", Model] = Field(
        "auto",
        description="the model that stands for the cloth; auto: yarns (of the stage weave) or yarn_facets, whichever "
        "predicts the oblique measurements better from normal incidence alone",
    )
    compare: tuple[Model, ...] = Field(("bard_linear", "bard_great_circle"), description="models fitted beside it")
    oblique: int = Field(
        20,
        ge=0,
        le=2000,
        description="most oblique measurements that a fit may use, best ones first; 0: normal incidence alone",
    )
    measurements: Measurements = Field(
        "auto",
        description="views of normal incidence that a fit uses: all; so many, evenly spread; auto: as many as predict "
        "the others within 1 % (docs/notes/economy.md)",
    )
    export: tuple[Literal["csv", "utia"], ...] = Field(
        ("csv",), description="csv: rows of angles and values; utia: .bin of doubles"
    )


CLOTH_OUTPUTS = (
    Output("body", "float64", "", "yarns, facets: albedo within the fibres", "channel"),
    Output("lambert", "float64", "", "albedo of the light that met several yarns", "channel"),
    Output("correction", "float64", "", "factor of the gloss by the half vector", "theta phi"),
    Output("images", "float64", "", "place of each oblique image that corrects the model", "image 4"),
    Output("image_weights", "float64", "", "weight of the image", "image"),
    Output("quarter", "bool", "", "mirror images in the planes of weft and warp are the same"),
    Output("rough", "float64", "", "roughness of warp and weft, along and across the fibres", "2 2"),
    Output("gain", "float64", "", "of all gloss"),
    Output("index", "float64", "", "refractive index of the fibres"),
    Output("slope", "float64", "", "facets: tangent of the tilts, warp and weft, along and across the yarn", "2 2"),
    Output("power", "float64", "", "facets: exponent of their distribution", "2 2"),
    Output("spacing", "float64", "", "facets: distance of the humps over their width", "2 2"),
    Output("weft_share", "float64", "", "facets: the weft's share of the cloth's plane"),
    Output("softness", "float64", "radians", "facets: scatter of the steepest tilts"),
    Output("binding", "int64", "yarns", "yarns: over, under, step, together", "4"),
    Output("spacing_ratio", "float64", "", "yarns: spacing of the weft over that of the warp"),
    Output("fill", "float64", "", "yarns: width of a yarn over its spacing, warp and weft", "2"),
    Output("aspect", "float64", "", "yarns: thickness over width, warp and weft", "2"),
    Output("crimp", "float64", "", "yarns: the warp's share of the amplitudes"),
    Output("bend", "float64", "spacings", "yarns: length on which a yarn changes sides"),
    Output("arch", "float64", "", "yarns: rise of a float over its period"),
    Output("tail", "float64", "", "yarns: share of GGX's long tails in the facets' distribution"),
    Output("soft", "float64", "", "yarns: softness of the shadows' edges"),
    Output("upright", "float64", "", "yarns: 1: sections stand across the yarn's way, 0: across the cloth"),
    Output("values", "float64", "1/sr", "bard: reflectance at normal incidence above the diffuse", "theta phi channel"),
    Output("diffuse", "float64", "1/sr", "bard: diffuse reflectance", "channel"),
)


CLOTH = Stage(
    settings=ClothBrdfSettings,
    does="reflectance for every direction of light and view",
    outputs=CLOTH_OUTPUTS,
    store="brdf.npz",
    geometry="goniometer",
    requires=("goniometer_samples",),
    optional_inputs=lambda settings: (
        ("weave",) * (not {"auto", "yarns"}.isdisjoint((settings.model, *settings.compare)))
    ),
    capture_parts=lambda facts, settings, asked: ("oblique",) * bool(settings["cloth_brdf"].oblique),
    libraries=("numpy", "scipy", "numba"),
    deliverables=("*.npz", "*.csv"),
    # it reads one reflectance of a photograph, whatever the photograph's size
    cost=lambda facts: Cost(mib=400, seconds=12 + 0.0025 * facts.measurements),
)
