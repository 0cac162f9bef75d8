"""Frames with how long each took to measure, and the edges a gate makes of them: what instruments of timing share.

A frame is decided when it has been measured, its own computing time after it came. Of a recording, which does not tell
when a frame came, that is after it was captured, and of the processor's time, so that a busy machine tells the same.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from engine.clock import NS_PER_MS, NS_PER_US
from engine.commands import Acknowledge, Arm
from engine.frames import Measurement, RgbdFrame
from engine.limits import GateLimits
from engine.permits import GateState
from engine.pipeline import Pipeline
from engine.stages.gate import Gate, step_gate


@dataclass(frozen=True, slots=True, kw_only=True)
class Edge:
    """The beam went on or off, at device time [us]; ``dwelt_us`` is how long the gate had dwelt when it went on."""

    at_us: float
    is_on: bool
    dwelt_us: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimedFrame:
    """A measured frame and what that took [ns]."""

    measurement: Measurement
    computing_ns: int


def time_frames(
    frames: Iterable[RgbdFrame], pipeline: Pipeline, now_ns: Callable[[], int] = time.thread_time_ns
) -> Iterator[TimedFrame]:
    """Measure frames, and how long each takes."""
    for frame in frames:
        before_ns = now_ns()
        measurement = pipeline.measure(frame)
        yield TimedFrame(measurement=measurement, computing_ns=now_ns() - before_ns)


def gate_edges(
    limits: GateLimits, frames: Sequence[TimedFrame], from_us: int, operator: str, *, is_live: bool = False
) -> list[Edge]:
    """Let a gate, armed at ``from_us``, decide on measured frames.

    Parameters
    ----------
    is_live
        The frames came from a camera: each is received when it came, and its edge is later by as much as it came later
        than the promptest. A recording's are received as they were captured: what they take to arrive it does not tell.
    """
    limits = replace(limits, is_played=not is_live)
    gate, edges, is_begun = Gate(), [], False
    for frame in frames:
        at_us = frame.measurement.timestamp_us
        received_ns = frame.measurement.received_ns if is_live else at_us * NS_PER_US
        if not is_begun and at_us >= from_us:
            is_begun = True
            gate = step_gate(gate, Acknowledge(operator=operator), received_ns, limits)  # of what was before
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
