"""Settings of a sweep: a block of the configuration, or a file of its own."""

from typing import Annotated, Any, Literal

from pydantic import Field

from nishiki.artifacts.closed import Closed

SweepName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]*$")]
Axis = Literal["seconds", "cpu_seconds"]


class MeasureSettings(Closed):
    """One error measure: a figure of the evaluation."""

    path: str = Field(
        description="dotted path into the evaluation's diagnostics or evaluation.json; * stands for every key, of "
        "which the mean is taken; {stage.setting} for a setting of the variant"
    )
    label: str = Field("", description="name of the figure; empty: its path")
    unit: str = Field("", description="unit of the figure")
    better: Literal["lower", "higher"] = Field("lower", description="whether less or more of it is better")


class SweepSettings(Closed):
    """Which settings vary on which scenes, what is measured, and which variants stand out."""

    scenes: tuple[str, ...] = Field((), description="scenes of the scene table; none named: all")
    stage: str = Field(description="stage whose settings vary; keys without a stage's name belong to it")
    vary: dict[str, Annotated[tuple[Any, ...], Field(min_length=1)]] = Field(
        {}, description="grid: setting (stage.setting, or a setting of `stage`) and its values; all combinations"
    )
    variants: dict[str, dict[str, Any]] = Field({}, description="variants by name, each with several settings")
    settings: dict[str, Any] = Field(
        {}, description="settings of all variants, as in a configuration, over those of the scenes"
    )
    default: str = Field("", description="variant that is the default; empty: the scene as it is configured")
    paper: str = Field("", description="variant that is the paper's method")
    peers: tuple[str, ...] = Field((), description="variants that are methods of others")
    apart: tuple[str, ...] = Field(
        (), description="variants that answer another question (other bytes, fewer products): shown, not compared"
    )
    repeats: int = Field(3, ge=1, le=100, description="timed runs of each variant, each alone on the machine")
    error: tuple[str | MeasureSettings, ...] = Field(
        (), description="error measures, the first one leads; none: the one usual for the stage and the kind of capture"
    )
    counted: tuple[str, ...] = Field(
        (), description="stages whose time counts; none: those that lead to the evaluation and are not equal everywhere"
    )
    axis: Axis = Field("seconds", description="time that is drawn and advised on; both are in the table")
    title: str = Field("", description="heading of the page; empty: the sweep's name")
