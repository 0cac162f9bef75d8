"""Before a fraction's first arming, a second person countersigns exactly what would be armed."""

from dataclasses import replace
from functools import partial

import pytest

from engine.control.arming import CountersignatureState
from engine.core.breath import WHOLE
from engine.core.commands import ActivateModel, Arm, CorrectBaseline, Countersign, Disarm, SetReference
from engine.core.errors import CountersignatureError, ReasonMissingError
from engine.core.fraction_arming import read_fraction_arming
from engine.core.reference import ReferenceDistance, SignalLevel
from engine.gating.active_window import SetWindow
from engine.gating.windows import BreathHoldWindow, amplitude_window
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


def narrowed(**who):
    return replace(moved_by(0.0, **who), window=replace(WINDOW, lower=WINDOW.lower + 0.5))


def lying(mm):
    return ReferenceDistance(moved_mm=mm, levels=(SignalLevel(WHOLE, mm),))


UNKNOWN = ReferenceDistance(unknown="the camera was disconnected since")


def setattr_of(name, value, bench):
    setattr(bench.pipeline, name, value)


def asked(*acts, is_needed=True, arming=None, has_reference=True, window=WINDOW):
    """Carry the acts out one after the other; return the bench and the error of each answer."""
    limits = replace(LIMITS, window=window, max_duty_percent=100.0, needs_countersignature=is_needed)
    bench = Bench([good] * 3, limits=limits, fraction_arming=arming)
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


def test_later_armings_need_none_unless_a_window_is_set_beyond_the_one_that_was_signed():
    reason = {"reason": "the bladder is full", "may_exceed": True}
    acts = [sign("bob"), arm("ann"), DISARM, arm("ann"), DISARM, moved_by(0.1, **reason), arm("ann")]
    _, errors = asked(*acts, sign("cid"), arm("ann"), DISARM, narrowed(**reason), arm("ann"))
    assert errors[:6] == [None] * 6
    assert isinstance(errors[6], CountersignatureError)
    assert errors[7:] == [None] * 5


def test_a_reference_within_the_budget_needs_none_and_one_beyond_or_unknown_does():
    reason = SetReference(operator="ann", reason="as the test wants it", may_exceed=True)
    for distance, is_armed in ((lying(1.9), True), (lying(2.1), False), (UNKNOWN, False)):
        lie = partial(setattr_of, "distance", distance)
        _, errors = asked(sign("bob"), arm("ann"), reason, lie, arm("ann"))
        assert errors[:3] == [None] * 3
        assert isinstance(errors[3], CountersignatureError | None)
        assert (errors[3] is None) is is_armed


def test_a_further_session_starts_from_what_was_signed():
    """A confirmed reference is no signature; nor is an arming of before the site asked for one."""
    first, _ = asked(sign("bob"), arm("ann"))
    signed = first.loop.status.fraction_arming
    assert (signed.signed_by, signed.signed_for, signed.armed_by) == ("bob", "ann", "ann")
    assert read_fraction_arming(signed.to_json()) == signed
    program = replace(arm("key:tps"), is_person=False)
    for again in (arm("ann"), program):
        assert asked(again, arming=signed)[1] == [None]
        wider = WINDOW.shifted(WHOLE, 0.1)
        assert isinstance(asked(again, arming=signed, window=wider)[1][0], CountersignatureError)
        for unsigned in (None, asked(arm("ann"), is_needed=False)[0].loop.status.fraction_arming):
            assert isinstance(asked(again, arming=unsigned)[1][0], CountersignatureError)


def test_what_was_signed_with_other_conditions_is_no_signature():
    signed = asked(sign("bob"), arm("ann"))[0].loop.status.fraction_arming
    hold = BreathHoldWindow(level=WINDOW, kind="expiration")
    (error,) = asked(replace(arm("ann"), reason="the bladder is full"), arming=signed, window=hold)[1]
    assert isinstance(error, CountersignatureError)


@pytest.mark.parametrize(("reason", "is_set"), [("", False), (" ", False), ("the bladder is full", True)])
def test_a_window_for_this_patient_needs_a_written_reason(reason, is_set):
    bench, (error,) = asked(moved_by(0.5, reason=reason))
    assert isinstance(error, ReasonMissingError | None)
    assert (error is None) == is_set
    assert (bench.loop.status.view.window == WINDOW) == (not is_set)
    assert asked(moved_by(0.5), is_needed=False)[1] == [None]
