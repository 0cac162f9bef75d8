"""Encodes each message once per shape; all clients of that shape get the same bytes.

The query parameters of `/live` and `/live/events`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from typing import Annotated, Literal, Protocol, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from engine.core.clock import NS_PER_MS
from service.core.schemas.base import Identifier
from service.core.schemas.live_messages import Hello, Message, Sample, ThinSample
from service.engine_host.protocols import LiveFrame

SLOWEST_HZ, FASTEST_HZ = 0.2, 60.0
LAST_FRAME = 2**53
Transport = Literal["websocket", "sse"]
FRESH_S = 0.1
"""A message that waited longer is encoded again, so that its age is correct when it is sent."""
THIN = tuple(name for name in ThinSample.model_fields if name not in {"type", "form", "latency_ms"})
PING_COMMENT = b": ping\n\n"


class Form(StrEnum):
    """Form of the samples."""

    FULL = "full"
    THIN = "thin"


class StreamQuery(BaseModel):
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


@dataclass(frozen=True, slots=True)
class Shape:
    """Transport and form of a client's messages."""

    transport: Transport
    form: Form


class EncodedMessage(Protocol):
    """A message that can be encoded in any shape."""

    def payload(self, shape: Shape) -> str | bytes:
        """Return the encoded message; all clients of the shape get the same object."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamClock:
    """The three clocks of the stream: event loop, engine (monotonic) and wall clock."""

    now_s: Callable[[], float]
    now_ns: Callable[[], int]
    utc: Callable[[], datetime] = lambda: datetime.now(UTC)


class MessageEncoder:
    """Encodes messages and counts them."""

    def __init__(self, clock: StreamClock) -> None:
        self.clock = clock
        self.encoded_count = 0

    def encode(self, message: Message, shape: Shape, event_id: str | None = None) -> str | bytes:
        """Encode a message in a shape."""
        self.encoded_count += 1
        return encode(message, shape, event_id)


class Plain:
    """A message that is the same in the full and the thin form."""

    def __init__(self, message: Message, encoder: MessageEncoder) -> None:
        self._message = message
        self._encoder = encoder
        self._encoded: dict[Transport, str | bytes] = {}

    def payload(self, shape: Shape) -> str | bytes:
        """Return the encoded message; encoded once per transport."""
        if shape.transport not in self._encoded:
            self._encoded[shape.transport] = self._encoder.encode(self._message, shape)
        return self._encoded[shape.transport]


class Frame:
    """A frame of the running session, with its position in the stream.

    Attributes
    ----------
    sequence
        Sequence number of the hub.
    is_change
        Whether gate, hold reason or beam line differ from the frame before.
    is_repeat
        Whether it has the depth frame of the one before: the gate changed between two frames.
    missed
        Frames between the one before and this one that the hub did not read.
    """

    def __init__(
        self, live: LiveFrame, *, sequence: int, is_change: bool, is_repeat: bool, missed: int, encoder: MessageEncoder
    ) -> None:
        self.live = live
        self.missed = missed
        self.sequence = sequence
        self.is_change = is_change
        self.is_repeat = is_repeat
        self._encoder = encoder
        self._full: tuple[float, Sample] | None = None
        self._encoded: dict[Shape, tuple[float, str | bytes]] = {}

    @property
    def session_id(self) -> str:
        """Id of the session."""
        return self.live.message.session_id

    @property
    def index(self) -> int:
        """Index of the depth frame in the session."""
        return self.live.message.frame_index

    def payload(self, shape: Shape) -> str | bytes:
        """Return the encoded sample; reuses an encoding that is at most FRESH_S old."""
        now_s = self._encoder.clock.now_s()
        cached = self._encoded.get(shape)
        if cached is None or now_s > cached[0] + FRESH_S:
            event_id = f"{self.session_id}:{self.index}"
            cached = self._encoded[shape] = (
                now_s,
                self._encoder.encode(self._sample(shape.form, now_s), shape, event_id),
            )
        return cached[1]

    def _sample(self, form: Form, now_s: float) -> Message:
        """Return the sample in a form, with current times."""
        if self._full is None or now_s > self._full[0] + FRESH_S:
            self._full = (now_s, self._stamped())
        return self._full[1] if form is Form.FULL else thin_of(self._full[1])

    def _stamped(self) -> Sample:
        """Return the sample with sequence number, age and wall-clock times."""
        live, clock = self.live, self._encoder.clock
        sent_at = clock.utc()
        age_ms = (clock.now_ns() - live.received_ns) / NS_PER_MS
        received_at = sent_at - timedelta(milliseconds=age_ms)
        captured_at = None
        if live.captured_ns is not None:
            captured_at = received_at - timedelta(milliseconds=(live.received_ns - live.captured_ns) / NS_PER_MS)
        update = {
            "sequence": self.sequence,
            "sent_at": sent_at,
            "age_ms": round(age_ms, 2),
            "received_at": received_at,
            "captured_at": captured_at,
        }
        return live.message.model_copy(update=update)


def thin_of(full: Sample) -> ThinSample:
    """Return the thin form; the values were validated with the full form."""
    return ThinSample.model_construct(**{name: getattr(full, name) for name in THIN}, latency_ms=full.latency_ms.last)


def encode(message: Message, shape: Shape, event_id: str | None = None) -> str | bytes:
    """Encode a message in a shape: JSON, or a server-sent event."""
    # Only `hello` leaves fields out: those of a session when none runs.
    text = message.model_dump_json(exclude_none=isinstance(message, Hello))
    if shape.transport == "sse":
        kind = str(getattr(message, "type", "message"))
        if kind == "ping":
            return PING_COMMENT
        head = f"event: {kind}\n" if event_id is None else f"event: {kind}\nid: {event_id}\n"
        return f"{head}data: {text}\n\n".encode()
    return text
