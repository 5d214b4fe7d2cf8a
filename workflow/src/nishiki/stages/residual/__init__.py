"""Declare the stage `residual`: settings, inputs, limits of its result, cost."""

from typing import Literal

from pydantic import Field

from nishiki.artifacts.declaration import Guarded, Limit, at, excess
from nishiki.stages.base import ARRAYS, OPENCV, Cost, Stage, photographs_or_states

LIMITS = (
    Limit(
        "loss",
        "how much worse the stored result is than the model that it refines, dB",
        excess("model_psnr_db", "psnr_db"),
        most=1,
        doubt=0,
        remedy="a finer residual.amount, or leave the stage out",
        why="a residual adds 0.4 to 17 dB; a step so coarse that it costs 1 is worse than none",
    ),
    Limit("empty_tiles", "tiles for which the model suffices", at("empty_tiles")),
)


class ResidualSettings(Guarded, stage="residual", version=18, limits=LIMITS):
    """Residual of the reflection model, as wavelet coefficients."""

    target: Literal["bits_per_pixel", "bytes", "total_bytes", "psnr"] = Field(
        "bits_per_pixel",
        description="what `amount` means: bits for each object pixel of each picture; bytes of the store; bytes of "
        "all that a renderer needs (mesh, charts, cameras and lamps too); dB inside the silhouette",
    )
    amount: float = Field(0.5, gt=0, description="the target's value; parameters and start states count")
    sufficient: Literal["auto", "never"] = Field(
        "auto", description="auto: no residual where the model reaches `psnr` or noise (docs/notes/economy.md)"
    )
    passes: int = Field(6, ge=1, le=20, description="passes over all tiles that the search may take")
    model: bool = Field(True, description="false: image-based, nothing is subtracted (a baseline)")
    wavelet: str = Field("bior4.4", description="of the tile's planes: haar, db2 (the paper's), sym4, bior4.4, ...")
    levels: int = Field(4, ge=0, le=8, description="halvings of the tile's planes")
    view_transform: str = Field(
        "db2", description="along the views: an orthonormal wavelet, cosine, or none (2-D coding of each view)"
    )
    arcs: bool = Field(True, description="a tile's block spans only the views that see it")
    rounds: int = Field(6, ge=0, le=100, description="of the solver, per tile and pass: choices of the coefficients")
    refinements: int = Field(12, ge=0, le=500, description="of the parameters in the pictures; 0: as fitted to texels")
    hold_out: tuple[str, ...] = Field((), description="views left out of the residual; filled in by the plan")


STAGE = Stage(
    settings=ResidualSettings,
    does="captured minus model, as coded wavelet coefficients",
    geometry="turntable",
    requires=("ingest", "mesh", "cameras", "texels", "object_brdf"),
    optional_inputs=lambda settings: ("polarise",),
    capture_parts=photographs_or_states,
    libraries=(*ARRAYS, OPENCV, "pywavelets", "dracopy"),
    cost=lambda facts: Cost(mib=300, bytes_per_sample=38, seconds=6, us_per_sample=17),
)
