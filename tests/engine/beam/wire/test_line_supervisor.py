"""The judge of a wired line at the very instant, without line, wire or thread."""

import pytest

from engine.beam.wire.line_supervisor import DETECTION_MS, GOOD_ANSWERS, HISTORY, LineSupervisor, LineTimes, ReadEdge
from engine.core.errors import InvalidValueError
from engine.core.gate_state import HoldReason
from tests.support.beam.stepped_line import MS

TIMES = LineTimes(answer_ms=100.0, settle_ms=60.0)
ANSWER_NS, SETTLE_NS, FOLLOW_NS = 100 * MS, 60 * MS, 160 * MS
START_NS = 1_000 * MS
FAILED, MISMATCH = HoldReason.BEAM_LINE_FAILED, HoldReason.BEAM_LINE_MISMATCH


class Supervised:
    """A judge, and the exchanges it is reported of."""

    def __init__(self, *, proved_off=True):
        self.judge = LineSupervisor(TIMES, now_ns=START_NS)
        self.now_ns = START_NS
        if proved_off:
            assert self.exchange(commands_on=False, reads_on=False) is None

    def after(self, ms=0, ns=0):
        self.now_ns += round(ms * MS) + ns
        return self

    def begin(self, *, commands_on):
        self.judge.begin(commands_on=commands_on, now_ns=self.now_ns)
        return self

    def answered(self, *, reads_on):
        return self.judge.answered(reads_on=reads_on, now_ns=self.now_ns)

    def exchange(self, *, commands_on, reads_on, took_ms=0, took_ns=0):
        return self.begin(commands_on=commands_on).after(took_ms, took_ns).answered(reads_on=reads_on)

    def check(self, *, wants_on):
        return self.judge.check(wants_on=wants_on, now_ns=self.now_ns)


def lit():
    """Commanded on, and read on."""
    held = Supervised().after(20)
    assert held.exchange(commands_on=True, reads_on=True) is None
    return held


def test_a_line_that_was_just_opened_may_be_on_until_it_was_read_off():
    held = Supervised(proved_off=False)
    judge = held.judge
    assert (judge.commands_on, judge.reads_on, judge.may_be_on) == (False, False, True)
    assert not judge.may_command_on(held_at_ns=None)
    assert not judge.is_healthy(held.now_ns)
    held.exchange(commands_on=False, reads_on=False, took_ms=3)
    assert not judge.may_be_on
    assert judge.may_command_on(held_at_ns=None)
    assert list(judge.answers_ns) == [3 * MS]
    assert list(judge.edges) == [ReadEdge(is_on=False, commanded_ns=START_NS, read_ns=START_NS + 3 * MS)]


def test_a_line_that_is_never_read_off_after_it_was_opened_is_in_trouble_when_it_should_have_followed():
    held = Supervised(proved_off=False)
    held.begin(commands_on=False).answered(reads_on=True)
    assert held.after(160).exchange(commands_on=False, reads_on=True) is None
    trouble = held.after(ns=1).exchange(commands_on=False, reads_on=True)
    assert (trouble.reason, trouble.detail) == (MISMATCH, "the beam line reads back on after the command off")


@pytest.mark.parametrize(("late_ns", "is_late"), [(0, False), (1, True)])
def test_an_answer_may_take_as_long_as_it_may(late_ns, is_late):
    held = lit().after(20)
    trouble = held.exchange(commands_on=True, reads_on=True, took_ms=100, took_ns=late_ns)
    assert (trouble is not None) is is_late
    if is_late:
        assert (trouble.reason, trouble.at_ns) == (FAILED, held.now_ns)
        assert trouble.detail == "the beam line has not answered for 100 ms"


@pytest.mark.parametrize(("late_ns", "is_late"), [(0, False), (1, True)])
def test_somebody_who_looks_sees_a_question_that_is_not_answered_in_time(late_ns, is_late):
    held = lit().after(20).begin(commands_on=True).after(100, late_ns)
    trouble = held.check(wants_on=True)
    assert (trouble is not None) is is_late
    if is_late:
        assert (trouble.reason, trouble.detail) == (FAILED, "the beam line has not answered for 100 ms")


def test_an_unrequested_reply_is_not_late():
    held = lit()
    assert held.after(190).check(wants_on=True) is None
    assert held.judge.answered(reads_on=True, now_ns=held.now_ns) is None
    assert held.judge.answers_ns[-1] == 0


@pytest.mark.parametrize(("late_ns", "is_late"), [(0, False), (1, True)])
def test_a_line_commanded_on_has_its_time_to_read_on(late_ns, is_late):
    held = Supervised().after(20)
    assert held.exchange(commands_on=True, reads_on=False) is None
    commanded_ns = held.now_ns
    assert held.after(100).exchange(commands_on=True, reads_on=False) is None
    held.after(60, late_ns)
    trouble = held.check(wants_on=True)
    assert held.now_ns - commanded_ns == FOLLOW_NS + late_ns
    assert (trouble is not None) is is_late
    if is_late:
        assert (trouble.reason, trouble.detail) == (MISMATCH, "the beam line reads back off after the command on")


@pytest.mark.parametrize(("late_ns", "is_late"), [(0, False), (1, True)])
@pytest.mark.parametrize("reads_on", [True, False])
def test_a_hold_counts_from_when_it_was_given_and_not_from_when_it_was_sent(late_ns, is_late, reads_on):
    """The exchange that is to tell it may hang; what was read before says on in either case."""
    held = lit().after(20)
    if not reads_on:
        held.judge.reads_on = False
    held.after(10)
    assert held.check(wants_on=False) is None
    held.after(160, late_ns)
    trouble = held.check(wants_on=False)
    assert (trouble is not None) is is_late
    if is_late:
        assert trouble.reason is FAILED
        assert trouble.detail == "the beam line has not confirmed off within 160 ms of the hold"
        assert trouble.at_ns == held.now_ns


def test_a_line_that_answers_on_after_a_hold_is_contrary_and_one_that_states_nothing_has_failed():
    held = lit().after(20)
    held.check(wants_on=False)
    assert held.after(10).exchange(commands_on=False, reads_on=True) is None
    trouble = held.after(151).check(wants_on=False)
    assert (trouble.reason, trouble.detail) == (MISMATCH, "the beam line reads back on after the command off")


def test_an_answer_of_the_very_instant_of_a_hold_counts_as_one_behind_it():
    held = lit().after(20)
    held.check(wants_on=False)
    assert held.exchange(commands_on=False, reads_on=True) is None
    assert held.after(161).check(wants_on=False).reason is MISMATCH


def test_a_line_that_reads_on_of_itself_is_contrary_at_once():
    held = Supervised().after(20)
    assert held.exchange(commands_on=False, reads_on=False) is None
    trouble = held.after(20).exchange(commands_on=False, reads_on=True)
    assert (trouble.reason, trouble.at_ns) == (MISMATCH, held.now_ns)
    assert trouble.detail == "the beam line reads back on after the command off"


@pytest.mark.parametrize(("since_ms", "is_proved"), [(59.999, False), (60, True)])
def test_off_is_no_proof_while_a_contact_that_was_commanded_on_may_still_be_on_its_way(since_ms, is_proved):
    held = Supervised().after(20)
    held.exchange(commands_on=True, reads_on=False)
    held.after(since_ms)
    held.exchange(commands_on=False, reads_on=False)
    assert held.judge.may_be_on is not is_proved
    assert held.judge.may_command_on(held_at_ns=None) is is_proved


def test_off_is_a_proof_at_once_where_on_was_read_before():
    held = lit().after(5)
    off_ns = held.now_ns
    held.exchange(commands_on=False, reads_on=False, took_ms=4)
    assert not held.judge.may_be_on
    assert held.judge.edges[-1] == ReadEdge(is_on=False, commanded_ns=off_ns, read_ns=off_ns + 4 * MS)


def test_edges_count_from_the_first_order_and_are_noted_once():
    held = Supervised().after(20)
    on_ns = held.now_ns
    held.exchange(commands_on=True, reads_on=False, took_ms=3)
    held.after(17).exchange(commands_on=True, reads_on=True, took_ms=3)
    held.after(17).exchange(commands_on=True, reads_on=True, took_ms=3)
    held.after(5)
    held.check(wants_on=False)
    off_ns = held.now_ns
    held.after(7).exchange(commands_on=False, reads_on=True, took_ms=3)
    held.after(17).exchange(commands_on=False, reads_on=False, took_ms=3)
    held.after(17).exchange(commands_on=False, reads_on=False, took_ms=3)
    assert list(held.judge.edges)[1:] == [
        ReadEdge(is_on=True, commanded_ns=on_ns, read_ns=on_ns + 23 * MS),
        ReadEdge(is_on=False, commanded_ns=off_ns, read_ns=off_ns + 30 * MS),
    ]


@pytest.mark.parametrize(("held_before_ns", "may"), [(1, True), (0, False), (-1, False)])
def test_a_line_commanded_on_may_be_commanded_again_unless_a_hold_came_since(held_before_ns, may):
    held = Supervised().after(20)
    on_ns = held.now_ns
    held.exchange(commands_on=True, reads_on=True)
    assert held.judge.may_command_on(held_at_ns=None)
    assert held.judge.may_command_on(held_at_ns=on_ns - held_before_ns) is may


def test_a_line_that_is_wanted_off_may_not_be_commanded_on_before_that_was_read():
    held = lit().after(5)
    held.check(wants_on=False)
    assert not held.judge.may_command_on(held_at_ns=None)
    held.exchange(commands_on=False, reads_on=True)
    assert not held.judge.may_command_on(held_at_ns=None)
    held.exchange(commands_on=False, reads_on=False)
    assert held.judge.may_command_on(held_at_ns=None)


def test_a_failed_exchange_may_have_delivered_its_command():
    held = Supervised().after(20)
    held.begin(commands_on=True).after(4)
    held.judge.failed(now_ns=held.now_ns)
    assert (held.judge.commands_on, held.judge.may_be_on) == (False, True)
    assert held.after(160).check(wants_on=False) is None
    assert held.after(ns=1).check(wants_on=False).reason is FAILED


def test_it_is_healthy_after_three_good_answers_in_a_row_that_read_off():
    assert GOOD_ANSWERS == 3
    held = Supervised()
    healths = []
    for _ in range(4):
        healths.append(held.judge.is_healthy(held.now_ns))
        held.after(20).exchange(commands_on=False, reads_on=False)
    assert healths == [False, False, True, True]
    held.judge.failed(now_ns=held.now_ns)
    healths = []
    for _ in range(4):
        healths.append(held.judge.is_healthy(held.now_ns))
        held.after(20).exchange(commands_on=False, reads_on=False)
    assert healths == [False, False, False, True]


def test_trouble_begins_the_count_of_good_answers_anew():
    held = Supervised()
    for _ in range(3):
        held.after(20).exchange(commands_on=False, reads_on=False)
    assert held.judge.is_healthy(held.now_ns)
    held.begin(commands_on=False).after(101)
    assert held.check(wants_on=False) is not None
    assert not held.judge.is_healthy(held.now_ns)
    held.answered(reads_on=False)
    for healthy in (False, False, True):
        held.after(20).exchange(commands_on=False, reads_on=False)
        assert held.judge.is_healthy(held.now_ns) is healthy


def test_a_line_that_is_on_is_not_ready_to_be_armed():
    held = lit()
    for _ in range(4):
        held.after(20).exchange(commands_on=True, reads_on=True)
    assert not held.judge.is_healthy(held.now_ns)


@pytest.mark.parametrize(("late_ns", "is_silent"), [(0, False), (1, True)])
def test_it_is_silent_when_the_newest_answer_is_older_than_any_may_be(late_ns, is_silent):
    held = Supervised()
    for _ in range(3):
        held.after(20).exchange(commands_on=False, reads_on=False)
    later_ns = held.now_ns + int(DETECTION_MS * MS) + late_ns
    assert held.judge.is_silent(later_ns) is is_silent
    assert held.judge.is_healthy(later_ns) is not is_silent


def test_histories_are_bounded():
    assert (Supervised().judge.edges.maxlen, Supervised().judge.answers_ns.maxlen) == (HISTORY, HISTORY)


@pytest.mark.parametrize(
    ("answer_ms", "settle_ms", "field"),
    [
        (19.9, 60.0, "answer_ms"),
        (150.1, 0.0, "answer_ms"),
        (100.0, -0.1, "settle_ms"),
        (20.0, 150.1, "settle_ms"),
        (100.0, 60.1, "settle_ms"),
        (True, 60.0, "answer_ms"),
        ("100", 60.0, "answer_ms"),
        (float("nan"), 60.0, "answer_ms"),
    ],
)
def test_times_out_of_their_bounds_are_refused_by_name_and_value(answer_ms, settle_ms, field):
    with pytest.raises(InvalidValueError) as refused:
        LineTimes(answer_ms=answer_ms, settle_ms=settle_ms)
    given = answer_ms if field == "answer_ms" else settle_ms
    assert (refused.value.field, refused.value.value) == (field, repr(given))


def test_times_at_their_bounds_are_taken_and_what_both_may_be_together_is_reported():
    for answer_ms, settle_ms in ((20.0, 140.0), (150.0, 10.0), (150.0, 0.0), (20.0, 0.0), (100, 60)):
        times = LineTimes(answer_ms=answer_ms, settle_ms=settle_ms)
        assert (times.answer_ns, times.settle_ns) == (round(answer_ms * MS), round(settle_ms * MS))
        assert times.follow_ns == times.answer_ns + times.settle_ns
    with pytest.raises(InvalidValueError) as refused:
        LineTimes(answer_ms=150.0, settle_ms=10.1)
    assert refused.value.bound == "at most 10 with answer_ms 150"
    with pytest.raises(InvalidValueError) as refused:
        LineTimes(answer_ms=0.0)
    assert refused.value.bound == "a number from 20 to 150"


def test_a_hold_that_was_not_followed_in_time_begins_the_count_of_good_answers_anew():
    held = lit().after(20)
    held.check(wants_on=False)
    assert held.after(160, 1).check(wants_on=False) is not None
    healths = []
    for _ in range(5):
        held.after(20).exchange(commands_on=False, reads_on=False)
        healths.append(held.judge.is_healthy(held.now_ns))
    assert healths == [False, False, True, True, True]


@pytest.mark.parametrize(("old_ns", "reason"), [(FOLLOW_NS + 1, MISMATCH), (FOLLOW_NS + 2, FAILED)])
def test_a_line_that_read_on_of_itself_and_states_nothing_more_has_failed_to_prove_off(old_ns, reason):
    held = Supervised().after(20)
    assert held.exchange(commands_on=False, reads_on=True).reason is MISMATCH
    assert held.after(ns=old_ns).check(wants_on=False).reason is reason
