"""Before a fraction's first arming, a second person countersigns exactly what would be armed."""

from dataclasses import replace
from functools import partial

import pytest

from engine.control.arming_outlook import CountersignatureState
from engine.core.breath import WHOLE
from engine.core.commands import ActivateModel, Arm, CorrectBaseline, Countersign, Disarm, SetReference
from engine.core.errors import CountersignatureError, ReasonMissingError
from engine.gating.active_window import SetWindow
from engine.gating.windows import amplitude_window
from tests.support.control.loop_bench import Bench, after, good
from tests.support.gating.streams import LEVEL_MM, LIMITS

WINDOW = amplitude_window(lower_mm=LEVEL_MM - 1.0, upper_mm=LEVEL_MM + 3.0)
DISARM = Disarm(operator="ann")


def arm(name):
    return Arm(operator=name, head_direction=LIMITS.head_direction)


def sign(name, seen=None):
    def act(bench):
        bench.ask(Countersign(operator=name, seen=seen or bench.loop.status.arming_state))()

    return act


def moved_by(mm, **who):
    times = {"dwell_ms": LIMITS.dwell_ms, "min_on_ms": 0.0, "min_off_ms": 0.0, "max_cycles_per_min": 120}
    return SetWindow(operator="ann", window=WINDOW.shifted(WHOLE, mm), **times, **who)


def asked(*acts, is_needed=True, is_continued=False, has_reference=True):
    """Carry the acts out one after the other; return the bench and the error of each answer."""
    limits = replace(LIMITS, window=WINDOW, max_duty_percent=100.0, needs_countersignature=is_needed)
    bench = Bench([good] * 3, limits=limits)
    bench.pipeline.is_fraction_continued = is_continued
    bench.pipeline.has_reference = has_reference
    for act in acts:
        bench.source.script += [after(partial(act, bench) if callable(act) else bench.ask(act)), *[good] * 6]
    bench.run()
    return bench, [answer.exception(timeout=0) for answer in bench.answers]


def test_without_it_the_first_arming_is_refused_and_no_permit_given():
    bench, (error,) = asked(arm("ann"))
    assert isinstance(error, CountersignatureError)
    assert not any(record.line_on for record in bench.records())
    assert bench.loop.status.countersignature == CountersignatureState(is_required=True)


def test_a_site_that_does_not_want_it_asks_for_none():
    bench, (arming,) = asked(arm("ann"), is_needed=False)
    assert arming is None
    assert bench.records()[-1].line_on
    _, (error,) = asked(sign("bob"), is_needed=False)
    assert isinstance(error, CountersignatureError)


@pytest.mark.parametrize(("signer", "armer", "is_armed"), [("bob", "ann", True), ("ann", "ann", False)])
def test_another_person_than_the_one_who_arms_has_signed(signer, armer, is_armed):
    bench, (signing, arming) = asked(sign(signer), arm(armer))
    assert signing is None
    assert (arming is None) == is_armed
    assert isinstance(arming, CountersignatureError | None)
    assert arming is None or str(arming) == "ann has countersigned: another person has to arm"
    assert bench.records()[-1].line_on == is_armed


@pytest.mark.parametrize(("setter", "is_armed"), [("bob", False), ("ann", True)])
def test_where_a_program_arms_another_person_than_the_one_who_set_the_reference_has_signed(setter, is_armed):
    program = replace(arm("key:planning"), is_person=False)
    reference = SetReference(operator=setter, reason="as the test wants it")
    _, errors = asked(reference, sign("bob"), program)
    assert errors[:2] == [None, None]
    assert (errors[2] is None) == is_armed
    assert isinstance(errors[2], CountersignatureError | None)
    assert is_armed or str(errors[2]) == "bob has countersigned: another person has to set the reference"


CHANGES = {
    "window": moved_by(0.5, reason="the bladder is full"),
    "correction": CorrectBaseline(operator="ann", by=0.5),
    "reference": SetReference(operator="ann", reason="as the test wants it"),
    "model": ActivateModel(operator="ann", model=object()),
}


@pytest.mark.parametrize("what", CHANGES)
def test_any_change_of_what_was_signed_ends_it(what):
    bench, errors = asked(sign("bob"), CHANGES[what], arm("ann"))
    assert errors[:2] == [None, None]
    assert isinstance(errors[2], CountersignatureError)
    assert bench.loop.status.countersignature.signed_by is None


def test_something_else_than_would_be_armed_is_not_signed():
    _, (error,) = asked(sign("bob", seen="0" * 32))
    assert isinstance(error, CountersignatureError)
    assert "look again" in str(error)


def test_without_a_reference_and_while_armed_nothing_is_signed():
    _, (error,) = asked(sign("bob"), has_reference=False)
    assert isinstance(error, CountersignatureError)
    _, errors = asked(sign("bob"), arm("ann"), sign("bob"))
    assert errors[:2] == [None, None]
    assert isinstance(errors[2], CountersignatureError)


def test_later_armings_of_the_fraction_need_none_unless_the_window_goes_beyond_its_budget():
    reason = {"reason": "the bladder is full", "may_exceed": True}
    acts = [sign("bob"), arm("ann"), DISARM, moved_by(1.5, **reason), arm("ann"), DISARM, moved_by(10.0, **reason)]
    _, errors = asked(*acts, arm("ann"), sign("cid"), arm("ann"))
    assert errors[:7] == [None] * 7
    assert isinstance(errors[7], CountersignatureError)
    assert errors[8:] == [None, None]


def test_a_fraction_that_another_session_has_begun_is_not_begun_again():
    assert asked(arm("ann"), is_continued=True)[1] == [None]


@pytest.mark.parametrize(("reason", "is_set"), [("", False), (" ", False), ("the bladder is full", True)])
def test_a_window_for_this_patient_needs_a_written_reason(reason, is_set):
    bench, (error,) = asked(moved_by(0.5, reason=reason))
    assert isinstance(error, ReasonMissingError | None)
    assert (error is None) == is_set
    assert (bench.loop.status.view.window == WINDOW) == (not is_set)
    assert asked(moved_by(0.5), is_needed=False)[1] == [None]
