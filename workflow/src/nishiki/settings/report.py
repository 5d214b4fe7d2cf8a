"""Settings of report."""

from typing import ClassVar

from pydantic import Field

from nishiki.artifacts.closed import Guarded


class ReportSettings(Guarded):
    """One HTML file that opens offline."""

    STAGE: ClassVar[str] = "report"
    VERSION: ClassVar[int] = 1

    picture_columns: int = Field(720, ge=128, le=4096, description="width of the pictures inside the page")
    title: str = Field("", description="heading; empty: title of the capture")
    left_out: dict[str, str] = Field({}, description="what the plan leaves out, and why; filled in by the plan")
