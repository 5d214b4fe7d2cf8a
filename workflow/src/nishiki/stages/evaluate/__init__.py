"""Declare the stages that compare paintings, objects and cloths with truth and with unseen photographs."""

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, Output, excess
from nishiki.stages.base import ARRAYS, OPENCV, Cost, Stage, photographs_or_states


class EvaluateSettings(Guarded, stage="evaluate", version=2):
    """Comparison with truth where there is one, otherwise with lights that no fit used."""

    cast_shadows: bool = Field(True, description="predict cast shadows from the integrated height")
    lamp_diameter_deg: float = Field(
        1.0, ge=0, le=20, description="size of the lamps seen from the object, for the edges of cast shadows"
    )
    hold_out: tuple[str, ...] = Field((), description="lights to predict; filled in by the plan")
    truth_sha256: str = Field("", description="digest of the truth; filled in by the plan")


PAINTING_OUTPUTS = (
    Output("angular_error", "float32", "degrees", "angle to the true normal"),
    Output("reflectance_de00", "float32", "CIEDE2000", "of the spectra, under D65"),
    Output("regions", "int32", "", "region of the truth: row of region_names, or of its spectra"),
    Output("de00_NNN", "float32", "CIEDE2000", "of the light predicted under lamp NNN"),
    Output("classes_NNN", "uint8", "", "what the pixel shows under lamp NNN"),
)


PAINTING = Stage(
    settings=EvaluateSettings,
    does="errors against truth, or on lights that the fit never saw",
    outputs=PAINTING_OUTPUTS,
    of_mosaics=True,
    requires=("ingest", "normals"),
    optional_inputs=lambda settings: ("height",) * settings.cast_shadows + ("spectra", "brdf"),
    missing_inputs=lambda facts, settings: (
        None
        if facts.truth_sha256 or facts.check_lights or settings.hold_out
        else "there is no truth, the capture has no check lights and no light is held out (set hold_out)"
    ),
    capture_parts=lambda facts, settings, asked: ("check",),
    libraries=ARRAYS,
    cost=lambda facts: (
        Cost(mib=390, bytes_per_pixel=160, seconds=2.8, us_per_pixel=16)
        if facts.truth_sha256
        else Cost(mib=360, bytes_per_pixel=40, seconds=2.4, us_per_pixel=16)
    ),
)


OBJECT_LIMITS = (
    Limit(
        "below_jpeg2000",
        "dB by which captured views come back below JPEG 2000 at equal bytes",
        excess("jpeg2000.psnr_db", "jpeg2000.decoded_psnr_db"),
        most=4,
        warns=True,
        remedy="look where the surface misses the outlines and where views contradict each other on it: silhouettes, "
        "cameras, hollows; give masks or a scan, or more bytes (residual.amount)",
        why="four path-traced objects came back from 2.1 dB below to 2.3 above",
    ),
)


class ObjectEvaluateSettings(Guarded, stage="object_evaluate", version=6, limits=OBJECT_LIMITS):
    """The decoded object against its photographs, and its size."""

    pictures: int = Field(3, ge=0, le=64, description="captured views shown beside their photographs, evenly spread")
    columns: int = Field(480, ge=64, le=4096, description="largest width of those pictures")
    similarity: bool = Field(True, description="also structural similarity")
    hold_out: tuple[str, ...] = Field((), description="views left out of the fit; filled in by the plan")
    truth_sha256: str = Field("", description="digest of the truth; filled in by the plan")


OBJECT = Stage(
    settings=ObjectEvaluateSettings,
    does="errors of rendered views against photographs, truth and views left out",
    geometry="turntable",
    product="evaluate",
    requires=("ingest", "mesh", "cameras", "texels", "object_brdf", "residual"),
    optional_inputs=lambda settings: ("polarise",),
    capture_parts=photographs_or_states,
    libraries=(*ARRAYS, "pywavelets", OPENCV, "dracopy", "imagecodecs"),
    cost=lambda facts: Cost(mib=380, bytes_per_sample=90, seconds=5, us_per_sample=3),
)


class ClothEvaluateSettings(Guarded, stage="cloth_evaluate", version=2):
    """The cloth's models against measurements that their fits did not use."""

    curves: int = Field(
        12, ge=0, le=200, description="incidences of each region whose plane is drawn, measured beside predicted"
    )
    regions: tuple[str, ...] = Field((), description="regions to judge; none named: all")


CLOTH = Stage(
    settings=ClothEvaluateSettings,
    does="errors of the predicted against the measured reflectance",
    geometry="goniometer",
    product="evaluate",
    requires=("goniometer_samples", "cloth_brdf"),
    missing_inputs=lambda facts, settings: (
        None
        if facts.measurements > facts.frontal or facts.truth_sha256
        else "the light stood at the normal of the cloth in every measurement: none is left to compare with"
    ),
    capture_parts=lambda facts, settings, asked: ("oblique",),
    libraries=("numpy", "scipy", "numba"),
    deliverables=("*.csv",),
    threads=1,
    cost=lambda facts: Cost(mib=230, seconds=2, us_per_sample=0.05),
)
