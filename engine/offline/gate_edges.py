"""Measured frames with their computing time, and the gate's edges on them; shared by QA and evaluation.

The decision on a frame comes its computing time after the frame arrived. A recording holds no arrival times: its frames
arrive when they are captured, and processor time is used, which does not depend on the machine's load.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from engine.core.clock import NS_PER_MS, NS_PER_US
from engine.core.commands import Acknowledge, Arm
from engine.core.frames import Measurement, RgbdFrame
from engine.core.gate_state import GateState
from engine.gating.gate import Gate, step_gate
from engine.gating.limits import GateLimits
from engine.motion.pipeline import Pipeline


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
