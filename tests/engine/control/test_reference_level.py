"""A reference needs a reason where an amplitude window is used and the level lies within the breath."""

import math
from dataclasses import replace

import pytest

from engine.core.breath import WHOLE, SignalChoice
from engine.core.commands import SetReference
from engine.core.errors import CommandRefusedError
from engine.core.frames import LostReason, MeasurementState
from engine.core.reference import ReferenceMoment, ReferenceProposal
from engine.core.signals import LearnedRange
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, JoinedWindow, PhaseWindow
from tests.support.control.loop_bench import Bench, after, good
from tests.support.gating.streams import LEVEL_MM, LIMITS, unmeasured

EXHALE, INHALE, NOW = ReferenceMoment
VOLUME = SignalChoice(signal="volume")


def proposal(percent, *, moment=EXHALE, level=-3.0):
    return ReferenceProposal(moment=moment, level=level, scatter=0.2, breaths=4, percent=percent)


def asked(*, ranges=None, proposals=(), window=LIMITS.window, spoil=None, **command):
    """Ask for the reference behind three frames; return the answer's error, and what the learner was asked for."""
    bench = Bench([], limits=replace(LIMITS, window=window))
    if spoil is not None:
        bench.pipeline.spoil.update(dict.fromkeys(range(10), spoil))
    bench.pipeline.proposals = proposals
    if ranges is not None:
        bench.pipeline.ranges = ranges
    ask = bench.ask(SetReference(operator="ann", **command))
    bench.source.script = [good] * 3 + [after(ask), good, good]
    bench.run()
    return bench.answers[-1].exception(timeout=0), bench.pipeline.moments


def at(percent):
    """Ranges in which the present level has this place."""
    return {WHOLE: LearnedRange(low=LEVEL_MM - percent / 10.0, high=LEVEL_MM - percent / 10.0 + 10.0)}


@pytest.mark.parametrize("percent", [-30.0, 0.0, 14.9, 85.1, 120.0])
def test_near_the_end_of_exhale_or_inhale_no_reason_is_needed(percent):
    for given in ({"ranges": at(percent)}, {"proposals": (proposal(percent),), "moment": EXHALE}):
        error, moments = asked(**given)
        assert error is None
        assert moments == [given.get("moment", NOW)]


@pytest.mark.parametrize("percent", [15.2, 50.0, 84.8])
def test_a_level_within_the_breath_needs_a_reason(percent):
    for given in ({"ranges": at(percent)}, {"proposals": (proposal(percent),), "moment": EXHALE}):
        error, moments = asked(**given)
        assert isinstance(error, CommandRefusedError)
        assert f"at {percent:.0f} %" in str(error)
        assert moments == []
        assert asked(**given, reason="the plan is for mid-ventilation") == (None, [given.get("moment", NOW)])


def test_a_place_that_is_not_known_needs_a_reason():
    for given in ({"ranges": {}}, {"proposals": (proposal(None),), "moment": EXHALE}):
        assert "the level lies at an unknown place of the learned breath" in str(asked(**given)[0])
        assert asked(**given, reason="shallow")[0] is None


@pytest.mark.parametrize(
    ("window", "needs_reason"),
    [
        (BreathHoldWindow(level=LIMITS.window), False),
        (PhaseWindow(from_percent=40.0, to_percent=60.0), False),
        (
            JoinedWindow(conditions=(PhaseWindow(from_percent=40.0, to_percent=60.0), LIMITS.window), join="and"),
            True,
        ),
    ],
)
def test_only_amplitude_windows_need_one(window, needs_reason):
    assert (asked(ranges=at(50.0), window=window)[0] is not None) == needs_reason


def test_a_moment_that_is_not_known_is_refused():
    error, moments = asked(moment=INHALE, proposals=(proposal(0.0),))
    assert "fewer than two breaths" in str(error)
    assert moments == []


@pytest.mark.parametrize(("seen", "is_refused"), [(-3.0, False), (-3.49, False), (-3.51, True), (-2.4, True)])
def test_a_level_that_is_another_by_now_is_refused(seen, is_refused):
    error, _ = asked(moment=EXHALE, proposals=(proposal(0.0),), level_seen=seen)
    assert (error is not None) == is_refused
    assert error is None or "-3.00 mm by now" in str(error)


@pytest.mark.parametrize("percent", [15.0, 85.0])
def test_the_ends_of_the_range_themselves_need_no_reason(percent):
    assert asked(moment=EXHALE, proposals=(proposal(percent),))[0] is None


@pytest.mark.parametrize(
    ("choice", "seen", "is_refused"),
    [(WHOLE, -2.5, False), (WHOLE, -3.5, False), (VOLUME, -2.96, False), (VOLUME, -2.94, True)],
)
def test_the_level_seen_may_differ_by_the_tolerance_itself_and_of_the_volume_by_a_tenth_of_it(choice, seen, is_refused):
    window = AmplitudeWindow(choice=choice, lower=-1.0, upper=3.0, unit=choice.unit)
    error, _ = asked(moment=EXHALE, proposals=(proposal(0.0),), level_seen=seen, window=window)
    assert (error is not None) == is_refused


@pytest.mark.parametrize(("seen", "is_refused"), [(LEVEL_MM, False), (LEVEL_MM + 0.6, True)])
def test_the_level_seen_is_compared_with_the_newest_frame_s(seen, is_refused):
    error, _ = asked(ranges=at(0.0), level_seen=seen)
    assert (error is not None) == is_refused
    assert error is None or f"the level is {LEVEL_MM:.2f} mm by now, not {seen:g}" in str(error)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda frame: unmeasured(frame, MeasurementState.LOST, LostReason.MARKER_LOST),
        lambda frame: replace(frame, motion=replace(frame.motion, whole_mm=math.nan)),
    ],
    ids=["not measured", "no number"],
)
def test_no_reference_is_taken_from_frames_that_are_not_measured(spoil):
    error, moments = asked(level_seen=LEVEL_MM, reason="as planned", spoil=spoil)
    assert "measured: " in str(error)
    assert moments == []


@pytest.mark.parametrize("reason", [LostReason.RESIDUAL_HIGH, LostReason.SURFACE_CHANGED])
def test_a_surface_that_is_doubted_is_ended_by_a_reference(reason):
    """It is taken up by a measured frame only; without that a person had to train again, or make another session."""
    error, moments = asked(
        reason="the sheet is off", spoil=lambda frame: unmeasured(frame, MeasurementState.LOST, reason)
    )
    assert error is None
    assert len(moments) == 1
