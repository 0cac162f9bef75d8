"""A line at the end of a wire, on a clock of the test's: what it does, and that no trouble lasts 200 ms unnoticed."""

import itertools

import pytest

from engine.beam.deadman import Grant
from engine.beam.wire.line_supervisor import (
    DETECTION_MS,
    GOOD_ANSWERS,
    MAX_ANSWER_AND_SETTLE_MS,
    TIME_BOUNDS,
    LineTimes,
    Trouble,
)
from engine.beam.wire.supervised_line import CYCLE_NS
from engine.core.errors import BeamLineError, BeamLineMismatchError, InvalidValueError
from engine.core.gate_state import HoldReason
from tests.support.beam.stepped_line import MS, World

FAILED, MISMATCH = HoldReason.BEAM_LINE_FAILED, HoldReason.BEAM_LINE_MISMATCH
ON_MS = 200
"""Every story permits from here on."""


def lit(times: LineTimes | None = None, *, until_ms: int = 500, **wire: int) -> World:
    """A line that is permitted every frame from ON_MS on; the story is not reported yet."""
    world = World(times, **wire).opened()
    world.permit_each_frame(ON_MS, until_ms)
    return world


def test_a_permit_is_sent_at_once_and_counts_as_on_only_when_read_back():
    world = lit(answer_ms=5)
    world.run(to_ms=ON_MS)
    assert (world.line.is_on(), world.line.is_settling) == (False, True)
    world.run(to_ms=ON_MS + 4)
    assert (world.wire.commands_on, world.line.is_on(), world.line.is_settling) == (True, False, True)
    world.run(to_ms=ON_MS + 12)
    assert (world.line.is_on(), world.line.is_settling) == (True, False)
    assert [edge.is_on for edge in world.line.edges] == [False, True]


def test_a_hold_is_sent_at_once_and_counts_as_on_until_read_back_off():
    world = lit(answer_ms=5, until_ms=300)
    world.at(300, world.hold)
    world.run(to_ms=300)
    assert (world.line.is_on(), world.line.is_settling) == (True, True)
    world.run(to_ms=304)
    assert (world.wire.commands_on, world.line.is_on()) == (False, True)
    world.run(to_ms=330)
    assert (world.line.is_on(), world.line.is_settling) == (False, False)
    assert world.troubles == []


def test_a_hold_before_the_permit_was_read_back_counts_as_on_until_proved_off():
    world = World(answer_ms=10).opened()
    world.at(ON_MS, world.permit)
    world.at(ON_MS + 4, world.hold)
    world.run(to_ms=ON_MS + 5)
    assert (world.line._supervisor.reads_on, world.line.is_on()) == (False, True)


def test_a_hold_between_deciding_to_tell_on_and_telling_it_is_seen():
    world = World().opened()
    world.permit()
    begin = world.line._supervisor.begin

    def interrupted(*, commands_on, now_ns):
        world.line._supervisor.begin = begin
        world.clock.advance_ns(1)
        world.hold()
        begin(commands_on=commands_on, now_ns=now_ns)

    world.line._supervisor.begin = interrupted
    commands = len(world.wire.commands)
    world.line.exchange_once()
    assert [is_on for _, is_on, _ in world.wire.commands[commands:]] == [False]


@pytest.mark.parametrize("answer_ms", [1, 7, 30])
def test_a_lease_that_is_not_renewed_lapses_in_the_line_within_one_exchange(answer_ms):
    for length_ms in range(60, 130, 3):
        world = World(answer_ms=answer_ms).opened()
        world.at(ON_MS, lambda world=world, length_ms=length_ms: world.permit(length_ms))
        world.run(to_ms=ON_MS + 300)
        reported_on = [at_ns for at_ns, is_on, _ in world.wire.commands if is_on]
        first_off = next(at_ns for at_ns, is_on, _ in world.wire.commands if at_ns > reported_on[-1] and not is_on)
        late_ms = (first_off - world.start_ns) / MS - ON_MS - length_ms
        assert 0 <= late_ms <= answer_ms
        assert world.troubles == []


def test_the_heartbeat_counts_up_at_every_exchange_and_at_least_every_25_ms():
    world = lit(until_ms=900).run(to_ms=900)
    beats = [heartbeat for _, _, heartbeat in world.wire.commands]
    assert beats == list(range(1, len(beats) + 1))
    gaps_ms = [(b - a) / MS for (a, _, _), (b, _, _) in itertools.pairwise(world.wire.commands)]
    assert max(gaps_ms) <= 25


def test_the_heartbeat_fits_a_register():
    world = World().opened()
    world.line._heartbeat = 65_534
    world.run(to_ms=world.now_ms + 60)
    assert [heartbeat for _, _, heartbeat in world.wire.commands[-2:]] != []
    assert {65_535, 0} <= {heartbeat for _, _, heartbeat in world.wire.commands}


TIMES = [
    LineTimes(answer_ms=100, settle_ms=60),
    LineTimes(answer_ms=150, settle_ms=10),
    LineTimes(answer_ms=20, settle_ms=140),
    LineTimes(answer_ms=20, settle_ms=0),
]
SLOWNESS = [1, 9, 18]


def _break(world: World, kind: str) -> None:
    if kind == "silent":
        world.wire.is_silent = True
    elif kind == "refusing":
        world.wire.is_refusing = True
    elif kind == "late":
        world.wire.answer_ms = round(world.line._times.answer_ms) + 1
    else:
        world.wire.stuck = kind == "stuck on"


REASON_OF = {"silent": FAILED, "refusing": FAILED, "late": FAILED, "stuck on": MISMATCH, "stuck off": MISMATCH}


@pytest.mark.parametrize("times", TIMES, ids=lambda times: f"{times.answer_ms:g}+{times.settle_ms:g}")
@pytest.mark.parametrize("answer_ms", SLOWNESS)
@pytest.mark.parametrize(
    ("kind", "is_permitted"),
    [
        ("silent", True),
        ("silent", False),
        ("refusing", True),
        ("late", True),
        ("late", False),
        ("stuck off", True),
        ("stuck on", False),
    ],
)
def test_whatever_goes_wrong_whenever_it_is_held_and_latched_within_200_ms(times, answer_ms, kind, is_permitted):
    for phase_ms in range(0, 40, 3):
        world = World(times, answer_ms=answer_ms).opened()
        if is_permitted:
            world.permit_each_frame(ON_MS, 900)
        broken_ms = 500 + phase_ms
        world.at(broken_ms, lambda world=world: _break(world, kind))
        world.run(to_ms=900)
        assert world.troubles, f"nothing was noticed of {kind} at {phase_ms} ms"
        noticed_ms, reason, detail = world.troubles[0]
        assert broken_ms <= noticed_ms <= broken_ms + DETECTION_MS
        assert reason is REASON_OF[kind], detail
        assert not [
            at_ns for at_ns, is_on, _ in world.wire.commands if is_on and at_ns > world.start_ns + noticed_ms * MS
        ]
        with pytest.raises(BeamLineError):
            world.permit()


@pytest.mark.parametrize("times", TIMES, ids=lambda times: f"{times.answer_ms:g}+{times.settle_ms:g}")
@pytest.mark.parametrize("answer_ms", SLOWNESS)
@pytest.mark.parametrize("ends", ["held", "lapsed"])
def test_a_contact_that_sticks_on_is_latched_within_200_ms_of_the_hold_it_does_not_follow(times, answer_ms, ends):
    for phase_ms in range(0, 40, 3):
        held_ms = 500 + phase_ms
        world = World(times, answer_ms=answer_ms).opened()
        world.permit_each_frame(ON_MS, held_ms)
        world.at(450, lambda world=world: _break(world, "stuck on"))
        if ends == "held":
            world.at(held_ms, world.hold)
        else:
            last_ms = max(ms for ms in range(ON_MS, held_ms, 33))
            held_ms = last_ms + 80
        world.run(to_ms=900)
        noticed_ms, reason, _ = world.troubles[0]
        assert held_ms <= noticed_ms <= held_ms + DETECTION_MS
        assert reason is MISMATCH


@pytest.mark.parametrize(
    ("times", "answer_ms", "lag_ms"),
    [(TIMES[0], 1, 60), (TIMES[0], 40, 20), (TIMES[0], 45, 60), (TIMES[2], 5, 130), (TIMES[3], 15, 0), (None, 19, 45)],
)
def test_a_line_as_slow_as_it_may_be_raises_no_alarm_however_the_gate_goes_on_and_off(times, answer_ms, lag_ms):
    world = World(times, answer_ms=answer_ms, lag_ms=lag_ms).opened()
    for period in range(12):
        from_ms = 300 + period * (200 + 7 * period)
        world.permit_each_frame(from_ms, from_ms + 1 + 33 * (period % 4))
        world.at(from_ms + 34 * (period % 4) + 5 + period, world.hold)
    world.run(to_ms=4_500)
    assert world.troubles == []
    assert not world.line.is_on()


def test_a_hold_during_a_long_exchange_is_not_passed_over_when_permits_come_again():
    world = lit(LineTimes(answer_ms=100, settle_ms=60), until_ms=499, answer_ms=5)
    world.at(480, lambda: setattr(world.wire, "answer_ms", 90))
    world.at(502, world.hold)
    world.permit_each_frame(503, 900)
    world.run(to_ms=1_000)
    held_ns = world.start_ns + 502 * MS
    later = [is_on for at_ns, is_on, _ in world.wire.commands if at_ns > held_ns]
    assert later[0] is False


def test_a_contact_that_sticks_on_is_seen_though_the_gate_permits_again_at_once():
    world = World().opened()
    world.permit_each_frame(ON_MS, 400)
    world.at(390, lambda: _break(world, "stuck on"))
    for ms in range(410, 900, 40):
        world.at(ms, world.hold)
        world.at(ms + 20, world._try_permit)
    world.run(to_ms=900)
    assert world.troubles[0][1] is MISMATCH
    assert world.troubles[0][0] <= 410 + DETECTION_MS


def test_the_heartbeat_stands_still_while_the_line_is_stuck_on_so_that_the_receiver_drops_it():
    world = World().opened()
    world.at(300, lambda: _break(world, "stuck on"))
    world.run(to_ms=900)
    noticed_ns = world.start_ns + world.troubles[0][0] * MS
    beats = {heartbeat for at_ns, _, heartbeat in world.wire.commands if at_ns > noticed_ns}
    assert len(beats) == 1


def test_a_line_that_comes_back_stays_off_until_a_person_arms_again():
    world = lit(until_ms=3_000)
    world.at(500, lambda: _break(world, "refusing"))
    world.at(900, lambda: setattr(world.wire, "is_refusing", False))
    world.run(to_ms=850)
    with pytest.raises(BeamLineError, match="reset by peer"):
        world.line.is_on()
    with pytest.raises(BeamLineError, match="reset by peer"):
        world.line.rearm()
    world.run(to_ms=2_000)
    assert world.wire.connects >= 2
    assert not [at_ns for at_ns, is_on, _ in world.wire.commands if is_on and at_ns > world.start_ns + 700 * MS]
    assert not world.line.is_on()
    with pytest.raises(BeamLineError):
        world.permit()
    world.line.rearm()
    world.run(to_ms=2_200)
    assert world.line.is_on()


def test_a_trouble_that_is_over_before_the_poll_is_reported_once_and_stays_latched():
    world = lit(until_ms=3_000)
    world.at(500, lambda: setattr(world.wire, "stuck", False))
    world.at(690, lambda: setattr(world.wire, "stuck", None))
    world.run(to_ms=1_500)
    with pytest.raises(BeamLineMismatchError, match="reads back off after the command on"):
        world.line.is_on()
    assert not world.line.is_on()
    with pytest.raises(BeamLineMismatchError):
        world.permit()


def test_arming_needs_some_good_answers_in_a_row_after_a_trouble():
    world = World(answer_ms=1)
    world.line.open()
    for _ in range(GOOD_ANSWERS - 1):
        with pytest.raises(BeamLineError, match="fewer than 3 good answers"):
            world.line.rearm()
        world.line.exchange_once()
    world.line.rearm()


def test_a_line_that_is_no_longer_polled_is_reported_as_failed():
    world = lit().run(to_ms=400)
    assert world.line.is_on()
    world.clock.advance_ns(int(DETECTION_MS * MS) + 1)
    with pytest.raises(BeamLineError, match="exchanges with the line have stopped"):
        world.line.is_on()
    with pytest.raises(BeamLineError):
        world.permit()


def test_a_line_that_does_not_answer_or_reads_on_is_refused_at_opening():
    world = World()
    world.wire.is_refusing = True
    with pytest.raises(BeamLineError, match="the scripted line does not answer: refused"):
        world.line.open()
    world = World()
    world.wire.stuck = True
    with pytest.raises(BeamLineMismatchError, match="though nothing was permitted"):
        world.line.open()
    assert world.wire.closes == 1
    world = World(answer_ms=101)
    with pytest.raises(BeamLineError, match="has not answered for 101 ms"):
        world.line.open()


def test_a_line_that_is_not_open_refuses_everything_but_holds():
    world = World()
    world.line.hold(HoldReason.WATCHDOG)
    world.line.close()
    for ask in (world.permit, world.line.rearm, world.line.is_on):
        with pytest.raises(BeamLineError):
            ask()


def test_a_listener_that_fails_does_not_disturb_the_line():
    world = World().opened()

    def fail(_reason, _detail):
        raise RuntimeError("listener")

    world.line.on_trouble = fail
    world.line._supervisor.begin(commands_on=False, now_ns=world.clock.now_ns())
    world.clock.advance_ns(101 * MS)
    world.line.watch_once()
    with pytest.raises(BeamLineError, match="101 ms"):
        world.line.is_on()


def test_on_is_not_sent_again_before_the_last_off_was_read_back():
    world = World(answer_ms=3, lag_ms=50).opened()
    world.permit_each_frame(ON_MS, 400)
    world.at(400, world.hold)
    world.permit_each_frame(405, 600)
    world.run(to_ms=600)
    held_ns = world.start_ns + 400 * MS
    commanded_on_again = next(at_ns for at_ns, is_on, _ in world.wire.commands if is_on and at_ns > held_ns)
    assert held_ns + 50 * MS <= commanded_on_again <= held_ns + 100 * MS
    assert world.troubles == []


def test_a_hold_that_has_to_wait_for_a_long_exchange_counts_from_when_it_was_stated():
    world = lit(LineTimes(answer_ms=100, settle_ms=60), until_ms=520, answer_ms=5)
    world.at(480, lambda: setattr(world.wire, "answer_ms", 95), lambda: _break(world, "stuck on"))
    world.at(521, world.hold)
    world.run(to_ms=900)
    assert 521 <= world.troubles[0][0] <= 521 + DETECTION_MS


def test_a_latched_line_is_off_twice_over_by_its_dead_man_and_by_its_trouble():
    world = lit().run(to_ms=400)
    world.line._latch(Trouble(reason=FAILED, detail="found by somebody", at_ns=world.clock.now_ns()))
    assert not world.line._deadman.is_on(world.clock.now_ns())
    assert world.line._deadman._is_latched
    world.line._deadman.rearm()
    now_ns = world.clock.now_ns() + 1
    world.clock.advance_ns(MS)
    world.line._deadman.grant(Grant(decided_ns=now_ns, expires_ns=now_ns + 80 * MS, sequence=999), now_ns=now_ns)
    commands = len(world.wire.commands)
    for _ in range(3):
        world.line.exchange_once()
    assert [is_on for _, is_on, _ in world.wire.commands[commands:]] == [False] * 3


def _trouble(world: World, reason: HoldReason, detail: str) -> Trouble:
    return Trouble(reason=reason, detail=detail, at_ns=world.clock.now_ns())


def test_the_first_cause_is_shown_until_it_was_reported_and_only_then_replaced():
    world = lit().run(to_ms=400)
    world.line._latch(_trouble(world, FAILED, "the first"))
    world.line._latch(_trouble(world, MISMATCH, "the second"))
    assert [detail for _, _, detail in world.troubles] == ["the first"]
    with pytest.raises(BeamLineError, match="the first"):
        world.permit()
    with pytest.raises(BeamLineError, match="the first") as commands:
        world.line.is_on()
    assert type(commands.value) is BeamLineError, "a failure is no mismatch"
    world.line._latch(_trouble(world, FAILED, "the first, found again"))
    world.line._latch(_trouble(world, MISMATCH, "the third"))
    assert [(reason, detail) for _, reason, detail in world.troubles] == [
        (FAILED, "the first"),
        (MISMATCH, "the third"),
    ]
    with pytest.raises(BeamLineMismatchError, match="the third"):
        world.line.is_on()


def test_a_failure_without_words_is_reported_by_its_kind(monkeypatch):
    def fail():
        raise ConnectionResetError

    world = World()
    monkeypatch.setattr(world.wire, "connect", fail)
    with pytest.raises(BeamLineError, match=r"does not answer: ConnectionResetError\Z"):
        world.line.open()


def test_a_lease_that_ended_while_the_line_was_commanded_on_is_commanded_off_without_any_rest():
    world = lit(until_ms=ON_MS + 1).run(to_ms=ON_MS + 60)
    assert world.line._supervisor.commands_on
    world.clock.advance_ns(20 * MS)
    assert world.line.rest_ns() == 0


def test_a_permit_that_ended_before_it_could_be_sent_brings_no_exchange_forward():
    world = World().opened()
    world.permit(length_ms=5)
    world.clock.advance_ns(5 * MS - 1)
    assert world.line.rest_ns() == 1
    world.clock.advance_ns(1)
    assert world.line.rest_ns() == CYCLE_NS


@pytest.mark.parametrize("name", TIME_BOUNDS)
@pytest.mark.parametrize("value", [-1.0, 151.0, float("nan"), float("inf"), True, "100", None])
def test_a_time_out_of_its_bound_is_refused_by_name(name, value):
    with pytest.raises(InvalidValueError, match=name):
        LineTimes(**{name: value})


def test_times_that_together_break_the_promise_are_refused():
    LineTimes(answer_ms=100.0, settle_ms=MAX_ANSWER_AND_SETTLE_MS - 100.0)
    with pytest.raises(InvalidValueError, match="settle_ms"):
        LineTimes(answer_ms=100.0, settle_ms=MAX_ANSWER_AND_SETTLE_MS - 99.9)


def test_a_wire_is_given_the_time_for_an_answer_and_no_more_also_to_be_commanded_off_when_it_is_given_up(monkeypatch):
    world = World(LineTimes(answer_ms=80, settle_ms=60)).opened()
    given = []

    def fail(*, is_on, heartbeat, within_s):
        given.append((is_on, within_s))
        raise OSError("reset by peer")

    monkeypatch.setattr(world.wire, "exchange", fail)
    world.line.exchange_once()
    assert given == [(False, 0.08)] * 2


def test_closing_waits_a_second_for_a_thread_that_hangs_in_a_driver_and_not_for_ever():
    class Hung:
        name, waited_s = "tidegate-beam-line", ()

        def is_alive(self):
            return True

        def join(self, timeout=None):
            self.waited_s += (timeout,)

    world, hung = World().opened(), Hung()
    world.line._threads = (hung,)
    world.line.close()
    assert hung.waited_s == (1.0,)
