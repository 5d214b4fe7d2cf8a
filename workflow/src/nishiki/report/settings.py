"""Settings that the pages of all kinds of scenes have."""

from pydantic import Field

from nishiki.artifacts.closed import Guarded


class PageSettings(Guarded):
    """One HTML file that opens offline."""

    picture_columns: int = Field(720, ge=128, le=4096, description="width of the pictures inside the page")
    video_mb: float = Field(2.5, ge=0, le=64, description="largest video that the page carries; larger ones are named")
    title: str = Field("", description="heading; empty: title of the capture, or name of the scene")
    left_out: dict[str, str] = Field({}, description="what the plan leaves out, and why; filled in by the plan")
