"""A window counts from the fraction's first armed one, by how far it reaches beyond it, with its reference."""

import math
from dataclasses import replace
from functools import partial

import pytest
from hypothesis import assume, given, strategies as st

from engine.control.fraction_checks import BUDGET_NO_REASON, BUDGET_NOT_ALLOWED, placed_window
from engine.core.breath import WHOLE, GateSignal, SignalChoice
from engine.core.commands import Arm, CorrectBaseline, Disarm, SetReference
from engine.core.errors import ReferenceDistanceError
from engine.core.fraction_arming import FractionArming, reach_beyond
from engine.core.reference import ReferenceDistance, SignalLevel
from engine.core.signals import LearnedRange
from engine.gating.active_window import SetWindow
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, JoinedWindow, PhaseWindow, Unit, amplitude_window
from tests.support.control.loop_bench import Bench, after, good
from tests.support.gating.streams import LEVEL_MM, LIMITS

ARM, DISARM = Arm(operator="ann", head_direction=LIMITS.head_direction), Disarm(operator="ann")
WINDOW = amplitude_window(lower_mm=LEVEL_MM - 1.0, upper_mm=LEVEL_MM + 3.0)
REASON = {"reason": "the bladder is full", "may_exceed": True}


def moved_by(mm, **who):
    return set_to(WINDOW.shifted(WHOLE, mm), **who)


def set_to(window, **who):
    times = {"dwell_ms": LIMITS.dwell_ms, "min_on_ms": 0.0, "min_off_ms": 0.0, "max_cycles_per_min": 120}
    return SetWindow(operator="bob", window=window, **times, **who)


def lying(level):
    return ReferenceDistance(
        moved_mm=abs(level),
        shift_mm=0.0,
        height_mm=level,
        turn_deg=0.0,
        tilt_deg=0.0,
        shape_mm=0.0,
        levels=(SignalLevel(WHOLE, level),),
    )


def asked(*acts, window=WINDOW, armed=None, ranges=None):
    """Carry commands out one after the other, or call them with the bench; return the bench and each answer's error."""
    arming = None if armed is None else FractionArming(first=placed_window(armed, None), armed_by="ann")
    limits = replace(LIMITS, window=window, max_duty_percent=100.0)
    bench = Bench([good] * 3, limits=limits, fraction_arming=arming)
    bench.pipeline.ranges = bench.pipeline.ranges if ranges is None else ranges
    for act in acts:
        step = partial(act, bench) if callable(act) else bench.ask(act)
        bench.source.script += [after(step), *[good] * 6]
    bench.run()
    return bench, [answer.exception(timeout=0) for answer in bench.answers]


def test_before_the_first_arming_a_window_is_set_freely():
    assert asked(moved_by(10.0), moved_by(-2.0), ARM)[1] == [None, None, None]


@pytest.mark.parametrize("who", [{}, {"may_exceed": True}, {"reason": "so"}, {"may_exceed": True, "reason": " "}])
def test_ten_millimetres_beyond_the_first_armed_window_need_a_person_s_reason(who):
    bench, errors = asked(ARM, DISARM, moved_by(10.0, **who))
    assert isinstance(errors[-1], ReferenceDistanceError)
    assert errors[-1].field == "window"
    assert "10.00 mm beyond the fraction's first" in errors[-1].value
    assert errors[-1].bound == "within 2 mm of it"
    assert errors[-1].advice == (BUDGET_NO_REASON if who.get("may_exceed") else BUDGET_NOT_ALLOWED)
    assert bench.loop.status.view.window == WINDOW


def test_with_a_person_s_reason_it_is_set_armed_and_counted_from_then_on():
    acts = [ARM, DISARM, moved_by(10.0, **REASON), ARM, DISARM, moved_by(11.5), moved_by(12.5), moved_by(0.0)]
    errors = asked(*acts)[1]
    assert errors[:6] == [None] * 6
    assert isinstance(errors[6], ReferenceDistanceError)
    assert isinstance(errors[7], ReferenceDistanceError)


def test_small_steps_add_up():
    errors = asked(ARM, DISARM, moved_by(1.5), ARM, DISARM, moved_by(3.0))[1]
    assert errors[:5] == [None] * 5
    assert isinstance(errors[5], ReferenceDistanceError)


def test_corrections_and_windows_add_up():
    """The review's way: correct, set, correct again; each of them 2 mm."""

    def correct(by):
        return CorrectBaseline(operator="bob", by=by)

    errors = asked(ARM, DISARM, correct(2.0), moved_by(2.0), correct(2.0))[1]
    assert errors[:4] == [None] * 4
    assert isinstance(errors[4], ReferenceDistanceError)
    assert errors[4].field == "by"


def test_a_window_and_a_reference_add_up_at_the_arming():
    def lie(bench):
        bench.pipeline.distance = lying(1.5)

    errors = asked(ARM, DISARM, moved_by(1.5), lie, ARM, replace(ARM, reason="the bladder is full"))[1]
    assert errors[:3] == [None] * 3
    assert isinstance(errors[3], ReferenceDistanceError)
    assert (errors[3].field, "3.00 mm beyond" in errors[3].value) == ("window", True)
    assert errors[4] is None


def test_a_program_s_reason_arms_no_window_beyond_the_budget():
    def lie(bench):
        bench.pipeline.distance = lying(1.9)

    bench, errors = asked(
        ARM, DISARM, moved_by(1.5), lie, replace(ARM, operator="key:tps", is_person=False, reason="because")
    )
    assert isinstance(errors[-1], ReferenceDistanceError)
    assert bench.loop.status.is_reason_needed


def test_a_reference_with_a_person_s_reason_needs_no_second_one_at_the_arming():
    def lie(bench):
        bench.pipeline.distance = lying(4.0)

    assert asked(ARM, DISARM, SetReference(operator="bob", **REASON), lie, ARM, DISARM, ARM)[1] == [None] * 6


def test_a_reason_counts_for_one_arming():
    def lie(level, bench):
        bench.pipeline.distance = lying(level)

    acts = [ARM, DISARM, SetReference(operator="bob", **REASON), partial(lie, 4.0), ARM, DISARM, partial(lie, 6.5), ARM]
    errors = asked(*acts)[1]
    assert errors[:5] == [None] * 5
    assert isinstance(errors[5], ReferenceDistanceError)


def test_per_cent_are_compared_at_the_arming_as_they_are_converted():
    percent = AmplitudeWindow(lower=0.0, upper=30.0, unit=Unit.PERCENT)
    near = {WHOLE: LearnedRange(low=LEVEL_MM - 1.0, high=LEVEL_MM + 9.0)}

    def breathe_deeper(bench):
        bench.pipeline.ranges = {WHOLE: LearnedRange(low=LEVEL_MM - 1.0, high=LEVEL_MM + 19.0)}
        bench.pipeline.zero_number = 2

    errors = asked(ARM, DISARM, breathe_deeper, ARM, window=percent, ranges=near)[1]
    assert errors[:2] == [None, None]
    assert isinstance(errors[2], ReferenceDistanceError)


def test_in_a_further_session_the_window_that_the_fraction_was_armed_with_counts():
    """Not the window that the session was created with."""
    other = WINDOW.shifted(WHOLE, 3.0)
    assert isinstance(asked(ARM, window=other, armed=WINDOW)[1][0], ReferenceDistanceError)
    assert isinstance(asked(moved_by(3.0), armed=WINDOW)[1][0], ReferenceDistanceError)
    assert asked(moved_by(1.5), ARM, armed=WINDOW)[1] == [None, None]
    assert asked(moved_by(3.0), ARM, armed=None)[1] == [None, None]
    of_thorax = AmplitudeWindow(choice=SignalChoice(signal=GateSignal.THORAX), lower=-1.0, upper=3.0)
    assert isinstance(asked(ARM, armed=of_thorax)[1][0], ReferenceDistanceError)


WINDOWS = st.tuples(st.floats(min_value=-20.0, max_value=20.0), st.floats(min_value=0.1, max_value=20.0)).map(
    lambda edges: amplitude_window(lower_mm=edges[0], upper_mm=edges[0] + edges[1])
)


@given(WINDOWS, WINDOWS, st.floats(min_value=-5.0, max_value=5.0))
def test_a_window_reaches_as_far_beyond_another_as_its_farthest_point(first, now, level):
    points = [max(first.lower - at, at - first.upper, 0.0) for at in (now.lower + level, now.upper + level)]
    reach_mm = reach_beyond(placed_window(first, None), placed_window(now, lying(level)))
    assert reach_mm == pytest.approx(max(points), abs=1e-9)


@given(*[st.integers(min_value=0, max_value=99)] * 4)
def test_a_phase_reaches_beyond_another_if_any_of_its_phases_is_not_in_it(start, end, later, sooner):
    assume(start != end and later != sooner)
    first = PhaseWindow(from_percent=float(start), to_percent=float(end))
    now = PhaseWindow(from_percent=float(later), to_percent=float(sooner))
    steps = [(later + step) % 100 for step in range((sooner - later) % 100 + 1)]
    is_inside = all(first.contains(float(at)) for at in steps) and _is_in_one_piece(first, steps)
    reach_mm = reach_beyond(placed_window(first, None), placed_window(now, None))
    assert reach_mm == (0.0 if is_inside else math.inf)


def _is_in_one_piece(first, steps):
    """Whether the way between neighbouring steps is inside too."""
    return all(first.contains((at + 0.5) % 100.0) for at in steps[:-1])


def test_litres_and_the_edges_of_a_breath_hold_count_too():
    volume = SignalChoice(signal=GateSignal.VOLUME)
    before = JoinedWindow(
        conditions=(
            AmplitudeWindow(choice=volume, lower=-0.1, upper=0.2, unit=Unit.L),
            BreathHoldWindow(level=amplitude_window(lower_mm=8.0, upper_mm=12.0)),
        )
    )
    wider, deeper, higher = (
        replace(before, conditions=conditions)
        for conditions in (
            (replace(before.conditions[0], upper=0.5), before.conditions[1]),
            (replace(before.conditions[0], lower=-0.5), before.conditions[1]),
            (before.conditions[0], BreathHoldWindow(level=amplitude_window(lower_mm=10.0, upper_mm=14.0))),
        )
    )
    first = placed_window(before, None)
    assert reach_beyond(first, placed_window(wider, None)) == pytest.approx(3.0)
    assert reach_beyond(first, placed_window(deeper, None)) == pytest.approx(4.0)
    assert reach_beyond(first, placed_window(higher, None)) == pytest.approx(2.0)
    assert placed_window(replace(WINDOW, unit=Unit.PERCENT, lower=0.0, upper=40.0), None) is None
