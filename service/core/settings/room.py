"""Settings of the treatment room: how the camera's picture lies relative to the couch."""

from pydantic import Field
from pydantic_settings import BaseSettings

from engine.core.head_direction import HeadDirection


class RoomSettings(BaseSettings):
    """The room; see docs/2-clinical/motion.md."""

    gantry_side: HeadDirection | None = Field(
        default=None,
        description="Side of the camera's picture towards the gantry, where the head of a head-first patient lies: "
        "top, bottom, left or right. A session's head direction and a plan's Patient Position are compared with it",
    )
