"""What a person does to a running gate by hand: hold, release, be there, correct the baseline."""

import itertools
from dataclasses import replace

import pytest

from engine.core.breath import SignalChoice
from engine.core.commands import Arm, CorrectBaseline, Disarm, HoldBeam, ReleaseBeam, SetReference
from engine.core.errors import CommandRefusedError, InvalidValueError
from engine.core.gate_state import GateState, HoldReason
from engine.core.signals import LearnedRange
from engine.gating.limits import GateLimits
from engine.gating.windows import AmplitudeWindow, PhaseWindow
from service.core.settings.settings import Settings
from tests.support.control.armed_bench import LEARNED, armed_bench
from tests.support.control.loop_bench import Bench, after, good
from tests.support.gating.streams import FRAMES_A_DWELL, LIMITS, MS

HOLD, RELEASE = HoldBeam(operator="bob"), ReleaseBeam(operator="cy")
ON = LEARNED + 6
"""The newest frame when six were good after the arming: the beam is on."""


def _on_bench(more: list, **options: object) -> Bench:
    bench = armed_bench([good] * 6, **options)
    bench.source.script += more
    return bench


def test_a_hold_by_hand_lasts_through_good_frames_until_somebody_releases_it():
    bench = _on_bench([])
    bench.source.script += [after(bench.ask(HOLD)), *[good] * 20, after(bench.ask(RELEASE)), *[good] * 6]
    records = bench.run().records()
    assert records[ON].line_on
    held = records[ON + 1 : ON + 22]
    assert {(record.gate_state, record.hold_reason, record.line_on) for record in held[1:]} == {
        (GateState.HOLD, HoldReason.OPERATOR_HOLD, False)
    }
    after_release = [record.line_on for record in records[ON + 22 :]]
    assert after_release == [False] * FRAMES_A_DWELL + [True] * (7 - FRAMES_A_DWELL)


def test_a_hold_by_hand_stops_even_the_frame_that_is_being_measured_when_it_comes():
    bench = _on_bench([good, *[good] * 3])

    def held_meanwhile(frame):
        bench.ask(HOLD)()
        return frame

    bench.pipeline.spoil[ON + 1] = held_meanwhile
    records = bench.run().records()
    assert [record.line_on for record in records[ON:]] == [True, False, False, False, False]
    held = next(change for change in bench.transitions() if change.reason is HoldReason.OPERATOR_HOLD)
    assert (held.operator, held.detail) == ("bob", "held by bob")


def test_the_person_who_holds_and_the_one_who_releases_are_named():
    bench = _on_bench([])
    seen = []
    bench.source.script += [
        after(bench.ask(HOLD)),
        after(lambda: seen.append(bench.loop.status.view)),
        after(bench.ask(RELEASE)),
        good,
        after(lambda: seen.append(bench.loop.status.view)),
    ]
    bench.run()
    held, released = (change for change in bench.transitions()[3:5])
    assert (held.reason, held.operator, held.detail) == (HoldReason.OPERATOR_HOLD, "bob", "held by bob")
    assert (released.reason, released.operator, released.detail) == (HoldReason.DWELL, "cy", "released by cy")
    assert [view.operator_hold for view in seen] == ["bob", None]


def test_the_gate_names_who_armed_it_with_every_transition_and_in_every_view():
    bench = _on_bench([])
    seen = []

    def look():
        seen.append(bench.loop.status.view.armed_by)

    bench.source.script += [after(look), after(bench.ask(HOLD)), after(bench.ask(RELEASE)), good, after(look)]
    bench.source.script += [after(bench.ask(Disarm(operator="bob"))), good, after(look)]
    bench.run()
    assert seen == ["ann", "cy", None]
    changes = bench.transitions()
    held = next(one for one in changes if one.reason is HoldReason.OPERATOR_HOLD)
    released = next(one for one in changes if one.detail == "released by cy")
    disarmed = next(one for one in changes if one.to_state is GateState.DISARMED)
    assert [one.armed_by for one in (changes[0], held, released)] == ["ann", "ann", "cy"]
    assert (disarmed.operator, disarmed.armed_by) == ("bob", "cy"), "who had armed what was disarmed"
    assert all(one.armed_by for one in changes[: changes.index(disarmed)])


def test_a_hold_by_hand_is_never_refused_and_a_release_asked_for_before_it_is_taken_back():
    bench = _on_bench([], command_capacity=1)

    def hold_release_and_hold():
        bench.ask(HOLD)()
        bench.ask(RELEASE)()
        for _ in range(50):
            bench.ask(HoldBeam(operator="dee"))()

    bench.source.script += [after(hold_release_and_hold), *[good] * 8]
    records = bench.run().records()
    assert "held before" in str(bench.answers[2].exception(timeout=0))
    assert all(answer.exception(timeout=0) is None for answer in bench.answers[3:])
    assert {record.hold_reason for record in records[-8:]} == {HoldReason.OPERATOR_HOLD}


def test_a_hold_by_hand_its_asker_gave_up_is_carried_out_all_the_same():
    bench = _on_bench([])
    bench.source.script += [after(lambda: bench.loop.submit(HOLD).cancel()), *[good] * 3]
    assert bench.run().records()[-1].hold_reason is HoldReason.OPERATOR_HOLD


def test_a_hold_before_arming_still_holds_after_it():
    bench = Bench([good] * 3)
    bench.source.script += [after(bench.ask(HOLD)), after(bench.ask(Arm(operator="ann"))), *[good] * 8]
    last = bench.run().records()[-1]
    assert (last.gate_state, last.hold_reason) == (GateState.HOLD, HoldReason.OPERATOR_HOLD)


@pytest.mark.parametrize(("first", "second", "is_on"), [(HOLD, "disarm", True), ("disarm", HOLD, False)], ids=str)
def test_a_disarming_clears_ones_own_hold_by_hand_and_a_hold_after_it_stands(first, second, is_on):
    bench = _on_bench([])
    commands = [Disarm(operator=HOLD.operator) if one == "disarm" else one for one in (first, second)]

    def ask():
        for command in (HOLD, *commands):  # one hold waits already: the newer one's place counts
            bench.ask(command)()
        bench.ask(Arm(operator="ann"))()

    bench.source.script += [after(ask), *[good] * 8]
    assert bench.run().records()[-1].line_on is is_on


@pytest.mark.parametrize("others", [[HOLD], [HoldBeam(operator="ann"), HOLD], [HOLD, HoldBeam(operator="ann")]])
def test_a_disarming_leaves_another_person_s_hold_which_a_release_ends(others):
    bench = _on_bench([])

    def disarm_and_arm():
        for command in (*others, Disarm(operator="ann"), Arm(operator="ann")):
            bench.ask(command)()

    bench.source.script += [after(disarm_and_arm), *[good] * 8, after(bench.ask(RELEASE)), *[good] * 8]
    records = bench.run().records()
    held = [record for record in records if record.hold_reason is HoldReason.OPERATOR_HOLD]
    assert len(held) >= 8
    assert {record.line_on for record in held} == {False}
    assert records[-1].line_on


NURSE, OTHER, PROGRAM, SECOND = "nurse", "other", "key:tps", "key:robot"
PROGRAMS = {PROGRAM, SECOND}
HOLDERS = [list(holders) for count in (1, 2, 3) for holders in itertools.combinations([NURSE, OTHER, PROGRAM], count)]


def left_holding(holders, releaser):
    """Who still holds after a release: the rule of ADR 0046, written as a person would say it."""
    if releaser in holders:
        return [one for one in holders if one != releaser]
    return holders if releaser in PROGRAMS else []


@pytest.mark.parametrize("releaser", [NURSE, OTHER, PROGRAM, SECOND])
@pytest.mark.parametrize("holders", HOLDERS, ids="+".join)
def test_a_release_ends_ones_own_hold_and_a_person_s_hold_is_ended_by_a_person(holders, releaser):
    bench = _on_bench([])
    holds = [HoldBeam(operator=one, is_person=one not in PROGRAMS) for one in holders]
    release = ReleaseBeam(operator=releaser, is_person=releaser not in PROGRAMS)
    bench.source.script += [*[after(bench.ask(one)) for one in holds], *[good] * 3]
    bench.source.script += [after(bench.ask(release)), *[good] * 8]
    seen = []
    bench.source.script += [after(lambda: seen.append(bench.loop.status.view))]
    records = bench.run().records()
    expected = left_holding(holders, releaser)
    assert list(seen[0].operator_holds) == expected
    assert records[-1].line_on is not bool(expected)
    if releaser in PROGRAMS and releaser not in holders:
        assert f"held by {', '.join(holders)}" in str(bench.answers[-1].exception(timeout=0))


@pytest.mark.parametrize("way", ["disarm", "hold", "stop"])
def test_a_frame_that_was_on_its_way_when_somebody_wanted_off_turns_nothing_on(way):
    bench = _on_bench([])
    acts = {
        "disarm": bench.ask(Disarm(operator="bob")),
        "hold": bench.ask(HOLD),
        "stop": bench.loop._stop_requested.set,  # what stop() does first, without waiting here for itself
    }
    bench.source.script += [after(acts[way])]
    records = bench.run().records()
    assert records[-2].line_on
    assert not records[-1].line_on
    assert bench.beam.permits[-1].granted_ns < records[-1].received_ns


def test_releasing_without_a_hold_is_refused():
    bench = _on_bench([])
    bench.source.script += [after(bench.ask(RELEASE)), good]
    records = bench.run().records()
    assert isinstance(bench.answers[-1].exception(timeout=0), CommandRefusedError)
    assert records[-1].line_on


WATCHING = replace(LIMITS, operator_timeout_s=0.5)


def test_the_beam_is_held_when_the_page_of_the_person_who_armed_falls_silent_and_comes_back_with_them():
    bench = _on_bench([good] * 20, limits=WATCHING)
    bench.source.script += [after(lambda: bench.loop.note_presence("ann")), *[good] * 6]
    records = bench.run().records()
    armed_ns = bench.transitions()[0].at_ns
    for record in records[ON:-7]:
        is_silent = record.decided_ns - armed_ns > 500 * MS
        assert record.line_on is not is_silent
        assert (record.hold_reason is HoldReason.OPERATOR_LOST) is is_silent
    assert [record.line_on for record in records[-7:]] == [False] * (FRAMES_A_DWELL - 1) + [True] * 4


@pytest.mark.parametrize(("who", "is_on"), [("ann", True), ("bob", False)])
def test_only_the_presence_of_the_person_who_armed_counts(who, is_on):
    bench = _on_bench([], limits=WATCHING)
    for _ in range(10):
        bench.source.script += [after(lambda: bench.loop.note_presence(who)), good, good]
    assert bench.run().records()[-1].line_on is is_on


def test_presence_is_required_by_default():
    assert GateLimits(window=LIMITS.window).operator_timeout_s == 10.0
    assert Settings().operator_timeout_s == 10.0


KEY = "key:planning"


def _armed_by_a_program(more: list) -> Bench:
    bench = Bench([good] * LEARNED, limits=WATCHING)
    bench.source.script += [good, after(lambda: bench.loop.note_presence("bob"))]
    bench.source.script += [after(bench.ask(Arm(operator=KEY, is_person=False))), *[good] * 6, *more]
    return bench


def test_a_program_may_arm_only_while_a_person_is_present():
    bench = Bench([good] * LEARNED, limits=WATCHING)
    arm = bench.ask(Arm(operator=KEY, is_person=False))
    bench.source.script += [after(arm), good, after(lambda: bench.loop.note_presence("bob"))]
    bench.source.script += [*[good] * 20, after(arm), good, after(lambda: bench.loop.note_presence("bob"))]
    bench.source.script += [after(arm), *[good] * 6]
    records = bench.run().records()
    refused, late, done = (answer.exception(timeout=0) for answer in bench.answers[-3:])
    assert "no person who may arm is at the page" in str(refused)
    assert (type(late), done) == (CommandRefusedError, None)
    assert records[-1].line_on
    assert {change.armed_by for change in bench.transitions() if change.armed_by} == {KEY}


def test_any_person_s_presence_keeps_the_beam_of_a_program_s_gate_on_and_no_one_s_holds_it():
    bench = _armed_by_a_program([])
    for person in ("bob", "cy", "bob", "cy"):
        bench.source.script += [*[good] * 5, after(lambda name=person: bench.loop.note_presence(name))]
    bench.source.script += [good] * 20
    records = bench.run().records()
    assert all(record.line_on for record in records[-40:-20])
    assert (records[-1].line_on, records[-1].hold_reason) == (False, HoldReason.OPERATOR_LOST)
    lost = next(change for change in bench.transitions() if change.reason is HoldReason.OPERATOR_LOST)
    assert lost.detail == "no person who may arm is at the page"


def test_a_program_s_arming_is_no_sign_of_presence():
    bench = Bench([good] * LEARNED, limits=WATCHING)
    bench.source.script += [after(lambda: bench.loop.note_presence("bob")), *[good] * 11]
    bench.source.script += [after(bench.ask(Arm(operator=KEY, is_person=False))), *[good] * 6]
    records = bench.run().records()
    assert bench.answers[-1].exception(timeout=0) is None
    assert records[-1].hold_reason is HoldReason.OPERATOR_LOST


def test_a_person_s_release_counts_as_a_message():
    bench = _on_bench([], limits=WATCHING)
    bench.source.script += [after(bench.ask(HOLD)), after(bench.ask(RELEASE)), *[good] * 6]
    assert bench.run().records()[-1].line_on


@pytest.mark.parametrize(("who", "is_on"), [("ann", False), ("cy", True)])
def test_anyone_who_releases_has_to_be_present_from_then_on(who, is_on):
    bench = _on_bench([], limits=WATCHING)
    bench.source.script += [after(bench.ask(HOLD)), after(bench.ask(RELEASE))]
    for _ in range(12):
        bench.source.script += [after(lambda: bench.loop.note_presence(who)), good, good]
    assert bench.run().records()[-1].line_on is is_on


def _correct(by: float) -> CorrectBaseline:
    return CorrectBaseline(operator="bob", by=by, reason="the patient has relaxed", may_exceed=True)


def test_a_corrected_baseline_disarms_moves_the_window_and_the_audit_names_both():
    bench = _on_bench([])
    bench.source.script += [after(bench.ask(_correct(1.5))), good]
    bench.run()
    change = next(one for one in bench.transitions() if "baseline" in one.detail)
    assert (change.to_state, change.operator) == (GateState.DISARMED, "bob")
    assert change.detail == (
        "the baseline is corrected by 1.5: the window was whole -1 to 3 mm and is whole 0.5 to 4.5 mm"
    )
    window = bench.loop.status.view.window
    assert (window.lower, window.upper, window.hysteresis) == (0.5, 4.5, 0.2)
    assert bench.pipeline.calls == ["correct whole 1.5"]  # drift is reported against the same level


def test_a_correction_is_audited_even_while_disarmed():
    bench = Bench([good] * 3)
    bench.source.script += [after(bench.ask(_correct(1.5))), good]
    bench.run()
    assert "is whole 0.5 to 4.5 mm" in bench.transitions()[0].detail


@pytest.mark.parametrize(("by", "is_on"), [(1.0, True), (-0.5, True), (3.5, False), (-1.5, False)])
def test_the_gate_decides_by_the_corrected_window(by, is_on):
    bench = Bench([good] * 3)  # the signal stays at 2 mm, the window is -1 to 3
    bench.source.script += [after(bench.ask(_correct(by))), after(bench.ask(Arm(operator="ann"))), *[good] * 8]
    assert bench.run().records()[-1].line_on is is_on


def test_corrections_add_up_and_their_sum_is_bounded():
    bench = Bench([good] * 3)
    for by in (4.0, 2.0, 1.0, -3.0):
        bench.source.script += [after(bench.ask(_correct(by)))]
    bench.run()
    assert bench.loop.status.view.window.lower == 1.0  # -1 and 4 and 1 and -3; 2 was refused
    error = bench.answers[1].exception(timeout=0)
    assert error.bound == "a number from -9 to 1 mm, 4 mm of 5 already used"
    assert bench.pipeline.calls == ["correct whole 4", "correct whole 5", "correct whole 2"]


def test_setting_the_reference_returns_to_the_window_as_requested():
    bench = Bench([good] * 3)
    bench.source.script += [after(bench.ask(_correct(4.0))), after(bench.ask(SetReference(operator="bob"))), good]
    bench.run()
    assert bench.loop.status.view.window == LIMITS.window
    assert bench.pipeline.calls[-1] == "correct whole 0"


@pytest.mark.parametrize("by", [float("nan"), float("inf"), 5.01, -5.01, True, "1"])
def test_a_correction_that_is_no_number_or_too_far_is_refused_by_bound_and_does_not_disturb_the_beam(by):
    bench = _on_bench([])
    bench.source.script += [after(bench.ask(_correct(by))), *[good] * 3]
    records = bench.run().records()
    error = bench.answers[-1].exception(timeout=0)
    assert isinstance(error, InvalidValueError)
    assert (error.field, error.bound) == ("by", "a number from -5 to 5 mm")
    assert records[-1].line_on


def test_a_correction_beyond_the_site_s_window_is_refused():
    bench = _on_bench([], limits=replace(LIMITS, window_upper_mm=4.0))
    bench.source.script += [after(bench.ask(_correct(1.5))), *[good] * 3]
    records = bench.run().records()
    error = bench.answers[-1].exception(timeout=0)
    assert isinstance(error, InvalidValueError)
    assert (error.field, error.value) == ("window.upper_mm", "4.5")
    assert records[-1].line_on


@pytest.mark.parametrize(("site", "field"), [({"window_lower_mm": -0.9}, "lower"), ({"window_upper_mm": 2.9}, "upper")])
def test_arming_with_a_window_beyond_the_site_s_is_refused(site, field):
    bench = armed_bench([good] * 8, limits=replace(LIMITS, **site)).run()
    error = bench.answers[0].exception(timeout=0)
    assert isinstance(error, InvalidValueError)
    assert error.field == f"window.{field}_mm"
    assert not bench.beam.permits


def test_a_window_without_edges_on_its_first_signal_cannot_be_corrected():
    bench = Bench([good] * 3, limits=replace(LIMITS, window=PhaseWindow(from_percent=30.0, to_percent=70.0)))
    bench.source.script += [after(bench.ask(_correct(1.0))), good]
    bench.run()
    assert "no edges" in str(bench.answers[-1].exception(timeout=0))


def _per_cent_bench() -> Bench:
    window = AmplitudeWindow(lower=0.0, upper=50.0, unit="percent")
    bench = Bench([good] * 3, limits=replace(LIMITS, window=window))
    bench.pipeline.ranges = {SignalChoice(): LearnedRange(low=0.0, high=8.0)}
    return bench


def test_a_window_in_per_cent_is_shown_settled_and_corrected_in_mm():
    bench = _per_cent_bench()
    bench.source.script += [after(bench.ask(_correct(1.0))), good]
    bench.run()
    window = bench.loop.status.view.window
    assert (window.lower, window.upper, str(window.unit)) == (1.0, 5.0, "mm")


@pytest.mark.parametrize(("has_new_zero", "edges"), [(False, (1.0, 5.0)), (True, (3.0, 7.0))])
def test_per_cent_are_of_the_range_at_the_reference_and_another_model_moves_nothing(has_new_zero, edges):
    bench = _per_cent_bench()

    def learn_again():
        bench.pipeline.model_generation += 1
        bench.pipeline.zero_number += has_new_zero
        bench.pipeline.ranges = {SignalChoice(): LearnedRange(low=3.0, high=11.0)}

    bench.source.script += [after(bench.ask(_correct(1.0))), after(learn_again), good]
    bench.run()
    assert (bench.loop.status.view.window.lower, bench.loop.status.view.window.upper) == edges


def test_a_window_still_in_per_cent_cannot_be_corrected():
    bench = _per_cent_bench()
    bench.pipeline.ranges = {}
    bench.source.script += [after(bench.ask(_correct(1.0))), good]
    bench.run()
    assert "range is not known" in str(bench.answers[-1].exception(timeout=0))


def test_a_volume_is_corrected_in_litres_within_as_much_as_the_region_would_hold():
    window = AmplitudeWindow(choice=SignalChoice(signal="volume"), lower=-0.1, upper=0.3, unit="l")
    bench = Bench([good] * 3, limits=replace(LIMITS, window=window))
    bench.source.script += [after(bench.ask(_correct(0.51))), after(bench.ask(_correct(0.2))), good]
    bench.run()
    assert bench.answers[0].exception(timeout=0).bound == "a number from -0.5 to 0.5 l"
    assert (round(bench.loop.status.view.window.lower, 9), round(bench.loop.status.view.window.upper, 9)) == (0.1, 0.5)


@pytest.mark.parametrize("before", ["fault", "held by hand", "watchdog"])
def test_the_audit_names_both_windows_whatever_else_stands_against_the_beam(before):
    bench = _on_bench([])

    def fire():
        bench.clock.advance_ns(300 * MS)
        assert bench.watchdog.check(bench.clock.now_ns())

    troubles = {
        "fault": lambda: bench.loop.report_fault(HoldReason.DISK_LOW, "20 MB left"),
        "held by hand": bench.ask(HOLD),
        "watchdog": fire,
    }
    bench.source.script += [after(troubles[before]), good, after(bench.ask(_correct(1.5))), good]
    bench.run()
    change = next(one for one in bench.transitions() if "baseline" in one.detail)
    assert "was whole -1 to 3 mm and is whole 0.5 to 4.5 mm" in change.detail
    assert change.operator == "bob"
    assert bench.loop.gate.reason is not None
