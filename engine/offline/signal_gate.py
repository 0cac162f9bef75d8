"""Gates a signal [mm] in place of the whole region's motion: a course that another instrument measured.

What is decided on is the signal alone: its breaths are learned from its beginning, its reference is the mean of the
last three ends of exhale there, and every frame counts as measured, fresh and wholly seen.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from engine.core.breath import WHOLE
from engine.core.clock import NS_PER_S
from engine.core.commands import Arm
from engine.core.frames import BoolArray, FloatArray, Measurement, MeasurementState, Motion, Projection, SeenShares
from engine.core.gate_state import GateState, HoldReason
from engine.core.signals import LearnedRange
from engine.gating.gate import Gate, step_gate
from engine.gating.limits import GateLimits
from engine.gating.supervision.patient_shift import Baseline
from engine.motion.breathing import BreathingState, follow_breathing, start_breathing, with_baseline

FPS = 30.0
PERCENTILES = (5.0, 95.0)
"""The learned range of the signal, in per cent of its values while learning."""
EXHALES = 3
SEEN_ALL = SeenShares(whole=1.0, thorax=1.0, abdomen=1.0, cells=np.ones((1, 1)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LearnedSignal:
    """What the beginning of a signal says of its breathing.

    Attributes
    ----------
    time_s, value_mm
        The signal after it, at 30 values a second, relative to the reference: shape (n,).
    reference
        Mean of the last ends of exhale while learning [mm].
    period_s, rise_mm
        Length and depth of a usual breath.
    learned
        Its range relative to the reference.
    """

    time_s: FloatArray
    value_mm: FloatArray
    reference: float
    period_s: float
    rise_mm: float
    learned: LearnedRange
    state: BreathingState

    def frames(self) -> Iterator[Measurement]:
        """Yield the signal as measured frames, their breath followed by the monitor."""
        state = with_baseline(self.state, self.reference)
        for index, (now_s, level) in enumerate(zip(self.time_s.tolist(), self.value_mm.tolist(), strict=True)):
            state = follow_breathing(state, now_s, level + self.reference)
            now_ns = round(NS_PER_S * now_s)
            yield Measurement(
                frame_index=index,
                timestamp_us=round(1e6 * now_s),
                received_ns=now_ns,
                measured_ns=now_ns,
                queue_empty_ns=now_ns,
                missed_frames=0,
                state=MeasurementState.MEASURING,
                motion=_motion(level),
                breaths=(state.breath,),
            )


def learn_signal(time_s: FloatArray, value_mm: FloatArray, learn_s: float) -> LearnedSignal | None:
    """Learn the breathing of a signal's first ``learn_s``; None where there are too few breaths, or nothing after.

    Parameters
    ----------
    time_s, value_mm
        Increasing times [s] and values, shape (n,); inhale is positive. Resampled at 30 values a second.
    """
    seconds = np.arange(time_s[0], time_s[-1], 1.0 / FPS)
    values = np.interp(seconds, time_s, value_mm)
    learned = int(learn_s * FPS)
    if len(seconds) <= learned:
        return None
    state = start_breathing(WHOLE)
    for now_s, value in zip(seconds[:learned].tolist(), values[:learned].tolist(), strict=True):
        state = follow_breathing(state, now_s, value)
    lows = [low for _, low in state.history.lows][-EXHALES:]
    if state.history.habit is None or len(lows) < EXHALES - 1:
        return None
    reference = float(np.mean(lows))
    low, high = np.percentile(values[:learned], PERCENTILES) - reference
    return LearnedSignal(
        time_s=seconds[learned:],
        value_mm=values[learned:] - reference,
        reference=reference,
        period_s=state.history.habit.period_s,
        rise_mm=state.history.habit.rise,
        learned=LearnedRange(low=float(low), high=float(high)),
        state=state,
    )


def gate_frames(
    limits: GateLimits, frames: Sequence[Measurement], *, has_rules: bool = True
) -> tuple[BoolArray, tuple[HoldReason | None, ...]]:
    """Arm at the first frame; return per frame whether the beam is on, and the gate's reason, None while it is on.

    ``has_rules`` is whether the rules on breathing count: baseline drift and ceased breathing.
    """
    gate, baseline = Gate(), Baseline(limits)
    is_on, reasons = [], []
    for number, frame in enumerate(frames):
        now_ns = frame.received_ns
        event = frame if has_rules else replace(frame, breaths=())
        drift = baseline.check(frame, limits.window) if has_rules else None
        for one in (event,) if drift is None else (drift, event, drift):
            gate = step_gate(gate, one, now_ns, limits)
        if number == 0:
            gate = step_gate(gate, Arm(operator="offline"), now_ns, limits)
        is_on.append(gate.state is GateState.BEAM_ON)
        reasons.append(gate.reason)
    return np.array(is_on, dtype=np.bool_), tuple(reasons)


def _motion(level_mm: float) -> Motion:
    return Motion(
        whole_mm=level_mm,
        thorax_mm=level_mm,
        abdomen_mm=level_mm,
        volume_l=0.0,
        regions_mm=np.zeros((1, 1)),
        regions_depth_mm=np.ones((1, 1)),
        points_mm=np.empty(0),
        projection=Projection(
            beta=np.zeros(1), coefficients=np.zeros(1), residual_mm=0.0, valid_share=1.0, inlier_share=1.0
        ),
        seen=SEEN_ALL,
        reference_seen=SEEN_ALL,
    )
