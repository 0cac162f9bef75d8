"""A check that cannot work finds nothing: the beam does not rest on it for more than half a second."""

from dataclasses import replace

import pytest
from hypothesis import given, strategies as st

from engine.core.frames import Evidence, MeasurementState
from engine.core.gate_state import HoldReason
from engine.gating.limits import MAX_UNCHECKED_US
from engine.gating.supervision.checks import SEES_TOO_LITTLE, Check, Checks
from tests.support.gating.streams import LIMITS, measured, unmeasured

ALL = Evidence(surface=True, color=True, camera=True)
PERIOD_US = 33_333


class Watched:
    """Checks, and frames at 30 a second."""

    def __init__(self, *, needs_all=False):
        self.checks = Checks(replace(LIMITS, needs_all_checks=needs_all))
        self.index = 0

    def show(self, evidence, *, frames=1, has_reference=True):
        """Return the hold at the last of so many frames; of "markers" the frames have none."""
        has_markers, evidence = evidence != Check.MARKERS, ALL if evidence == Check.MARKERS else evidence
        for _ in range(frames):
            self.index += 1
            frame = replace(measured(self.index), evidence=evidence, timestamp_us=self.index * PERIOD_US)
            found = self.checks.check(frame, has_reference=has_reference, has_markers=has_markers)
        return found


def without(check):
    return check if check is Check.MARKERS else ALL._replace(**{check.value: False})


@pytest.mark.parametrize("check", Check)
def test_a_check_that_cannot_work_any_more_holds_after_half_a_second(check):
    watched = Watched()
    assert watched.show(ALL) is None
    assert watched.show(without(check), frames=16) is None  # 0.50 s since the first of them
    found = watched.show(without(check))
    assert found.reason is HoldReason.CHECK_MISSING
    assert found.detail.startswith(f"{check}, for 0.5 s: {SEES_TOO_LITTLE[check]}")
    assert watched.show(ALL) is None


@pytest.mark.parametrize("check", Check)
def test_a_check_that_never_worked_since_the_reference_holds_where_the_site_needs_all(check):
    assert Watched().show(without(check), frames=300) is None
    found = Watched(needs_all=True).show(without(check))
    assert found.reason is HoldReason.CHECK_MISSING
    assert found.detail.startswith(f"{check}, not once since the reference")


def test_a_measured_frame_without_evidence_has_none_of_the_checks():
    assert Watched(needs_all=True).show(None).reason is HoldReason.CHECK_MISSING


def test_a_new_reference_and_none_forget_what_worked_before():
    watched = Watched()
    watched.show(ALL)
    watched.checks.reset()
    assert watched.show(without(Check.CAMERA), frames=60) is None
    watched.show(ALL)
    assert watched.show(without(Check.CAMERA), has_reference=False) is None
    assert watched.checks.states == ()
    assert watched.show(without(Check.CAMERA), frames=60) is None


def test_frames_that_were_not_measured_neither_start_nor_end_the_time():
    watched = Watched()
    watched.show(ALL)
    watched.show(without(Check.COLOR))
    watched.index += 30
    assert (
        watched.checks.check(
            unmeasured(measured(watched.index), MeasurementState.LOST), has_reference=True, has_markers=False
        )
        is None
    )
    assert watched.show(without(Check.COLOR)).reason is HoldReason.CHECK_MISSING


@given(st.lists(st.tuples(st.booleans(), st.integers(min_value=1, max_value=40)), min_size=1, max_size=12))
def test_no_frame_is_unheld_whose_check_has_not_worked_for_longer_than_allowed(spells):
    """The oracle counts for itself when the colour was compared last."""
    watched, last_us = Watched(), None
    for works, frames in spells:
        for _ in range(frames):
            found = watched.show(ALL if works else without(Check.COLOR))
            now_us = watched.index * PERIOD_US
            if works:
                last_us = now_us
            is_overdue = last_us is not None and now_us - last_us > MAX_UNCHECKED_US + PERIOD_US
            assert (found is not None) == is_overdue


def test_a_clock_that_goes_back_while_a_check_is_silent_holds():
    watched = Watched()
    watched.show(ALL)
    assert watched.show(without(Check.SURFACE)) is None
    watched.index -= 10
    assert watched.show(without(Check.SURFACE)).reason is HoldReason.CHECK_MISSING
