"""The gate of an offline run decides on each frame as the engine of a session does that was armed at the same frame."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from engine.core.breath import Breath, BreathEvent, BreathEventKind, SignalChoice
from engine.core.frames import LostReason, MeasurementState
from engine.core.gate_state import GateState, HoldReason
from engine.core.learning_status import LearningStatus
from engine.offline.offline_gate import OfflineGate
from tests.support.control.armed_bench import ARM, LEARNED, lying_at
from tests.support.control.loop_bench import Bench, ScriptedSource, after, good, silent
from tests.support.gating.streams import LIMITS, SEEN, motion_of, unmeasured

BEFORE = 12
"""Good frames behind the arming, before a case's own: the beam is on."""

FIRST = LEARNED + BEFORE
AFTER = 20
HALF_SEEN = replace(SEEN, whole=0.5)


def with_motion(frame, **values):
    return replace(frame, motion=motion_of(**values))


def spoilt(bench, change, frames=3):
    for index in range(FIRST, FIRST + frames):
        bench.pipeline.spoil[index] = change


def same_picture(source: ScriptedSource, timeout_s: float):
    first = good(source, timeout_s)
    return replace(first, depth_mm=source.kept.depth_mm, color=source.kept.color)


def keep_picture(source: ScriptedSource, timeout_s: float):
    source.kept = good(source, timeout_s)
    return source.kept


def camera_restarts(source, timeout_s):
    return replace(good(source, timeout_s), device_index=0)


def lost(reason):
    return lambda bench: spoilt(bench, partial(unmeasured, state=MeasurementState.LOST, lost=reason))


def breathing(kind, signal):
    breath = Breath(signal=signal, events=(BreathEvent(kind=kind, start_us=0, confidence=1.0),))
    return lambda bench: spoilt(bench, lambda frame: replace(frame, breaths=(breath,)))


def other_model(bench):
    bench.source.script[FIRST] = after(lambda: setattr(bench.pipeline, "model_generation", 2))


CASES = {
    "nothing": lambda _bench: None,
    "outside": lambda bench: spoilt(bench, partial(with_motion, whole_mm=3.2)),
    "inside the edge but not the hysteresis": lambda bench: (
        spoilt(bench, partial(with_motion, whole_mm=3.05), 1),
        bench.pipeline.spoil.update({FIRST + n: partial(with_motion, whole_mm=2.9) for n in range(1, 9)}),
    ),
    "jump": lambda bench: spoilt(bench, partial(with_motion, whole_mm=-0.5), 1),
    "marker": lost(LostReason.MARKER_LOST),
    "layout": lost(LostReason.LAYOUT_CHANGED),
    "coverage": lost(LostReason.COVERAGE_LOW),
    "residual": lambda bench: spoilt(bench, partial(with_motion, residual_mm=3.5)),
    "share": lambda bench: spoilt(bench, partial(with_motion, valid_share=0.7)),
    "gated signal not seen": lambda bench: spoilt(bench, partial(with_motion, seen=HALF_SEEN)),
    "reference without the gated signal": lambda bench: spoilt(bench, partial(with_motion, reference_seen=HALF_SEEN)),
    "not a number": lambda bench: spoilt(bench, partial(with_motion, whole_mm=float("nan")), 1),
    "moved along the couch": lambda bench: lying_at(bench, FIRST, 9.0),
    "frozen": lambda bench: bench.source.script.__setitem__(
        slice(FIRST, FIRST + 4), [keep_picture, same_picture, same_picture, same_picture]
    ),
    "camera numbers": lambda bench: bench.source.script.__setitem__(FIRST, camera_restarts),
    "silence": lambda bench: bench.source.script.__setitem__(slice(FIRST, FIRST), [silent] * 3),
    "short silence": lambda bench: bench.source.script.__setitem__(slice(FIRST, FIRST), [silent]),
    "other model": other_model,
    "cough of the gated signal": breathing(BreathEventKind.COUGH, LIMITS.window.choices[0]),
}


def played(case, limits):
    """Run a session that is armed behind frame LEARNED; return its bench, and each frame with what was known of it."""
    bench = Bench([good] * (FIRST + AFTER), limits=limits)
    bench.source.script[LEARNED] = after(bench.ask(ARM))
    CASES[case](bench)
    seen, measure = [], bench.pipeline.measure

    def kept(frame):
        measurement = measure(frame)
        seen.append((frame, measurement, bench.pipeline.status))
        return measurement

    bench.pipeline.measure = kept
    return bench.run(), seen


@pytest.mark.parametrize("case", CASES)
def test_the_decisions_of_a_session_and_of_an_offline_run_are_the_same(case):
    limits = replace(LIMITS, holding_events=frozenset({BreathEventKind.COUGH}))
    bench, seen = played(case, limits)
    gate = OfflineGate(limits)
    offline = []
    for index, (frame, measurement, status) in enumerate(seen):
        ready = replace(status, model_shortcoming="not armed yet" if index <= LEARNED else None)
        offline.append(gate.decide(frame, measurement, ready, ()))
    live = {record.measurement.frame_index: (record.gate_state, record.hold_reason) for record in bench.records()}
    assert len(live) == len(offline) == len(seen) > FIRST + 10
    differing = [
        (index, *live[index], one.state, one.reason)
        for index, one in enumerate(offline)
        if index > LEARNED and live[index] != (one.state, one.reason)
    ]
    assert differing == []
    assert offline[FIRST - 1].state is GateState.BEAM_ON
    held = {one.reason for one in offline[FIRST:]} - {None}
    assert bool(held) == (case != "nothing"), held


def test_without_limits_the_gate_stays_disarmed():
    _, seen = played("nothing", LIMITS)
    gate = OfflineGate(None)
    assert {gate.decide(*one, ()).state for one in seen} == {GateState.DISARMED}


def test_a_model_that_a_session_would_not_be_armed_with_is_not_armed():
    _, seen = played("nothing", LIMITS)
    gate = OfflineGate(LIMITS)
    for frame, measurement, status in seen:
        refused = replace(status, model_shortcoming="too few breathing cycles")
        assert gate.decide(frame, measurement, refused, ()).state is GateState.DISARMED


def test_events_of_a_signal_that_is_not_gated_hold_nothing():
    limits = replace(LIMITS, holding_events=frozenset({BreathEventKind.COUGH}))
    CASES["elsewhere"] = breathing(BreathEventKind.COUGH, SignalChoice(signal="thorax"))
    try:
        _, seen = played("elsewhere", limits)
    finally:
        del CASES["elsewhere"]
    gate = OfflineGate(limits)
    states = [gate.decide(frame, measurement, status, ()).state for frame, measurement, status in seen]
    assert states[FIRST : FIRST + 3] == [GateState.BEAM_ON] * 3


def test_a_fault_before_the_model_is_acknowledged_with_the_arming():
    _, seen = played("nothing", LIMITS)
    gate = OfflineGate(LIMITS)
    frame, measurement, _ = seen[0]
    broken = replace(measurement, state=MeasurementState.MEASURING, motion=motion_of(float("nan")))
    untrained = LearningStatus(model_shortcoming="training")
    assert gate.decide(frame, broken, untrained, ()).reason is HoldReason.VALUE_INVALID
    states = [gate.decide(*one, ()).state for one in seen[1:]]
    assert states[-1] is GateState.BEAM_ON
    assert np.isfinite(seen[-1][1].motion.whole_mm)


def test_frames_before_the_model_are_held_and_neither_arm_nor_move_the_gate():
    _, seen = played("nothing", LIMITS)
    gate, as_live = OfflineGate(LIMITS), OfflineGate(LIMITS)
    for frame, measurement, status in seen:
        untrained = replace(measurement, state=MeasurementState.TRAINING, motion=None)
        if frame.index < FIRST:
            held = gate.hold_untrained(frame, measurement)
            assert (held.state, held.reason) == (GateState.HOLD, HoldReason.TRAINING)
            assert as_live.decide(frame, untrained, LearningStatus(), ()).state is GateState.DISARMED
        else:
            assert gate.decide(frame, measurement, status, ()) == as_live.decide(frame, measurement, status, ())
    assert gate.is_armed
    assert OfflineGate(None).hold_untrained(*seen[0][:2]).state is GateState.DISARMED
