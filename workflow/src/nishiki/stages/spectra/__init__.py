"""Declare the stage `spectra`: settings, inputs, limits of its result, cost."""

from typing import Literal

from pydantic import Field

from nishiki.artifacts.declaration import Closed, Guarded, Limit, Output, at
from nishiki.stages.base import ARRAYS, Bases, Cost, SceneFacts, Stage, digest_of

LIMITS = (
    Limit(
        "condition",
        "condition of camera, lamp and bases",
        at("condition"),
        most=1e3,
        doubt=100,
        remedy="set spectra.bases to fewer, use a lamp with a broader spectrum, or take the stage from the products",
        why="captures gave 3 to 4; at 1000 noise of 0.1 % in a pixel is an error as large as the reflectance",
    ),
    *(
        Limit(f"{name}_pixels", f"pixels flagged {words}", at(f"flagged_{name}"))
        for name, words in (
            ("ill_conditioned", "badly conditioned"),
            ("negative_response", "negative response"),
            ("not_finite", "not finite"),
            ("outside_training", "unlike all training spectra"),
            ("outside_unit", "reflectance outside 0 to 1"),
        )
    ),
)


class SpectraSettings(Guarded, stage="spectra", version=2, limits=LIMITS):
    """Spectral reflectance from the camera's response."""

    method: Literal["local", "wiener", "paper"] = Field(
        "local", description="paper: three bases, inverse of H (Tominaga and Tanaka 2004, eq. 8)"
    )
    bases: Bases = Field(
        "auto", description="number of basis functions; auto: chosen by camera and lamp (docs/notes/economy.md)"
    )
    noise: float = Field(0.005, gt=0, le=1, description="standard deviation of a response, relative to white")
    training: str = Field("synthetic", description="synthetic, or a CSV: wavelength_nm, then one reflectance a column")
    training_sha256: str = Field("", description="digest of the training file; filled in by the plan")


def _no_spectra(facts: SceneFacts, settings: Closed) -> str | None:
    missing = [
        name
        for name, there in (
            ("camera sensitivities", facts.has_sensitivities),
            ("illuminant spectrum", facts.has_illuminant),
        )
        if not there
    ]
    return f"the capture has no {' and no '.join(missing)}" if missing else None


OUTPUTS = (
    Output("coefficients", "float32", "", "of the rows of the attribute basis, 400 to 700 nm every 5 nm"),
    Output(
        "sigma",
        "float32",
        "reflectance",
        "expected rms error over the bands; times the attribute profile: of each band",
    ),
    Output("flags", "uint8", "bits", "see docs/stages/spectra.md"),
)


STAGE = Stage(
    settings=SpectraSettings,
    does="spectral reflectance coefficients",
    outputs=OUTPUTS,
    of_mosaics=True,
    requires=("ingest", "normals"),
    missing_inputs=_no_spectra,
    filled=lambda block, settings: (
        {} if block.training == "synthetic" else {"training_sha256": digest_of(block.training, "spectra.training")}
    ),
    libraries=ARRAYS,
    threads=1,
    cost=lambda facts: Cost(mib=270, tiles=0.5, seconds=2.2, us_per_pixel=8),
    scatter=True,
)
