"""The checks of the newest frames together: each is handed what it needs, and the frame rate is that of a second."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.breath import Breath, GateSignal, SignalChoice
from engine.core.clock import NS_PER_S
from engine.core.frames import BodyPosition, LostReason, MeasurementState
from engine.core.gate_state import HoldReason
from engine.gating.gate import Interruption
from engine.gating.supervision.patient_shift import CORNERS, NODES
from engine.gating.supervision.supervisor import FrameSupervisor
from tests.support.control.loop_bench import ScriptedSource
from tests.support.gating.streams import LIMITS, START_NS, measured, motion_of, unmeasured

from engine.core.clock import ManualClock  # isort: skip

MODEL = object()
MARKERS_MM = np.array([[-100.0, -150.0, 850.0], [100.0, -150.0, 850.0], [100.0, 150.0, 850.0], [-100.0, 150.0, 850.0]])


class Supervised:
    """A supervisor and the frames that it is shown."""

    def __init__(self, **limits):
        self.supervisor = FrameSupervisor(replace(LIMITS, **limits))
        self.window = LIMITS.window
        self.clock = ManualClock(START_NS)
        self.source = ScriptedSource(self.clock, [])

    def show(self, measurement=None, *, has_reference=True):
        """Return the holds of a frame received now."""
        frame = self.source.frame()
        return self.supervisor.check(
            frame,
            measured(frame.index) if measurement is None else measurement,
            window=self.window,
            model=MODEL,
            has_reference=has_reference,
            notices=(),
        )

    def rated(self, count, within_ns):
        """Return the holds of the last of so many frames, evenly received within that time; the first is at 0."""
        first_ns = self.clock.now_ns()
        for number in range(count):
            self.clock.advance_ns(first_ns + number * within_ns // (count - 1) - self.clock.now_ns())
            found = self.show()
        return found


def lying(index, position=None):
    surface_mm = np.zeros((NODES, 3))
    surface_mm[list(CORNERS)] = MARKERS_MM
    return replace(measured(index, replace(motion_of(), surface_mm=surface_mm)), position=position)


def test_the_surface_s_position_holds_a_patient_who_was_raised():
    supervised = Supervised()
    raised = BodyPosition(measured_us=0, height_mm=9.0, tilt_deg=0.0, roll_deg=0.0)
    assert supervised.show(lying(0)) == ()
    assert supervised.show(lying(1)) == ()
    assert supervised.show(lying(2, raised)) == (
        Interruption(HoldReason.PATIENT_SHIFTED, "raised by 9.0 mm, 3 allowed"),
    )


def test_a_drift_is_forgotten_while_there_is_no_reference():
    supervised = Supervised()
    drifted, returning = (
        replace(
            measured(index),
            breaths=(Breath(signal=SignalChoice(), amplitude=12.0, exhale_us=0, exhale_drift=drift),),
        )
        for index, drift in ((0, 2.1), (1, 1.9))
    )
    assert [one.reason for one in supervised.show(drifted)] == [HoldReason.BASELINE_DRIFTED]
    assert supervised.show(returning, has_reference=False) == ()
    assert supervised.show(returning) == ()


@pytest.mark.parametrize(("within_ns", "frames"), [(NS_PER_S, 14), (NS_PER_S - 1, None), (NS_PER_S + 1, 14)])
def test_the_rate_counts_the_frames_of_the_last_second_and_only_after_one(within_ns, frames):
    """Of fifteen frames over a second, the first is a second old: it counts no more."""
    found = Supervised(min_fps=15.0).rated(15, within_ns)
    detail = f"{frames} frames in the last second, 15 needed"
    assert found == (() if frames is None else (Interruption(HoldReason.FRAME_RATE_LOW, detail),))


def test_a_rate_that_equals_its_limit_holds_nothing():
    assert Supervised(min_fps=15.0).rated(16, NS_PER_S) == ()


def test_a_shape_that_has_drifted_at_the_end_of_exhale_holds():
    supervised = Supervised()
    shifted = BodyPosition(measured_us=0, height_mm=0.0, tilt_deg=0.0, roll_deg=0.0, redistributed_mm=2.0)
    supervised.show(lying(0, shifted))
    later = replace(lying(1, shifted), breaths=(Breath(exhale_us=lying(0).timestamp_us),))
    assert [one.reason for one in supervised.show(later)] == [HoldReason.BASELINE_DRIFTED]
    supervised.supervisor.reset_position()
    assert supervised.show(lying(2, shifted)) == ()


@pytest.mark.parametrize(
    ("choice", "is_held"), [(SignalChoice(), False), (SignalChoice(signal=GateSignal.REGION, row=3, column=4), True)]
)
def test_the_markers_travel_is_bounded_for_windows_on_parts(choice, is_held):
    supervised = Supervised(max_shift_mm=20.0, max_marker_travel_mm=3.0)
    supervised.window = replace(LIMITS.window, choice=choice)
    supervised.show(lying(0))
    supervised.show(lying(1))
    slid = lying(2)
    surface_mm = slid.motion.surface_mm + np.array([0.0, 4.0, 0.0])
    holds = supervised.show(replace(slid, motion=replace(slid.motion, surface_mm=surface_mm)))
    assert [one.reason for one in holds] == [HoldReason.PATIENT_SHIFTED] * is_held
    assert supervised.supervisor.marker_travel_mm == pytest.approx(4.0)


@pytest.mark.parametrize("new_between", [0, 1, 20, 3000])
def test_every_repeated_picture_may_make_all_later_ones_older(new_between):
    """Two repeated pictures of 33.4 ms are within 100 ms, the third is a fault, however far apart they come."""
    supervised = Supervised()
    found, index = [], 0
    for _ in range(8):
        for _ in range(new_between):
            assert supervised.show(measured(index)) == ()
            index += 1
        found.append(supervised.show(unmeasured(measured(index), MeasurementState.LOST, LostReason.FRAME_FROZEN)))
        index += 1
    first = 3 if new_between == 0 else 2  # the step before a session's first frame is not known
    assert [[one.reason for one in holds] for holds in found[: first + 1]] == [[]] * first + [[HoldReason.FRAME_STALE]]
    assert "100 ms" in found[first][0].detail
    assert sum(map(len, found)) == (5 if new_between == 0 else 2), "a new picture after the fault resets the sum"


def test_the_second_picture_that_is_old_in_part_is_a_fault():
    """A lower half that lags by two frames repeats two of them, and then never again: its parts stay of two moments."""
    supervised = Supervised()
    assert supervised.show(measured(0)) == ()
    old = [unmeasured(measured(index), MeasurementState.LOST, LostReason.FRAME_TORN) for index in (1, 2)]
    assert supervised.show(old[0]) == (), "one is a hold by itself, not a fault"
    (hold,) = supervised.show(old[1])
    assert hold.reason is HoldReason.FRAME_STALE
    assert "50 allowed" in hold.detail
    assert supervised.show(measured(3)) == ()
    whole = [unmeasured(measured(index), MeasurementState.LOST, LostReason.FRAME_FROZEN) for index in (4, 5)]
    assert [supervised.show(one) for one in whole] == [(), ()], "whole pictures have their own bound again"


def test_the_markers_travel_is_that_of_the_last_ten_seconds():
    supervised = Supervised(max_shift_mm=20.0)
    there = lying(0).motion.surface_mm + np.array([0.0, 4.0, 0.0])
    supervised.show(lying(0))
    for index in range(1, 5):
        supervised.show(replace(lying(index), motion=replace(lying(index).motion, surface_mm=there)))
    supervised.show(lying(5))
    assert supervised.supervisor.marker_travel_mm == pytest.approx(4.0)
    supervised.show(lying(400))
    assert supervised.supervisor.marker_travel_mm == pytest.approx(0.0)


def test_frames_that_are_lost_for_another_reason_make_no_later_picture_older():
    supervised = Supervised()
    lost = [unmeasured(measured(index), MeasurementState.LOST, LostReason.MARKER_LOST) for index in range(30)]
    assert [supervised.show(one) for one in lost] == [()] * 30
