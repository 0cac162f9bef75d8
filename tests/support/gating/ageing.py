"""A live camera whose driver's queue grows, whose clock is wrong, and whose frames' true age is known.

Time passes in steps of ``STEP_NS``, so that an hour takes a second. The frames go through the checks of the gate alone.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from engine.core.gate_state import HoldReason
from engine.gating.frame_checks import LastFrame, Verdict, captured_ns, check_frame, delivery_with, last_frame
from engine.gating.limits import GateLimits
from tests.support.gating.streams import LIMITS, MS, START_NS, measured, motion_of

STEP_NS = 150 * MS
S = 1_000 * MS
TRANSPORT_NS = 5 * MS
SPARSE = replace(LIMITS, max_gap_ms=200.0)
"""Limits for frames at this pace."""

_MOTION = motion_of()


@dataclass(frozen=True, kw_only=True)
class Seen:
    """One frame: how old its picture is beyond transport, what the clocks show of that, and what the gate says."""

    at_s: float
    age_ms: float
    shown_ms: float
    verdict: Verdict | None

    @property
    def is_believed(self) -> bool:
        return self.verdict is None

    @property
    def reason(self) -> HoldReason | None:
        return None if self.verdict is None else self.verdict.reason


def watched(
    *,
    seconds: float,
    clock_error: float,
    waiting_ms: Callable[[float], float],
    jitter_ms: Callable[[int], float] = lambda _index: 0.0,
    limits: GateLimits = SPARSE,
    is_away: Callable[[float], bool] = lambda _at_s: False,
    has_proof: bool = True,
    is_proof_wrong: bool = False,
) -> Iterator[Seen]:
    """Every frame of a stream.

    Parameters
    ----------
    clock_error
        By how much the device's clock runs too fast, as a share.
    waiting_ms
        How long a frame that is captured at that second waits in the driver's queue [ms].
    jitter_ms
        Delay of the n-th frame on its way to the driver [ms].
    is_away
        Whether no frame comes at that second.
    has_proof
        Whether the source sees an empty queue; it is empty where a frame does not wait.
    is_proof_wrong
        Whether every frame seems fresh: frames wait where the source does not see it, as in a driver that is too slow.
    """
    last: LastFrame | None = None
    empty_ns, received_ns = None, 0
    slots = (slot for slot in range(int(seconds * S) // STEP_NS) if not is_away(slot * STEP_NS / S))
    for index, slot in enumerate(slots):
        taken_ns = slot * STEP_NS
        age_ms = max(waiting_ms(taken_ns / S), 0.0) + jitter_ms(index)
        received_ns = max(START_NS + taken_ns + TRANSPORT_NS + int(age_ms * MS), received_ns + 1)
        if has_proof and (is_proof_wrong or waiting_ms(taken_ns / S) <= 0.0):
            empty_ns = received_ns - 10 * MS
        frame = replace(
            measured(index, _MOTION),
            timestamp_us=1_000 + int(taken_ns * (1.0 + clock_error)) // 1_000,
            received_ns=received_ns,
            queue_empty_ns=empty_ns,
        )
        delivery = delivery_with(last, frame)
        verdict = check_frame(last, frame, delivery, received_ns + MS, limits)
        last = last_frame(last, frame, delivery, limits.window)
        shown_ms = (frame.received_ns - captured_ns(last, frame, limits)) / MS
        yield Seen(at_s=taken_ns / S, age_ms=age_ms, shown_ms=shown_ms, verdict=verdict)
