"""What the camera does not see of a gated signal, from the depth picture to the gate."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.breath import SignalChoice
from engine.core.clock import ManualClock
from engine.core.commands import Arm
from engine.core.frames import MeasurementState
from engine.core.gate_state import GateState, HoldReason
from engine.gating.gate import Gate, step_gate
from engine.gating.windows import AmplitudeWindow, Unit
from engine.motion.learning.trainer import InlineTrainer, TrainingSettings
from engine.motion.named_regions import NamedRegion
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from tests.support.gating.streams import LIMITS
from tests.support.motion import small_scene

HIGH = NamedRegion(name="high", vertices=((30.0, 40.0), (30.0, 160.0), (120.0, 160.0), (120.0, 40.0)))
LOW = NamedRegion(name="low", vertices=((290.0, 40.0), (290.0, 160.0), (340.0, 160.0), (340.0, 40.0)))
SETTINGS = PipelineSettings(
    points=((80, 100), (320, 100)),
    named=(HIGH, LOW),
    breath_signals=(SignalChoice(signal="region", row=3, column=4), SignalChoice(signal="region", row=12, column=4)),
    training=TrainingSettings(min_frames=40, min_seconds=4.0, min_cycles=1, max_seconds=20.0),
)
CELL_HIGH, CELL_LOW = (SignalChoice(signal="region", row=row, column=4) for row in (3, 12))
POINT_HIGH, POINT_LOW = (
    SignalChoice(signal="point", row=row, column=100, index=index) for index, row in enumerate((80, 320))
)
NAMED_HIGH, NAMED_LOW = (
    SignalChoice(signal="named", name=name, index=index) for index, name in enumerate(("high", "low"))
)
THORAX, ABDOMEN = SignalChoice(signal="thorax"), SignalChoice(signal="abdomen")
WHOLE, VOLUME = SignalChoice(), SignalChoice(signal="volume")
SEEN_SIGNALS = (CELL_HIGH, POINT_HIGH, NAMED_HIGH, THORAX)
BLIND_SIGNALS = (CELL_LOW, POINT_LOW, NAMED_LOW, ABDOMEN, WHOLE, VOLUME)
STEP = 3
RAISED_MM = 8
HONEST, BLIND = 6, 4


def blind_fifth(depth):
    """The lowest fifth of the region reads nothing, and the skin there is higher."""
    top, bottom = small_scene.CORNERS_PX[0, 1], small_scene.CORNERS_PX[2, 1]
    from_row = round(top + 0.81 * (bottom - top))
    depth[from_row:] -= RAISED_MM
    depth[from_row : round(bottom) + 4] = 0


def new_pipeline(model=None):
    pipeline = Pipeline(small_scene.CALIBRATION, SETTINGS, ManualClock(), InlineTrainer())
    if model is not None:
        pipeline.learner.activate(model)
    return pipeline


def measure(pipeline, first, count, **how):
    return [pipeline.measure(small_scene.frame(index, **how)) for index in range(first, first + STEP * count, STEP)]


@pytest.fixture(scope="module")
def model():
    pipeline = new_pipeline()
    for index in range(0, 900, STEP):
        if pipeline.measure(small_scene.frame(index)).state is MeasurementState.MEASURING:
            return pipeline.learner.status.model
    raise AssertionError("not learned")


@pytest.fixture(scope="module")
def measurements(model):
    """Honest frames, then some in which the lowest fifth is not seen, then honest ones."""
    pipeline = new_pipeline(model)
    while measure(pipeline, 0, 1)[0].state is not MeasurementState.MEASURING:
        pass
    honest = measure(pipeline, STEP, HONEST)
    blind = measure(pipeline, STEP * (1 + HONEST), BLIND, edit=blind_fifth)
    return honest + blind + measure(pipeline, STEP * (1 + HONEST + BLIND), HONEST)


def gated(measurements, choice):
    """Let a gate on one signal decide on the measurements; return its states."""
    unit = Unit.L if choice.is_volume else Unit.MM
    limits = replace(
        LIMITS,
        window=AmplitudeWindow(choice=choice, lower=-20.0, upper=20.0, unit=unit),
        max_gap_ms=200.0,
        lease_ms=200.0,
        max_jump_mm=20.0,
        min_valid_share=0.7,
        is_played=True,
    )
    gate, states = step_gate(Gate(), Arm(operator="ann"), 0, limits), []
    for number, measurement in enumerate(measurements):
        gate = step_gate(gate, replace(measurement, frame_index=number), measurement.received_ns, limits)
        states.append(gate)
    return states


def test_all_of_these_frames_are_measured_as_if_nothing_was_missing(measurements):
    assert {one.state for one in measurements} == {MeasurementState.MEASURING}
    blind = measurements[HONEST].motion.projection
    assert blind.residual_mm < 1.0
    assert 0.75 < blind.valid_share < 0.85
    assert blind.inlier_share > 0.95


@pytest.mark.parametrize("choice", SEEN_SIGNALS + BLIND_SIGNALS, ids=lambda choice: choice.label)
def test_a_gated_signal_over_raised_skin_that_is_not_seen_is_held_by_name_and_the_rest_may_gate(measurements, choice):
    gates = gated(measurements, choice)
    assert gates[HONEST - 1].state is GateState.BEAM_ON
    blind = gates[HONEST : HONEST + BLIND]
    if choice in SEEN_SIGNALS:
        assert {gate.state for gate in blind} == {GateState.BEAM_ON}
        return
    assert {(gate.state, gate.reason) for gate in blind} == {(GateState.HOLD, HoldReason.COVERAGE_LOW)}
    assert all(gate.detail.startswith(f"{choice.label}: 0.") for gate in blind)
    assert gates[-1].state is GateState.BEAM_ON


def test_the_shares_are_those_of_the_places(measurements):
    shares = measurements[HONEST].motion.seen
    for choice in (CELL_LOW, POINT_LOW, NAMED_LOW):
        assert choice.seen_in(shares) < 0.3
    for choice in SEEN_SIGNALS:
        assert choice.seen_in(shares) > 0.95
    assert ABDOMEN.seen_in(shares) == pytest.approx(0.62, abs=0.05)
    assert shares.cells.shape == (14, 8)
    assert np.asarray(measurements[HONEST - 1].motion.seen.cells).min() > 0.6


def test_a_signal_that_is_not_seen_has_no_breathing_meanwhile(measurements):
    for measurement, is_blind in ((measurements[HONEST - 1], False), (measurements[HONEST + 1], True)):
        high, low = measurement.breaths
        assert (high.signal, low.signal) == (CELL_HIGH, CELL_LOW)
        assert high.note != "not measured"
        assert (low.note == "not measured") is is_blind


def test_a_reference_over_a_place_that_is_not_seen_does_not_count_there(model):
    pipeline = new_pipeline(model)
    while (last := measure(pipeline, 0, 1, edit=blind_fifth)[0]).state is not MeasurementState.MEASURING:
        pass
    assert CELL_LOW.seen_in(last.motion.reference_seen) < 0.3
    now = measure(pipeline, STEP, 2)[-1].motion
    assert CELL_LOW.seen_in(now.seen) > 0.95
    assert CELL_LOW.seen_in(now.reference_seen) < 0.3
    assert CELL_HIGH.seen_in(now.reference_seen) > 0.95
    pipeline.learner.set_reference()
    again = measure(pipeline, 3 * STEP, 1)[0].motion
    assert CELL_HIGH.seen_in(again.reference_seen) > 0.95
