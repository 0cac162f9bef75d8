"""Schemas of the recordings that sessions may play."""

from pydantic import AwareDatetime, Field

from service.core.schemas.base import Answer


class Recording(Answer):
    """A recording in one of the site's folders, described by its first records; no frame is read."""

    path: str = Field(description="As in a session's `source.path`", examples=["demo/recording.oni"])
    bytes: int | None = Field(description="Size of the file")
    modified_at: AwareDatetime | None
    seconds: float | None = Field(description="Length as the file states it; null if it does not", examples=[40.0])
    width_px: int | None = Field(description="Of the depth pictures")
    height_px: int | None
    fps: int | None = Field(description="Nominal rate of the depth pictures [1/s]", examples=[30])
    has_color: bool | None = Field(description="Markers are found in colour: without it no session can be measured")
    problem: str | None = Field(description="Why it cannot be played; null if its first records are whole")


class RecordingPage(Answer):
    """Recordings by path; `next_cursor` is null on the last page."""

    items: list[Recording]
    next_cursor: str | None
