"""Gates and frames built by construction, so that a test about BEAM_ON really gets there."""

from dataclasses import replace

import numpy as np

from engine.core.commands import Acknowledge, Arm
from engine.core.frames import Evidence, Lost, LostReason, Measurement, MeasurementState, Motion, Projection, SeenShares
from engine.core.gate_state import GateState, HoldReason
from engine.core.signals import HeadDirection
from engine.gating.frame_checks import check_frame, delivery_with, last_frame
from engine.gating.gate import Gate, GateEvent, Interruption, step_gate
from engine.gating.limits import GateLimits
from engine.gating.windows import amplitude_window

PERIOD_US = 33_367
PERIOD_NS = PERIOD_US * 1_000
MS = 1_000_000
START_NS = 5_000 * MS
MEASURING_NS = 5 * MS
QUIET_NS = 10 * MS
"""How long before a good frame the driver's queue was last known to be empty."""
LEVEL_MM = 2.0
LIMITS = GateLimits(
    window=amplitude_window(lower_mm=-1.0, upper_mm=3.0, hysteresis_mm=0.2),
    dwell_ms=100.0,
    max_jump_mm=1.5,
    head_direction=HeadDirection.TOP,
    operator_timeout_s=0.0,
)
"""Of an armed gate without a page: tests/engine/control/test_operators.py is about presence."""

SEEN = SeenShares(whole=0.98, thorax=0.97, abdomen=0.99, cells=np.ones((14, 8)), points=np.ones(4), named=np.ones(4))
A_BREATH_FRAMES = 10
"""Frames beyond an edge, without a gap, from which the patient has breathed: nine periods are 0.3003 s."""
FRAMES_A_DWELL = 4
"""Three periods are 100.1 ms: the fourth good frame is the first that may turn the beam on."""


def motion_of(
    whole_mm: float = LEVEL_MM,
    *,
    thorax_mm: float = 1.0,
    abdomen_mm: float = 1.5,
    residual_mm: float = 0.7,
    valid_share: float = 0.98,
    inlier_share: float = 0.97,
    beta: tuple[float, ...] = (3.0, -1.0, 0.2),
    coefficients: tuple[float, ...] = (3.0, -1.0, 0.2, 0.1),
    regions_mm: float = 1.25,
    seen: SeenShares = SEEN,
    reference_seen: SeenShares = SEEN,
) -> Motion:
    return Motion(
        whole_mm=whole_mm,
        thorax_mm=thorax_mm,
        abdomen_mm=abdomen_mm,
        volume_l=0.2,
        regions_mm=np.full((14, 8), regions_mm),
        regions_depth_mm=np.full((14, 8), 850.0),
        points_mm=np.zeros(0),
        projection=Projection(
            beta=np.array(beta),
            coefficients=np.array(coefficients),
            residual_mm=residual_mm,
            valid_share=valid_share,
            inlier_share=inlier_share,
        ),
        seen=seen,
        reference_seen=reference_seen,
    )


EVIDENCE = Evidence(surface=True, color=True, camera=True)
"""All that can be compared was."""


def measured(index: int, motion: Motion | None = None) -> Measurement:
    """A good frame, on schedule."""
    received_ns = START_NS + index * PERIOD_NS
    return Measurement(
        frame_index=index,
        timestamp_us=1_000 + index * PERIOD_US,
        received_ns=received_ns,
        queue_empty_ns=received_ns - QUIET_NS,
        measured_ns=received_ns + MEASURING_NS,
        missed_frames=0,
        state=MeasurementState.MEASURING,
        motion=motion or motion_of(),
        evidence=EVIDENCE,
    )


def unmeasured(frame: Measurement, state: MeasurementState, lost: LostReason | None = None) -> Measurement:
    reason = None if lost is None else Lost(reason=lost, detail="as the test wants it")
    return replace(frame, state=state, motion=None, lost=reason)


class Stream:
    """A gate fed one frame a period; frames are good unless the test spoils them."""

    def __init__(self, limits: GateLimits = LIMITS, level_mm: float = LEVEL_MM) -> None:
        self.limits = limits
        self.level_mm = level_mm
        self.gate = Gate()
        self.next_slot = 0
        self.now_ns = START_NS

    def upcoming(self) -> Measurement:
        """The next frame as it should be: next in number, one period later."""
        index = 0 if self.gate.last is None else self.gate.last.index + 1
        return replace(measured(self.next_slot, motion_of(self.level_mm)), frame_index=index)

    def feed(self, frame: Measurement | None = None, *, age_ns: int = MEASURING_NS) -> Gate:
        frame = self.upcoming() if frame is None else frame
        self.next_slot += 1
        self.now_ns = max(self.now_ns, frame.received_ns + age_ns)
        return self.step(frame, frame.received_ns + age_ns)

    def step(self, event: GateEvent, now_ns: int | None = None) -> Gate:
        self.gate = step_gate(self.gate, event, self.now_ns if now_ns is None else now_ns, self.limits)
        return self.gate

    def good(self, frames: int) -> list[GateState]:
        return [self.feed().state for _ in range(frames)]


def stream_in(state: GateState, *, limits: GateLimits = LIMITS, level_mm: float = LEVEL_MM) -> Stream:
    """Bring a gate into ``state`` the way a session does."""
    stream = Stream(limits, level_mm)
    stream.good(3)
    if state is GateState.DISARMED:
        return stream
    stream.step(Arm(operator="ann"))
    if state is GateState.FAULT:
        stream.step(Interruption(HoldReason.SOURCE_LOST, "unplugged"))
    if state is GateState.DWELL:
        stream.good(2)
    if state is GateState.BEAM_ON:
        stream.good(6)
    assert stream.gate.state is state
    return stream


def clear_and_arm(stream: Stream) -> None:
    stream.step(Acknowledge(operator="bob"))
    stream.step(Arm(operator="bob"))


def checked(last, frame, now_ns, limits):
    """Check a frame as the gate does; return the verdict."""
    return check_frame(last, frame, delivery_with(last, frame), now_ns, limits)


def followed_frame(last, frame):
    """Return the summary with which the next frame is compared."""
    return last_frame(last, frame, delivery_with(last, frame), LIMITS.window)
