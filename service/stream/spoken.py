"""What is said to many: each form of a message is written once, and the same bytes go to everyone."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Protocol

import msgpack

from engine.clock import NS_PER_MS
from service.live_messages import Hello, Message, Sample, ThinSample
from service.ports import LiveFrame
from service.stream.asking import Encoding, Form, Transport

FRESH_S = 0.1
"""A message that waited for longer is written anew: its age has to be true when it leaves."""
THIN = tuple(name for name in ThinSample.model_fields if name not in {"type", "form", "latency_ms"})
PING_COMMENT = b": ping\n\n"


@dataclass(frozen=True, slots=True)
class Shape:
    """How one client gets its messages."""

    transport: Transport
    form: Form
    encoding: Encoding


class Spoken(Protocol):
    """Something that can be said in any shape."""

    def payload(self, shape: Shape) -> str | bytes:
        """Return what goes out; the same object for everyone who gets it in this shape."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamClock:
    """The three clocks of the stream: the event loop's, the engine's, and the time of day."""

    now_s: Callable[[], float]
    now_ns: Callable[[], int]
    utc: Callable[[], datetime] = lambda: datetime.now(UTC)


class Press:
    """Writes messages, and counts how many were written."""

    def __init__(self, clock: StreamClock) -> None:
        self.clock = clock
        self.written = 0

    def write(self, message: Message, shape: Shape, event_id: str | None = None) -> str | bytes:
        """Write a message in this shape."""
        self.written += 1
        return written(message, shape, event_id)


class Plain:
    """A message that is the same in each form."""

    def __init__(self, message: Message, press: Press) -> None:
        self._message = message
        self._press = press
        self._made: dict[tuple[Transport, Encoding], str | bytes] = {}

    def payload(self, shape: Shape) -> str | bytes:
        """Write it, once a transport and encoding."""
        key = (shape.transport, shape.encoding)
        if key not in self._made:
            self._made[key] = self._press.write(self._message, shape)
        return self._made[key]


class Frame:
    """A frame of the session that runs, as the hub saw it.

    Attributes
    ----------
    sequence
        Counts what the hub saw.
    is_change
        Whether the gate, the reason to hold or the line is another than in the frame before.
    is_repeat
        Whether it shows the same depth frame as the one before: something changed between two.
    missed
        Frames between the one before and this one that the hub did not get to see.
    """

    def __init__(
        self, live: LiveFrame, *, sequence: int, is_change: bool, is_repeat: bool, missed: int, press: Press
    ) -> None:
        self.live = live
        self.missed = missed
        self.sequence = sequence
        self.is_change = is_change
        self.is_repeat = is_repeat
        self._press = press
        self._full: tuple[float, Sample] | None = None
        self._made: dict[Shape, tuple[float, str | bytes]] = {}

    @property
    def session_id(self) -> str:
        """The session it belongs to."""
        return self.live.message.session_id

    @property
    def index(self) -> int:
        """Its place among the session's depth frames."""
        return self.live.message.frame_index

    def payload(self, shape: Shape) -> str | bytes:
        """Write it in this shape, unless somebody got it so just now."""
        now_s = self._press.clock.now_s()
        made = self._made.get(shape)
        if made is None or now_s > made[0] + FRESH_S:
            event_id = f"{self.session_id}:{self.index}"
            made = self._made[shape] = (now_s, self._press.write(self._sample(shape.form, now_s), shape, event_id))
        return made[1]

    def _sample(self, form: Form, now_s: float) -> Message:
        """Return the sample with the times that all forms share."""
        if self._full is None or now_s > self._full[0] + FRESH_S:
            self._full = (now_s, self._stamped())
        return self._full[1] if form is Form.FULL else thin_of(self._full[1])

    def _stamped(self) -> Sample:
        """Put in what only whoever sends can know."""
        live, clock = self.live, self._press.clock
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
    """Leave out what a monitor of the gate does not need; everything was checked when the full one was made."""
    return ThinSample.model_construct(**{name: getattr(full, name) for name in THIN}, latency_ms=full.latency_ms.last)


def written(message: Message, shape: Shape, event_id: str | None = None) -> str | bytes:
    """Write a message as this client gets it."""
    # Of the messages only `hello` leaves anything out: what it would say of a session when none runs.
    text = message.model_dump_json(exclude_none=isinstance(message, Hello))
    if shape.transport == "sse":
        kind = str(getattr(message, "type", "message"))
        if kind == "ping":
            return PING_COMMENT
        head = f"event: {kind}\n" if event_id is None else f"event: {kind}\nid: {event_id}\n"
        return f"{head}data: {text}\n\n".encode()
    if shape.encoding is Encoding.JSON:
        return text
    packed: bytes = msgpack.packb(json.loads(text))  # by way of JSON: what is said is the same, to the last digit
    return packed
