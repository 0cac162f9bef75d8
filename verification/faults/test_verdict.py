"""The judge, tried with planted evidence: each thing that must not happen is found, and nothing else."""

from collections import deque
from contextlib import nullcontext
from dataclasses import replace

import pytest

from engine.core.clock import NS_PER_MS
from tests.support.scheduling_monitor import Watchman
from verification.faults.kinds import MissedError
from verification.faults.trial import Judged, _is_disturbed, _refuse_another_s
from verification.faults.verdict import (
    Evidence,
    Expectation,
    LineEdge,
    Outcome,
    Recovery,
    Reported,
    Trouble,
    came_back,
    is_on_at,
    judge,
    off_after_ms,
    reported_as,
)

pytestmark = pytest.mark.waiting

CAUSE_NS = 10_000 * NS_PER_MS
EXPECTED = Expectation(
    bound_ms=100.0,
    reported=frozenset({"marker_lost"}),
    recoveries=frozenset({Recovery.BY_ITSELF, Recovery.ACKNOWLEDGED}),
)


def at(ms: float) -> int:
    return CAUSE_NS + int(ms * NS_PER_MS)


def edge(is_on: bool, ms: float) -> LineEdge:
    return LineEdge(is_on=is_on, at_ns=at(ms))


GOOD = Evidence(
    cause_ns=CAUSE_NS,
    edges=(edge(False, 40.0), edge(True, 700.0)),
    reported=(Reported(what="marker_lost", at_ns=at(38.0)), Reported(what="dwell", at_ns=at(600.0))),
    recovery=Recovery.BY_ITSELF,
    clear_ns=at(500.0),
)
TIMEOUT = Reported(what="frame_timeout", at_ns=at(500.0))
LATCHED = replace(GOOD, recovery=Recovery.ACKNOWLEDGED, armed_ns=at(650.0))


def test_a_fault_that_did_as_promised_is_no_trouble():
    assert judge(EXPECTED, GOOD) == []
    assert judge(EXPECTED, LATCHED) == []
    assert off_after_ms(GOOD) == pytest.approx(40.0)
    assert reported_as(EXPECTED, GOOD) == ("marker_lost",)


@pytest.mark.parametrize(
    ("evidence", "trouble"),
    [
        (replace(GOOD, edges=(edge(False, 100.1), edge(True, 700.0))), Trouble.OFF_LATE),
        (replace(GOOD, edges=()), Trouble.NEVER_OFF),
        (replace(GOOD, edges=(edge(False, -1.0), edge(True, -0.5))), Trouble.NEVER_OFF),
        (replace(GOOD, edges=(edge(False, 40.0), edge(True, 599.9))), Trouble.BACK_EARLY),
        (replace(GOOD, edges=(edge(False, 40.0), edge(True, 60.0), edge(False, 90.0))), Trouble.BACK_EARLY),
        (replace(GOOD, clear_ns=None, edges=(edge(False, 40.0), edge(True, 99.9))), Trouble.BACK_EARLY),
        (
            replace(LATCHED, reported=(*GOOD.reported, TIMEOUT), edges=(edge(False, 40.0), edge(True, 649.0))),
            Trouble.ON_UNASKED,
        ),
        (replace(GOOD, reported=(*GOOD.reported, TIMEOUT)), Trouble.ON_UNASKED),
        (replace(LATCHED, armed_ns=at(300.0), edges=(edge(False, 40.0), edge(True, 450.0))), Trouble.BACK_EARLY),
        (replace(GOOD, reported=()), Trouble.UNREPORTED),
        (replace(GOOD, reported=(Reported(what="jump", at_ns=at(38.0)),)), Trouble.UNREPORTED),
        (replace(GOOD, reported=(Reported(what="marker_lost", at_ns=at(701.0)),)), Trouble.UNREPORTED),
        (
            replace(LATCHED, acted_ns=at(510.0), reported=(Reported(what="marker_lost", at_ns=at(511.0)),)),
            Trouble.UNREPORTED,
        ),
        (replace(GOOD, reported_by_ns=at(37.0)), Trouble.REPORTED_LATE),
        (replace(GOOD, is_chain_intact=False), Trouble.CHAIN_BROKEN),
        (replace(GOOD, recovery=None, edges=GOOD.edges[:1]), Trouble.NOT_RECOVERED),
        (replace(LATCHED, recovery=Recovery.NEW_SESSION), Trouble.OTHER_RECOVERY),
    ],
    ids=lambda one: one.name if isinstance(one, Trouble) else "",
)
def test_each_broken_promise_is_found_and_it_alone(evidence, trouble):
    assert judge(EXPECTED, evidence) == [trouble]


def test_a_bound_is_kept_by_what_comes_at_it():
    assert judge(EXPECTED, replace(GOOD, edges=(edge(False, 100.0), edge(True, 700.0)))) == []
    assert judge(EXPECTED, replace(GOOD, edges=(edge(False, 40.0), edge(True, 600.0)))) == []
    assert judge(EXPECTED, replace(LATCHED, edges=(edge(False, 40.0), edge(True, 650.0)))) == []
    assert judge(EXPECTED, replace(GOOD, reported_by_ns=at(38.0))) == []


def test_several_troubles_are_all_reported():
    worst = replace(GOOD, edges=(edge(False, 200.0), edge(True, 300.0)), reported=(), is_chain_intact=False)
    found = [Trouble.OFF_LATE, Trouble.BACK_EARLY, Trouble.UNREPORTED, Trouble.CHAIN_BROKEN]
    assert judge(EXPECTED, worst) == found


def test_a_fault_that_must_latch_is_unsafe_where_it_clears_by_itself():
    strict = replace(EXPECTED, recoveries=frozenset({Recovery.ACKNOWLEDGED}))
    assert judge(strict, LATCHED) == []
    assert judge(strict, GOOD) == [Trouble.ON_UNASKED, Trouble.OTHER_RECOVERY]


def test_a_hold_that_cleared_by_itself_is_judged_by_that_whatever_a_busy_machine_does_next():
    later = (edge(False, 40.0), edge(True, 620.0), edge(False, 640.0), edge(True, 900.0))
    evidence = replace(
        LATCHED, edges=later, armed_ns=at(850.0), reported=(*GOOD.reported, replace(TIMEOUT, at_ns=at(640.0)))
    )
    assert came_back(evidence) is Recovery.BY_ITSELF
    assert judge(EXPECTED, evidence) == []


def test_who_acknowledges_a_fault_of_the_machine_s_own_recovers_otherwise_and_well():
    armed = replace(EXPECTED, recoveries=frozenset({Recovery.ARMED}))
    assert judge(armed, LATCHED) == [Trouble.OTHER_RECOVERY]
    assert judge(armed, replace(LATCHED, reported=(*GOOD.reported, TIMEOUT))) == []


def late(off_ms: float, stall_ms: float, **more: object) -> Judged:
    evidence = replace(GOOD, edges=(edge(False, off_ms), edge(True, off_ms + 700.0)), stall_ms=stall_ms, **more)
    return Judged(expected=EXPECTED, evidence=evidence, troubles=judge(EXPECTED, evidence))


def test_a_machine_that_stood_still_excuses_as_much_lateness_as_it_stood_and_nothing_else():
    assert _is_disturbed(late(130.0, 30.0))
    assert not _is_disturbed(late(130.1, 30.0))
    assert not _is_disturbed(late(110.0, 19.9))
    assert not _is_disturbed(late(90.0, 50.0)), "nothing is wrong"
    assert not _is_disturbed(late(130.0, 50.0, reported=()))
    assert not _is_disturbed(late(130.0, 50.0, is_chain_intact=False))
    assert not _is_disturbed(late(2900.0, 20.0))


def test_off_in_time_for_another_cause_is_no_result_and_off_too_late_for_one_is_red():
    other = (Reported(what="frame_late", at_ns=at(40.0)),)
    with pytest.raises(MissedError, match="frame_late"):
        _refuse_another_s(late(40.0, 0.0, reported=other), [at(40.0)])
    far = (Reported(what="frame_late", at_ns=at(2900.0)),)
    _refuse_another_s(late(2900.0, 0.0, reported=far), [at(2900.0)])
    _refuse_another_s(late(40.0, 0.0, reported=()), [at(40.0)])


@pytest.mark.parametrize(("reason", "is_hold"), [("frame_late", True), ("camera_lost", False)])
def test_a_beam_back_by_itself_is_no_result_after_another_hold_and_red_after_another_fault(reason, is_hold):
    strict = replace(EXPECTED, recoveries=frozenset({Recovery.ACKNOWLEDGED}))
    evidence = replace(
        LATCHED,
        edges=(edge(False, 7.0), edge(True, 129.0)),
        clear_ns=CAUSE_NS,
        reported=(Reported(what=reason, at_ns=at(9.0)),),
    )
    judged = Judged(expected=strict, evidence=evidence, troubles=judge(strict, evidence))
    assert Trouble.ON_UNASKED in judged.troubles
    with pytest.raises(MissedError) if is_hold else nullcontext():
        _refuse_another_s(judged, [at(7.0)])


def test_stalls_count_where_they_lie_between_cause_and_off():
    watchman = Watchman.__new__(Watchman)
    watchman._stalls = deque([(at(-50.0), at(10.0)), (at(40.0), at(60.0)), (at(95.0), at(200.0))])
    assert watchman.stalled_ms(at(0.0), at(100.0)) == pytest.approx(10.0 + 20.0 + 5.0)


def test_a_line_is_on_from_its_edge_to_the_next():
    edges = [edge(True, 0.0), edge(False, 40.0)]
    assert [is_on_at(edges, at(ms)) for ms in (-1.0, 0.0, 39.9, 40.0, 50.0)] == [False, True, True, False, False]


@pytest.mark.parametrize("trouble", Trouble)
def test_every_trouble_is_red_and_only_a_line_that_was_on_is_unsafe(trouble):
    unsafe = {Trouble.NEVER_OFF, Trouble.OFF_LATE, Trouble.BACK_EARLY, Trouble.ON_UNASKED}
    outcome = Outcome(kind="k", seed=1, off_ms=None, troubles=(trouble,), reported=(), recovery="")
    assert outcome.is_red
    assert outcome.is_unsafe is (trouble in unsafe)
