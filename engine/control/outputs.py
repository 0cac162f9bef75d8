"""The engine's outputs: one record per frame, one transition per change of the gate, one newest view.

All are frozen values; the service turns them into rows, messages and pictures in its own threads. Times are host
monotonic nanoseconds except ``captured_us``, which is the device's clock.

One decision of the gate as a value: what it was made on, the gate before and after it, and when.
"""

import enum
from dataclasses import dataclass

from engine.beam.beam_on import BeamOnState
from engine.capture.source import SourceDescription
from engine.control.fraction_checks import PositionState
from engine.core.clock import NS_PER_MS
from engine.core.frames import ColorImage, Measurement, RgbdFrame
from engine.core.gate_state import GateState, HoldReason
from engine.core.position_check import CameraView
from engine.core.reference import ReferenceDistance
from engine.gating.gate import Gate
from engine.gating.supervision.checks import CheckState
from engine.gating.supervision.patient_shift import Movement
from engine.gating.windows import ConditionState, GateWindow


class LoopStatus(enum.StrEnum):
    """The run state of an engine."""

    STARTING = "starting"
    RUNNING = "running"
    ENDED = "ended"
    FAILED = "failed"

    @property
    def is_over(self) -> bool:
        """Whether the engine decides nothing any more."""
        return self in {LoopStatus.ENDED, LoopStatus.FAILED}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameRecord:
    """One frame, and the decision on it.

    Attributes
    ----------
    hold_reason
        Why the beam is held; None if and only if ``gate_state`` is ``BEAM_ON``.
    signal_mm
        The gated motion; None where it was not measured.
    received_ns, decided_ns, asserted_ns
        When the frame was received, the gate had decided, and the line had been driven. A line that acts at once was
        read back by then; a wired line is read back within its own bounds, or latches (docs/3-operate/beam.md).
    line_on
        The line as read back; True also when it did not answer, since it may be on.
    captured_ns
        When the camera took the frame, on the host's clock; see :func:`engine.gating.frame_checks.captured_ns`.
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
        """From capture to the line driven [ms]."""
        return _latency_ms(self.captured_ns, self.asserted_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class GateTransition:
    """One change of the gate's state, or of the reason for the state; for the audit.

    ``frame_index``, ``captured_us``, ``captured_ns`` and ``received_ns`` are those of the frame that caused it, None
    when none did; ``operator`` is the person who did; ``number`` is its own in the session's journal, rising.
    ``armed_by`` is who let the gate decide, after it or, where it ended the arming, before it.
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
    armed_by: str | None = None

    @property
    def latency_ms(self) -> float | None:
        """From capture to the line driven [ms]; None where no frame was the cause."""
        return _latency_ms(self.captured_ns, self.asserted_ns)


def _latency_ms(captured_ns: int | None, asserted_ns: int) -> float | None:
    return None if captured_ns is None else (asserted_ns - captured_ns) / NS_PER_MS


@dataclass(frozen=True, slots=True, kw_only=True)
class LatencySummary:
    """Time from capture to the line driven [ms]: last frame, percentiles of the last few hundred, and maximum.

    ``is_warned`` is set where the last frame took longer than the site's warning limit.
    """

    last_ms: float
    p50_ms: float
    p99_ms: float
    max_ms: float = 0.0
    is_warned: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LiveView:
    """The newest frame and decision, for a page; a reader computes its age from ``record.received_ns``.

    Between frames (silence, commands, the end) the record repeats the last frame with the gate and line of now.

    Attributes
    ----------
    window
        The window that the gate decides by: per cent resolved into mm or l where the range is known, and corrected.
    conditions
        State of each condition of the window; empty before the first frame.
    operator_holds
        All who hold the beam by hand, in the order of their holds.
    armed_by
        Who lets the gate decide: the operator who armed, or the person who released a hold since; None while disarmed.
    breath_holds
        Number of breath holds since the gate was armed.
    beam_on
        The accelerator's beam-on signal compared with the permit; None where it is no input.
    reference_distance, reference_budget_mm
        How far reference and window lie from the fraction's first reference, and how far they may without a reason;
        the distance is None while no reference is set.
    movement
        Movement of the markers since the present reference; None where it is not known.
    marker_travel_mm
        How far the markers slide along the couch with the breath; None where it is not known.
    checks
        Which checks of the measurement work since the reference was set; empty without a reference.
    is_clock_checked
        Whether the age of the frame is known by the camera's clock.
    position
        The patient's position against the plan's, and who signed it; None where it is not compared.
    camera_view
        How the camera looks at the patient, for the set-up; None while the gate is armed.
    unseen_cells
        Row and column of each cell of which the frame shows less than a gated cell needs; its motion is extrapolated.
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
    operator_holds: tuple[str, ...] = ()
    armed_by: str | None = None
    breath_holds: int = 0
    beam_on: BeamOnState | None = None
    unseen_cells: tuple[tuple[int, int], ...] = ()
    reference_distance: ReferenceDistance | None = None
    reference_budget_mm: float = 2.0
    movement: Movement | None = None
    marker_travel_mm: float | None = None
    checks: tuple[CheckState, ...] = ()
    is_clock_checked: bool = False
    position: PositionState | None = None
    camera_view: CameraView | None = None

    @property
    def operator_hold(self) -> str | None:
        """The first who holds the beam by hand; None where there is none."""
        return next(iter(self.operator_holds), None)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cause:
    """What a decision is made on: a frame with its measurement, an operator's command, or neither.

    A cause with a ``detail`` is recorded as a transition even where the gate's state stays.
    """

    frame: RgbdFrame | None = None
    measurement: Measurement | None = None
    operator: str | None = None
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decision:
    """A decision that was taken, or that the line is about to carry out.

    Attributes
    ----------
    decided_ns, asserted_ns
        When the gate had decided, and when the line had carried it out [ns, host monotonic]; equal before the line
        was asked.
    captured_ns
        When the camera took the frame [ns, host monotonic]; None without a frame.
    operator_holds
        All who hold the beam by hand, in the order of their holds.
    holder
        The first of them, or the one whose hold waits in the command queue.
    """

    cause: Cause
    before: Gate
    gate: Gate
    decided_ns: int
    asserted_ns: int
    captured_ns: int | None
    operator_holds: tuple[str, ...] = ()
    holder: str | None = None

    @property
    def is_change(self) -> bool:
        """Whether the gate's state or its reason changed."""
        return (self.gate.state, self.gate.reason) != (self.before.state, self.before.reason)
