"""The judge of a kill, on evidence made by hand: what a product without a journal, a lease or a repair would leave."""

from dataclasses import replace

import pytest

from engine.core.clock import NS_PER_MS
from verification.faults.verdict import LineEdge
from verification.kills.campaign import KillCampaign
from verification.kills.verdict import (
    Evidence,
    Outcome,
    Step,
    Trouble,
    edge_ms,
    is_last_instant,
    judge,
    lost_ms,
    off_ms,
)

pytestmark = pytest.mark.waiting

MS = NS_PER_MS
KILLED = 10_000 * MS


def step(number: int, from_state: str, to_state: str, at_ms: int, reason: str = "") -> Step:
    at_ns = at_ms * MS
    words = {"from_state": from_state, "to_state": to_state, "reason": reason}
    return Step(**words, decided_ns=at_ns, received_ns=at_ns - 8 * MS, number=number)


STEPS = (
    step(1, "disarmed", "hold", 8000),
    step(2, "hold", "dwell", 8100),
    step(4, "dwell", "beam_on", 8210),
    step(5, "beam_on", "hold", 9000, "outside_window"),
    step(6, "hold", "dwell", 9500),
    step(8, "dwell", "beam_on", 9610),
)
EDGES = (
    LineEdge(is_on=True, at_ns=8214 * MS),
    LineEdge(is_on=False, at_ns=9003 * MS, cause="command"),
    LineEdge(is_on=True, at_ns=9614 * MS),
    LineEdge(is_on=False, at_ns=10_190 * MS, cause="heartbeat"),
)
GOOD = Evidence(
    killed_ns=KILLED,
    edges=EDGES,
    steps=STEPS,
    measured_from_ns=6000 * MS,
    last_sample_ns=9600 * MS,
    status="interrupted",
)


def without(steps: tuple[Step, ...], number: int) -> tuple[Step, ...]:
    return tuple(one for one in steps if one.number != number)


def test_a_kill_that_left_everything_as_promised_is_no_trouble():
    assert judge(GOOD) == ()
    assert (off_ms(GOOD), lost_ms(GOOD), edge_ms(GOOD)) == (190.0, 400.0, 386.0)


@pytest.mark.parametrize(
    ("spoiled", "trouble"),
    [
        (replace(GOOD, edges=EDGES[:3]), Trouble.NEVER_OFF),
        (replace(GOOD, edges=(*EDGES[:3], replace(EDGES[3], at_ns=10_215 * MS))), Trouble.OFF_LATE),
        (replace(GOOD, edges=(*EDGES, LineEdge(is_on=True, at_ns=11_000 * MS))), Trouble.ON_UNASKED),
        (replace(GOOD, steps=without(STEPS, 8)), Trouble.ON_UNREPORTED),
        (replace(GOOD, steps=without(STEPS, 6)), Trouble.NO_DWELL),
        (replace(GOOD, steps=(*STEPS[:4], replace(STEPS[4], received_ns=9503 * MS), STEPS[5])), Trouble.NO_DWELL),
        (replace(GOOD, steps=without(STEPS, 5)), Trouble.OFF_UNREPORTED),
        (replace(GOOD, steps=without(STEPS, 5)), Trouble.STATES_APART),
        (replace(GOOD, steps=STEPS[1:]), Trouble.STATES_APART),
        (replace(GOOD, steps=(*STEPS[:2], replace(STEPS[2], number=2), *STEPS[3:])), Trouble.NUMBERS_APART),
        (replace(GOOD, last_sample_ns=8960 * MS), Trouble.SAMPLES_LOST),
        (replace(GOOD, last_sample_ns=None), Trouble.SAMPLES_LOST),
        (replace(GOOD, is_audit_intact=False), Trouble.AUDIT_BROKEN),
        (replace(GOOD, database_trouble="page 3"), Trouble.DATABASE_BROKEN),
        (replace(GOOD, status="running"), Trouble.NOT_CLOSED),
        (replace(GOOD, is_ready=False), Trouble.NOT_READY),
        (replace(GOOD, has_new_session=False), Trouble.NO_NEW_SESSION),
        (replace(GOOD, leftovers=("a.partial",)), Trouble.LEFT_BEHIND),
    ],
)
def test_each_thing_that_may_be_wrong_is_found(spoiled, trouble):
    assert trouble in judge(spoiled)


def test_an_audit_that_lacks_everything_since_the_last_commit_is_red_at_every_edge_it_lacks():
    """What a product without a journal leaves, killed 5 ms behind an on."""
    killed_ns = 9619 * MS
    spoiled = replace(
        GOOD, killed_ns=killed_ns, steps=STEPS[:5], edges=(*EDGES[:3], replace(EDGES[3], at_ns=9800 * MS))
    )
    assert judge(spoiled) == (Trouble.ON_UNREPORTED,)


def test_an_off_in_the_last_instant_is_excused_and_counted_and_one_before_is_not():
    off = LineEdge(is_on=False, at_ns=KILLED - 25 * MS, cause="command")
    excused = replace(GOOD, edges=(*EDGES[:3], off))
    assert judge(excused) == ()
    assert is_last_instant(excused)
    reported = replace(excused, steps=(*STEPS, step(9, "beam_on", "hold", 9974, "outside_window")))
    assert judge(reported) == ()
    assert not is_last_instant(reported)
    assert judge(replace(excused, edges=(*EDGES[:3], replace(off, at_ns=KILLED - 35 * MS)))) == (
        Trouble.OFF_UNREPORTED,
    )


def test_an_on_is_never_excused_however_late_it_was():
    on = LineEdge(is_on=True, at_ns=KILLED - MS)
    off = LineEdge(is_on=False, at_ns=KILLED + 150 * MS)
    assert judge(replace(GOOD, steps=STEPS[:5], edges=(*EDGES[:2], on, off))) == (Trouble.ON_UNREPORTED,)


def test_a_dwell_is_counted_by_when_its_frames_came_and_not_by_when_they_were_decided_on():
    late = replace(STEPS[4], decided_ns=9600 * MS)
    assert judge(replace(GOOD, steps=(*STEPS[:4], late, STEPS[5]))) == ()


def test_a_recorded_permit_that_was_never_sent_is_no_trouble():
    assert judge(replace(GOOD, edges=EDGES[:2])) == ()


def test_a_machine_that_stood_still_excuses_so_much_and_no_more():
    late = replace(GOOD, edges=(*EDGES[:3], replace(EDGES[3], at_ns=10_230 * MS)))
    assert judge(replace(late, stall_ms=25.0)) == ()
    assert judge(replace(late, stall_ms=15.0)) == (Trouble.OFF_LATE,)


def test_only_a_machine_stall_before_the_kill_excuses_an_off_without_a_decision():
    lapsed = replace(GOOD, edges=(*EDGES[:3], LineEdge(is_on=False, at_ns=KILLED - 79 * MS, cause="command")))
    assert judge(replace(lapsed, stall_before_ms=50.0)) == ()
    assert judge(replace(lapsed, stall_ms=50.0)) == (Trouble.OFF_UNREPORTED,)
    assert judge(replace(lapsed, stall_before_ms=48.0)) == (Trouble.OFF_UNREPORTED,)


def test_a_watchdog_s_fault_may_stand_between_the_engine_s_own_rows_and_is_taken_up_later():
    fault = step(9, "beam_on", "fault", 9700, "watchdog")
    late = step(10, "beam_on", "hold", 9690, "frame_late")
    acknowledged = step(11, "fault", "disarmed", 9900)
    for steps in ((fault, late, acknowledged), (fault, acknowledged), (late, fault, acknowledged)):
        assert Trouble.STATES_APART not in judge(replace(GOOD, steps=(*STEPS, *steps)))


def test_a_watchdog_excuses_no_other_state_and_one_step_only():
    fault = step(9, "beam_on", "fault", 9700, "watchdog")
    acknowledged = step(11, "fault", "disarmed", 9900)
    for steps in ((fault, step(12, "hold", "dwell", 9950)), (fault, acknowledged, step(12, "fault", "disarmed", 9950))):
        assert Trouble.STATES_APART in judge(replace(GOOD, steps=(*STEPS, *steps)))


def test_a_session_that_was_never_measured_has_no_samples_to_lose():
    assert judge(Evidence(killed_ns=KILLED)) == ()
    assert lost_ms(Evidence(killed_ns=KILLED)) is None


def test_what_hurts_is_distinguished_from_what_is_only_wrong():
    assert Trouble.ON_UNASKED.is_unsafe
    assert not Trouble.SAMPLES_LOST.is_unsafe


def test_kills_are_read_as_they_were_written_and_what_is_no_kill_is_passed_over(tmp_path):
    file, kill = (
        KillCampaign().kept_in(tmp_path),
        Outcome(number=3, moment="ready", troubles=("the line never went off",), off_ms=2.0),
    )
    file.append(kill)
    with file.path.open("a") as other:
        other.write('12\n[]\n{"number": 4}\n{"number": 5, "mom')
    assert file.read() == [kill]
