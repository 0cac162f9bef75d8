"""What leaves the engine: one record a frame, one transition a change of the gate, one newest view.

All are frozen values; the service turns them into rows, messages and pictures in its own threads. Times are host
monotonic nanoseconds except ``captured_us``, which is the device's clock.
"""

import enum
from dataclasses import dataclass

from engine.capture.source import SourceDescription
from engine.frames import ColorImage, Measurement
from engine.permits import GateState, HoldReason


class LoopStatus(enum.StrEnum):
    """Where an engine's one life stands."""

    STARTING = "starting"
    RUNNING = "running"
    ENDED = "ended"
    FAILED = "failed"

    @property
    def is_over(self) -> bool:
        """Whether nothing will be decided any more."""
        return self in {LoopStatus.ENDED, LoopStatus.FAILED}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameRecord:
    """One frame and what was decided on it.

    Attributes
    ----------
    hold_reason
        Why the beam is held; None if and only if ``gate_state`` is ``BEAM_ON``.
    signal_mm
        The gated motion; None where it was not measured.
    received_ns, decided_ns, asserted_ns
        When the frame was in our hands, the gate had decided, and the line had been told and read back.
    line_on
        The line as read back; True also when it did not answer, since it may be on.
    """

    measurement: Measurement
    gate_state: GateState
    hold_reason: HoldReason | None
    signal_mm: float | None
    received_ns: int
    decided_ns: int
    asserted_ns: int
    line_on: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class GateTransition:
    """One change of the gate's state, or of the reason for the state; for the audit.

    ``frame_index``, ``captured_us`` and ``received_ns`` are those of the frame that caused it, None when none did;
    ``operator`` is the person who did.
    """

    at_ns: int
    frame_index: int | None
    from_state: GateState
    to_state: GateState
    reason: HoldReason | None
    operator: str | None
    detail: str
    captured_us: int | None
    received_ns: int | None
    decided_ns: int
    asserted_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LatencySummary:
    """From a frame in our hands to the line read back [ms], over the last frames."""

    last_ms: float
    p50_ms: float
    p99_ms: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LiveView:
    """The newest of everything, for a page; its age is the reader's to compute from ``record.received_ns``.

    Between frames (silence, commands, the end) the record repeats the last frame with the gate and line of now.
    """

    record: FrameRecord
    color: ColorImage
    frames: int
    missed_frames: int
    dropped_records: int
    fps: float
    latency: LatencySummary
    is_armed: bool
    detail: str
    description: SourceDescription
    status: LoopStatus
    error: str | None
