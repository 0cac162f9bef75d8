"""The query parameters of `/live` and `/live/events`."""

from enum import StrEnum
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from service.core.schemas.base import Identifier

SLOWEST_HZ, FASTEST_HZ = 0.2, 60.0
LAST_FRAME = 2**53


class Form(StrEnum):
    """Form of the samples."""

    FULL = "full"
    THIN = "thin"


class Encoding(StrEnum):
    """Encoding of messages on a WebSocket."""

    JSON = "json"
    MSGPACK = "msgpack"


class EventsQuery(BaseModel):
    """Parameters of both transports."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    rate_hz: Annotated[
        float | None,
        Field(
            ge=SLOWEST_HZ,
            le=FASTEST_HZ,
            description="Maximum rate of samples, evenly spaced, each the newest; the camera's rate "
            "when left out. A change of the gate is sent at once, whatever the rate",
            examples=[5.0],
        ),
    ] = None
    form: Annotated[
        Form, Field(description="`thin` contains only what monitors of the gate need", examples=["thin"])
    ] = Form.FULL
    session_id: Annotated[
        Identifier | None, Field(description="With `after_frame`: the session before the reconnection")
    ] = None
    after_frame: Annotated[
        int | None,
        Field(ge=-1, le=LAST_FRAME, description="Index of the last frame received; -1 for none", examples=[512]),
    ] = None

    @model_validator(mode="after")
    def _resumes_with_both(self) -> Self:
        if (self.session_id is None) != (self.after_frame is None):
            missing, given = ("session_id", "after_frame") if self.session_id is None else ("after_frame", "session_id")
            raise PydanticCustomError(
                "inconsistent",
                "{field} must be {bound}",
                {"field": missing, "value": "missing", "bound": f"given together with {given}"},
            )
        return self


class LiveQuery(EventsQuery):
    """Parameters of the WebSocket."""

    encoding: Annotated[
        Encoding, Field(description="`msgpack`: the same messages as binary frames", examples=["json"])
    ] = Encoding.JSON


Transport = Literal["websocket", "sse"]
