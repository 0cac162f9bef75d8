"""References and baseline corrections share one budget, measured from the fraction's first reference."""

from dataclasses import replace

import pytest

from engine.core.breath import WHOLE, SignalChoice
from engine.core.commands import Arm, CorrectBaseline, SetReference
from engine.core.errors import CommandRefusedError, ReferenceDistanceError
from engine.core.reference import ReferenceDistance, SignalLevel
from engine.core.signals import LearnedRange
from engine.gating.windows import AmplitudeWindow
from tests.support.control.loop_bench import Bench, after, good
from tests.support.gating.streams import LEVEL_MM, LIMITS

VOLUME = SignalChoice(signal="volume")
REASON = {"reason": "the bladder is full", "may_exceed": True}
BEYOND_NO_MORE = ({}, {"may_exceed": True}, {"reason": "as it is"}, {"may_exceed": True, "reason": "  "})
UNKNOWN = ReferenceDistance(unknown="the camera was disconnected since")
AT_EXHALE = {WHOLE: LearnedRange(low=LEVEL_MM, high=LEVEL_MM + 10.0)}


def at(level, *, moved_mm=0.0, choice=WHOLE):
    """A reference at this level against the first, whose surface has moved so far."""
    return ReferenceDistance(
        moved_mm=moved_mm,
        shift_mm=0.1,
        height_mm=level,
        turn_deg=0.2,
        tilt_deg=0.3,
        shape_mm=0.4,
        levels=(SignalLevel(choice, level),),
    )


def asked(*commands, lies=None, would_lie=None, limits=LIMITS, is_armed=False):
    """Ask for commands one after the other; return the bench, and each answer's error."""
    bench = Bench([good] * 3, limits=limits)
    bench.pipeline.distance, bench.pipeline.distance_of_next = lies, would_lie
    bench.pipeline.ranges = AT_EXHALE
    acts = [Arm(operator="ann"), *commands] if is_armed else list(commands)
    for command in acts:
        bench.source.script += [after(bench.ask(command)), *[good] * 6]
    bench.run()
    return bench, [answer.exception(timeout=0) for answer in bench.answers][len(acts) - len(commands) :]


def correct(by, **who):
    return CorrectBaseline(operator="bob", by=by, **who)


def set_it(**who):
    return SetReference(operator="bob", **who)


def test_two_corrections_of_a_millimetre_and_a_half_are_beyond_the_budget_together():
    bench, (first, second) = asked(correct(1.5), correct(1.5))
    assert first is None
    assert isinstance(second, ReferenceDistanceError)
    assert second.field == "by"
    assert "3.00 mm from the fraction's first" in second.value
    assert second.bound == "within 2 mm of it"
    window = bench.loop.status.view.window
    assert (window.lower, window.upper) == (0.5, 4.5)


def test_a_correction_counts_on_top_of_the_reference_and_one_back_towards_the_first_is_free():
    assert isinstance(asked(correct(1.0), lies=at(1.5))[1][0], ReferenceDistanceError)
    assert asked(correct(-1.0), lies=at(1.5))[1] == [None]
    assert isinstance(asked(correct(1.0), lies=at(0.5, moved_mm=2.1))[1][0], ReferenceDistanceError)


@pytest.mark.parametrize("who", BEYOND_NO_MORE)
def test_beyond_the_budget_no_one_goes_without_a_reason_and_no_program_at_all(who):
    for command, given in ((set_it(**who), {"would_lie": at(2.5)}), (correct(2.5, **who), {})):
        bench, (error,) = asked(command, is_armed=True, **given)
        assert isinstance(error, ReferenceDistanceError)
        words = "has to give a reason" if who.get("may_exceed") else "only a person who may arm"
        assert words in str(error)
        assert bench.records()[-1].line_on  # a refusal disturbs nothing
        assert bench.pipeline.moments == []


def test_with_a_reason_a_person_goes_beyond_it():
    bench, errors = asked(set_it(**REASON), correct(2.5, **REASON), would_lie=at(7.0))
    assert errors == [None, None]
    assert bench.pipeline.most_mm == [None]


def test_within_the_budget_no_reason_is_needed_and_the_learner_keeps_to_it():
    for level, is_refused in ((2.0, False), (-2.0, False), (2.01, True), (-2.01, True)):
        bench, (error,) = asked(set_it(), would_lie=at(level))
        assert isinstance(error, ReferenceDistanceError) == is_refused
        assert bench.pipeline.most_mm == ([] if is_refused else [2.0])


def test_the_first_reference_has_no_distance_but_the_learner_knows_the_budget():
    bench, (error,) = asked(set_it())
    assert error is None
    assert bench.pipeline.most_mm == [2.0]


def test_a_distance_that_is_not_known_is_beyond_the_budget():
    for command, given in ((set_it(), {"would_lie": UNKNOWN}), (correct(0.1), {"lies": UNKNOWN})):
        error = asked(command, **given)[1][0]
        assert isinstance(error, ReferenceDistanceError)
        assert "the camera was disconnected" in str(error)
    assert asked(set_it(**REASON), would_lie=UNKNOWN)[1] == [None]


def test_the_site_sets_the_budget_and_a_tenth_of_a_litre_counts_as_a_millimetre():
    wide = replace(LIMITS, max_reference_distance_mm=4.0)
    assert asked(set_it(), would_lie=at(3.9), limits=wide)[1] == [None]
    assert "within 4 mm" in str(asked(set_it(), would_lie=at(4.1), limits=wide)[1][0])
    volume = replace(LIMITS, window=AmplitudeWindow(choice=VOLUME, lower=-0.1, upper=0.3, unit="l"))
    assert asked(correct(0.19), limits=volume)[1] == [None]
    assert isinstance(asked(correct(0.21), limits=volume)[1][0], ReferenceDistanceError)


def test_a_new_reference_drops_the_correction_and_its_own_distance_counts():
    _, errors = asked(correct(1.5), set_it(), correct(1.5), would_lie=at(0.0))
    assert errors == [None, None, None]
    _, errors = asked(set_it(), correct(1.5), lies=at(1.9), would_lie=at(1.9))
    assert [type(error) for error in errors] == [type(None), ReferenceDistanceError]


def test_the_view_shows_the_distance_with_the_correction():
    bench, _ = asked(correct(0.5), lies=at(1.0))
    view = bench.loop.status.view
    assert view.reference_distance.distance_mm == pytest.approx(1.5)
    assert view.reference_distance.correction == 0.5
    assert view.reference_budget_mm == 2.0
    assert asked()[0].loop.status.view.reference_distance is None


def test_a_position_that_is_not_known_is_refused_as_before():
    bench = Bench([good] * 3)
    bench.pipeline.model = None
    bench.source.script += [after(bench.ask(set_it())), good]
    bench.run()
    assert not isinstance(bench.answers[0].exception(timeout=0), CommandRefusedError)


def test_a_refusal_names_the_field_of_the_command():
    for command, field in ((set_it(), "reference"), (correct(2.5), "by")):
        assert asked(command, would_lie=at(2.5))[1][0].field == field


def test_before_a_reference_is_set_only_the_correction_counts():
    narrow = replace(LIMITS, max_reference_distance_mm=0.9)
    assert asked(correct(0.5), limits=narrow)[1] == [None]
    assert "0.95 mm from the fraction's first" in asked(correct(0.95), limits=narrow)[1][0].value
