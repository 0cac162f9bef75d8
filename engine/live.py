"""What leaves the engine: one record a frame, one transition a change of the gate, one newest view.

All are frozen values; the service turns them into rows, messages and pictures in its own threads. Times are host
monotonic nanoseconds except ``captured_us``, which is the device's clock.
"""

import enum
from dataclasses import dataclass

from engine.capture.source import SourceDescription
from engine.clock import NS_PER_MS
from engine.frames import ColorImage, Measurement
from engine.permits import GateState, HoldReason
from engine.windows import ConditionState, GateWindow


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
        When the frame was in our hands, the gate had decided, and the line had been told. A line that acts at once was
        read back by then; one at the end of a wire is read back within its own bounds, or latches (docs/beam.md).
    line_on
        The line as read back; True also when it did not answer, since it may be on.
    captured_ns
        When the camera took the frame, on the host's clock; see :func:`engine.trust.captured_ns`.
    """

    measurement: Measurement
    gate_state: GateState
    hold_reason: HoldReason | None
    signal_mm: float | None
    received_ns: int
    decided_ns: int
    asserted_ns: int
    line_on: bool
    captured_ns: int | None = None

    @property
    def latency_ms(self) -> float | None:
        """From capture to the line told [ms]."""
        return _latency_ms(self.captured_ns, self.asserted_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class GateTransition:
    """One change of the gate's state, or of the reason for the state; for the audit.

    ``frame_index``, ``captured_us``, ``captured_ns`` and ``received_ns`` are those of the frame that caused it, None
    when none did; ``operator`` is the person who did; ``number`` is its own in the session's journal, rising.
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
    captured_ns: int | None = None
    number: int | None = None

    @property
    def latency_ms(self) -> float | None:
        """From capture to the line told; None where no frame was the cause."""
        return _latency_ms(self.captured_ns, self.asserted_ns)


def _latency_ms(captured_ns: int | None, asserted_ns: int) -> float | None:
    return None if captured_ns is None else (asserted_ns - captured_ns) / NS_PER_MS


@dataclass(frozen=True, slots=True, kw_only=True)
class LatencySummary:
    """From capture to the line told [ms]: the last frame, the last few hundred, and the slowest of all.

    ``is_warned`` says that the last frame took longer than the site wants to be warned of.
    """

    last_ms: float
    p50_ms: float
    p99_ms: float
    max_ms: float = 0.0
    is_warned: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LiveView:
    """The newest of everything, for a page; its age is the reader's to compute from ``record.received_ns``.

    Between frames (silence, commands, the end) the record repeats the last frame with the gate and line of now.

    Attributes
    ----------
    window
        As the gate decides by it: per cent turned into mm or l where that can be, and corrected.
    conditions
        What the window remembers, one state a condition; empty before the first frame.
    operator_hold
        Who holds the beam by hand; None where nobody does.
    breath_holds
        How many breath holds were counted since the gate was armed.
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
    window: GateWindow
    conditions: tuple[ConditionState, ...] = ()
    operator_hold: str | None = None
    breath_holds: int = 0
