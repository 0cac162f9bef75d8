"""The gate of an offline run: that of a session with the same limits, on device time.

A frame counts as received, fresh and decided when the camera captured it. The gate is armed at the first measured frame
after which a session could be armed, as an operator would do; a fault stays latched, since there is none to
acknowledge it.

Measured frames with their computing time, and the gate's edges on them; shared by QA and evaluation.

The decision on a frame comes its computing time after the frame arrived. A recording holds no arrival times: its frames
arrive when they are captured, and processor time is used, which does not depend on the machine's load.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from engine.core.breath import Breath, SignalChoice
from engine.core.clock import NS_PER_MS, NS_PER_US
from engine.core.commands import Acknowledge, Arm
from engine.core.frames import Measurement, MeasurementState, RgbdFrame
from engine.core.gate_state import GateState, HoldReason
from engine.core.learning_status import LearningEvent, LearningStatus
from engine.core.signals import Ranges
from engine.gating.frame_checks import unseen_signal
from engine.gating.gate import Ending, Gate, GateEvent, Silence, step_gate
from engine.gating.interlocks import DecisionInputs, interlocks
from engine.gating.limits import GateLimits, ns_from_ms
from engine.gating.supervision.supervisor import FrameSupervisor
from engine.gating.windows import breath_depths
from engine.motion.pipeline import Pipeline

OPERATOR = "offline"
UNTRAINED = Gate(
    state=GateState.HOLD, reason=HoldReason.TRAINING, detail="a live session had no motion model at this frame"
)
"""What is reported of a frame that a second pass measures, and a live session could not."""


class OfflineGate:
    """Decides on every frame of a recording; without limits it stays disarmed.

    ``ranges`` returns the learned ranges of signals, as of the model in use.
    """

    def __init__(
        self, limits: GateLimits | None, ranges: Callable[[Iterable[SignalChoice]], Ranges] = lambda _: {}
    ) -> None:
        self._limits = limits
        self._gate = Gate()
        self._supervisor = None if limits is None else FrameSupervisor(limits)
        self._was_armed = False
        self._generation = 0
        self._ranges, self._ranges_of = ranges, -1

    def decide(
        self, frame: RgbdFrame, measurement: Measurement, status: LearningStatus, notices: Iterable[LearningEvent]
    ) -> Gate:
        """Return the gate after a frame; ``status`` and ``notices`` are the learner's after its measurement."""
        if self._limits is not None and self._ranges_of != status.model_generation:
            self._ranges_of = status.model_generation
            depths = breath_depths(self._ranges(self._limits.window.choices))
            self._limits = replace(self._limits, breath_depths=depths)
        limits, supervisor = self._limits, self._supervisor
        if limits is None or supervisor is None:
            return self._gate
        measurement = measurement.as_gated
        now_ns = measurement.timestamp_us * NS_PER_US
        breaths = _breaths_of(measurement, limits)
        event = replace(measurement, received_ns=now_ns, queue_empty_ns=now_ns, breaths=breaths)
        self._step_silence(now_ns, limits)
        supervision = supervisor.check(
            replace(frame, received_ns=now_ns),
            event,
            window=limits.window,
            model=status.model,
            has_reference=status.has_reference or self._was_armed,
            notices=notices,
        )
        self._arm_if_ready(event, status, now_ns, limits)
        standing = interlocks(
            DecisionInputs(at_ns=now_ns), is_armed=self._gate.is_armed, limits=limits, supervision=supervision
        )
        events: list[GateEvent] = [*standing]
        if self._was_armed and status.model_generation != self._generation:
            self._generation = status.model_generation
            events.append(Ending(reason=HoldReason.DISARMED))
        for one in (*events, event, *standing):
            self._gate = step_gate(self._gate, one, now_ns, limits)
        return self._gate

    def hold_untrained(self, frame: RgbdFrame, measurement: Measurement) -> Gate:
        """Return the hold of a frame before there was a model; the gate sees it as a live session did."""
        untrained = replace(
            measurement, state=MeasurementState.TRAINING, motion=None, lost=None, breaths=(), doubt=None
        )
        gate = self.decide(frame, untrained, LearningStatus(), ())
        return gate if self._limits is None else UNTRAINED

    @property
    def is_armed(self) -> bool:
        """Whether the gate is armed: then a session would not switch models."""
        return self._gate.is_armed

    def _step_silence(self, now_ns: int, limits: GateLimits) -> None:
        """Step through the silence before this frame, which a session notes while it lasts."""
        last = self._gate.last
        silent_ns = ns_from_ms(limits.max_silence_ms) + 1
        if last is not None and now_ns - last.received_ns > silent_ns:
            at_ns = last.received_ns + silent_ns
            self._gate = step_gate(self._gate, Silence(since_ns=last.received_ns), at_ns, limits)

    def _arm_if_ready(self, event: Measurement, status: LearningStatus, now_ns: int, limits: GateLimits) -> None:
        """Arm once, where a session could be armed: the model has no shortcoming, every gated signal is measured."""
        motion = event.motion
        if self._was_armed or event.state is not MeasurementState.MEASURING or motion is None:
            return
        is_measured = all(math.isfinite(choice.value_in(motion)) for choice in limits.window.choices)
        if status.model_shortcoming is not None or not is_measured or unseen_signal(motion.seen, limits) is not None:
            return
        if self._gate.state is GateState.FAULT:
            self._gate = step_gate(self._gate, Acknowledge(operator=OPERATOR), now_ns, limits)
        self._gate = step_gate(self._gate, Arm(operator=OPERATOR), now_ns, limits)
        self._was_armed, self._generation = True, status.model_generation


def _breaths_of(measurement: Measurement, limits: GateLimits) -> tuple[Breath, ...]:
    """Return the breaths of the gated signals: a session monitors no others."""
    return tuple(breath for breath in measurement.breaths if breath.signal in limits.window.choices)


@dataclass(frozen=True, slots=True, kw_only=True)
class Edge:
    """Beam on or off at a device time [us]; ``dwelt_us`` is the dwell before beam on [us]."""

    at_us: float
    is_on: bool
    dwelt_us: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimedFrame:
    """A measured frame and its computing time [ns]."""

    measurement: Measurement
    computing_ns: int


def time_frames(
    frames: Iterable[RgbdFrame], pipeline: Pipeline, now_ns: Callable[[], int] = time.thread_time_ns
) -> Iterator[TimedFrame]:
    """Measure frames and the time that each takes by ``now_ns``."""
    for frame in frames:
        before_ns = now_ns()
        measurement = pipeline.measure(frame)
        yield TimedFrame(measurement=measurement, computing_ns=now_ns() - before_ns)


def gate_edges(
    limits: GateLimits, frames: Sequence[TimedFrame], from_us: int, operator: str, *, is_live: bool = False
) -> list[Edge]:
    """Return the edges of a gate that is armed at ``from_us`` (device time) and decides on measured frames.

    Parameters
    ----------
    limits
        Limits of the gate; ``is_played`` is set from ``is_live``.
    is_live
        Whether the frames came from a camera. Then an edge includes the lateness of its frame relative to the earliest
        one; frames of a recording arrive when they were captured.
    """
    limits = replace(limits, is_played=not is_live)
    gate, edges, is_armed = Gate(), [], False
    for frame in frames:
        at_us = frame.measurement.timestamp_us
        received_ns = frame.measurement.received_ns if is_live else at_us * NS_PER_US
        if not is_armed and at_us >= from_us:
            is_armed = True
            gate = step_gate(
                gate, Acknowledge(operator=operator), received_ns, limits
            )  # clears faults of earlier frames
            gate = step_gate(gate, Arm(operator=operator), received_ns, limits)
        was_on = gate.state is GateState.BEAM_ON
        now_ns = received_ns + min(frame.computing_ns, int(limits.max_frame_age_ms * NS_PER_MS))
        gate = step_gate(gate, replace(frame.measurement, received_ns=received_ns), now_ns, limits)
        if (gate.state is GateState.BEAM_ON) is not was_on:
            since_us = gate.inside_since_us
            dwelt_us = None if was_on or since_us is None else float(at_us - since_us)
            ahead_ns = 0 if gate.last is None or not is_live else gate.last.least_lag_ns
            edges.append(Edge(at_us=(now_ns - ahead_ns) / NS_PER_US, is_on=not was_on, dwelt_us=dwelt_us))
    return edges
