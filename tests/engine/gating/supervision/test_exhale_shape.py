"""At the end of exhale a tilt, and a shift between thorax and abdomen, are drifts; in between they are a breath's."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.breath import Breath
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, BodyPosition
from engine.core.gate_state import HoldReason
from engine.gating.supervision.supervisor import REDISTRIBUTED_SHARE, ExhaleShape
from tests.support.gating.streams import LIMITS, measured, motion_of

LENGTH_MM = 300.0
BOUND_MM = REDISTRIBUTED_SHARE * LIMITS.max_baseline_drift_mm
SURFACE_MM = np.zeros((NODE_ROWS, NODE_COLUMNS, 3))
SURFACE_MM[:, :, 0] = np.linspace(-150.0, 150.0, NODE_COLUMNS)
SURFACE_MM[:, :, 1] = 100.0 + np.linspace(0.0, LENGTH_MM, NODE_ROWS)[:, None]


class Breathing:
    """Frames with a shape each; an end of exhale is known a second after it was."""

    def __init__(self):
        self.shape, self.index, self.exhale_us = ExhaleShape(LIMITS), 1_000, None  # half a minute of device time

    def show(self, *, tilt_deg=0.0, redistributed_mm=0.0, exhale_at=None, has_reference=True):
        self.index += 1
        self.exhale_us = self.exhale_us if exhale_at is None else measured(exhale_at).timestamp_us
        frame = replace(
            measured(self.index, replace(motion_of(), surface_mm=SURFACE_MM.reshape(-1, 3))),
            breaths=(Breath(exhale_us=self.exhale_us),),
            position=BodyPosition(
                measured_us=0, height_mm=0.0, tilt_deg=tilt_deg, roll_deg=0.0, redistributed_mm=redistributed_mm
            ),
        )
        return self.shape.check(frame, has_reference=has_reference)

    def breath(self, **at_exhale):
        """Show a breath: much of everything in between, and this at its end of exhale; return the last hold."""
        for _ in range(20):
            self.show(tilt_deg=2.0, redistributed_mm=3.0)
        exhale_at = self.index + 1
        self.show(**at_exhale)
        for _ in range(20):
            self.show(tilt_deg=2.0, redistributed_mm=3.0)
        return self.show(exhale_at=exhale_at)


@pytest.mark.parametrize("redistributed_mm", [0.0, BOUND_MM - 0.01])
def test_what_a_breath_shifts_in_between_is_no_drift(redistributed_mm):
    breathing = Breathing()
    assert [breathing.breath(redistributed_mm=redistributed_mm) for _ in range(4)] == [None] * 4


def test_a_shift_that_is_left_at_the_end_of_exhale_holds_until_it_is_gone_there():
    breathing = Breathing()
    assert breathing.breath() is None
    found = breathing.breath(redistributed_mm=BOUND_MM + 0.01)
    assert found.reason is HoldReason.BASELINE_DRIFTED
    assert found.detail.startswith("at the end of exhale thorax and abdomen are shifted by 0.6 mm")
    assert "0.6 allowed" in found.detail
    assert breathing.show() == found  # between two ends of exhale it stands
    assert breathing.breath(redistributed_mm=0.95 * BOUND_MM) is not None
    assert breathing.breath(redistributed_mm=0.85 * BOUND_MM) is None


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("ends_mm", "is_held"), [(1.9, False), (2.1, True)])
def test_a_tilt_counts_by_what_it_moves_the_region_s_ends(ends_mm, is_held, sign):
    tilt_deg = sign * np.degrees(np.arctan(ends_mm / (0.5 * LENGTH_MM)))
    found = Breathing().breath(tilt_deg=float(tilt_deg))
    assert (found is not None) is is_held
    assert found is None or "2.1 mm at the region's ends" in found.detail


def test_a_reference_accepts_the_present_shape_and_an_exhale_before_it_states_nothing():
    breathing = Breathing()
    assert breathing.breath(redistributed_mm=2.0) is not None
    breathing.shape.reset()
    assert breathing.show() is None
    assert breathing.show(exhale_at=breathing.index - 20) is None  # of before: its shape is not known
    assert breathing.breath(redistributed_mm=2.0) is not None
    assert breathing.show(has_reference=False) is None


def test_a_shape_that_is_no_number_holds():
    assert Breathing().breath(redistributed_mm=float("nan")) is not None


@pytest.mark.parametrize(("pause_s", "reason"), [(20.0, "drifted"), (120.0, "drifted"), (140.0, "missing")])
def test_a_breath_that_pauses_is_judged_up_to_the_longest_that_a_site_allows_and_then_said_to_be_missing(
    pause_s, reason
):
    """The end of exhale is known when the next inhale has begun, at the end of the pause."""
    breathing = Breathing()
    breathing.show()
    exhale_at = breathing.index + 1
    for _ in range(round(pause_s * 29.97)):
        assert breathing.show(redistributed_mm=2.0) is None
    found = breathing.show(exhale_at=exhale_at)
    assert found.reason is {"drifted": HoldReason.BASELINE_DRIFTED, "missing": HoldReason.CHECK_MISSING}[reason]
    assert breathing.breath() is None, "the next breath is judged again"
