"""Settings of the treatment room: its name, and how the camera's picture lies relative to the couch."""

from typing import Annotated

from pydantic import Field, StringConstraints
from pydantic_settings import BaseSettings

from engine.core.head_direction import HeadDirection

RoomName = Annotated[str, StringConstraints(max_length=32, pattern=r"^([A-Za-z0-9][A-Za-z0-9-]*)?$")]
"""1 to 32 letters, digits and dashes; empty is a room without a name."""


class RoomSettings(BaseSettings):
    """The room; see docs/2-clinical/motion.md."""

    room: RoomName = Field(
        default="",
        description="The room's name, 1 to 32 letters, digits and dashes: on the page, in stream, metrics, log, audit, "
        "backups and the names of cookies",
    )
    camera_uri: str = Field(
        default="",
        max_length=255,
        description="The room's camera, as `GET /devices` names it or the beginning of that, e.g. 1d27/0609@1: "
        "sessions open no other one; default: the session's choice, the first one where it makes none",
    )
    gantry_side: HeadDirection | None = Field(
        default=None,
        description="Side of the camera's picture towards the gantry, where the head of a head-first patient lies: "
        "top, bottom, left or right. A session's head direction and a plan's Patient Position are compared with it",
    )
