"""The drill of the heartbeat: it fails every receiver that does not drop the permit by itself, and stay off."""

import pytest

from engine.beam.commissioning import Pulser
from engine.beam.heartbeat_drill import (
    MARGIN_MS,
    NOT_VERIFIABLE,
    RECEIVER_DROP_MS,
    WAITED_NS,
    DrilledReceiver,
    HeartbeatDrill,
    NotVerifiableError,
    OwnInput,
    check_verifiable,
)
from engine.beam.paired import PairedBeamLine
from engine.beam.simulated import SimulatedBeamLine, SimulatedReceiver
from engine.beam.wire.supervised_line import STILL_NS
from engine.core.clock import NS_PER_MS, ManualClock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason
from tests.support.beam.stepped_line import MS, SteppedLine, World


class NoRule(SimulatedReceiver):
    """Keeps the permit, whatever the heartbeat does."""

    drop_ms = 10**9


class Slow(SimulatedReceiver):
    """Drops the permit, too late."""

    drop_ms = 300.0


class Recloses(SimulatedReceiver):
    """Takes the old permit again with the next heartbeat."""

    def is_closed(self):
        is_closed = super().is_closed()
        self._wants_off_first = False
        return is_closed


class Bounces(SimulatedReceiver):
    """Drops the permit, and closes again by itself 30 ms later."""

    dropped_ns = None

    def is_closed(self):
        is_closed = super().is_closed()
        if self._wants_off_first and self.dropped_ns is None:
            self.dropped_ns = self._clock.now_ns()
        return is_closed or (self.dropped_ns is not None and self._clock.now_ns() - self.dropped_ns > 30 * MS)


class Unwired(SimulatedReceiver):
    """Shows an open contact always."""

    def is_closed(self):
        return False


class Welded(SimulatedReceiver):
    """Shows a closed contact always."""

    def is_closed(self):
        return True


class Setup:
    """A line with its drill, on a clock that goes on only where somebody waits."""

    def __init__(self, line, clock, wait_ns=None):
        self.line, self.clock, self.wait_ns = line, clock, wait_ns or clock.advance_ns
        line.open()
        self.pulser = Pulser(line, clock, pulse_ms=200.0, wait_ns=self.wait_ns)
        self.drill = HeartbeatDrill(self.pulser, clock, self.wait_ns)

    def done(self, receiver):
        self.pulser.arm()
        try:
            return self.drill.open_ms(receiver)
        finally:
            self.pulser.hold()


def simulated(receiver_class=SimulatedReceiver):
    clock = ManualClock(MS)
    line = SimulatedBeamLine(clock)
    return Setup(line, clock), DrilledReceiver(name="it", line=line, second_input=receiver_class(line, clock))


def test_a_receiver_that_follows_the_rules_opens_within_its_bound_and_is_timed():
    setup, receiver = simulated()
    assert setup.done(receiver) == pytest.approx(RECEIVER_DROP_MS, abs=1.5)
    assert setup.drill.repeated_ms(receiver, 3) == pytest.approx([RECEIVER_DROP_MS] * 3, abs=1.5)
    assert not receiver.second_input.is_closed()


@pytest.mark.parametrize(
    ("receiver_class", "says"),
    [
        (NoRule, "it: the contact stayed closed for 500 ms after the heartbeat stood still"),
        (Recloses, "it: the contact closed again with the next heartbeats, though"),
        (Bounces, "it: the contact closed again by itself"),
        (Unwired, "it: the second input does not see the contact close"),
        (Welded, "it: the second input reads a closed contact though nothing is permitted"),
    ],
)
def test_each_fault_of_a_receiver_or_of_its_input_fails_and_is_named(receiver_class, says):
    setup, receiver = simulated(receiver_class)
    with pytest.raises(BeamLineError, match=f"^{says}"):
        setup.done(receiver)
    assert not setup.line.is_on()
    assert setup.line.still_since_ns is None


def test_a_receiver_that_drops_too_late_is_timed_and_refused_with_the_bound():
    setup, receiver = simulated(Slow)
    assert setup.done(receiver) == pytest.approx(300.0, abs=1.5)
    with pytest.raises(
        BeamLineError, match=r"opened 300 ms after the last heartbeat: must be at most 200 ms, and 50 ms"
    ):
        setup.drill.repeated_ms(receiver, 3)
    assert RECEIVER_DROP_MS + MARGIN_MS < 300.0 < WAITED_NS / NS_PER_MS


def test_without_a_second_input_nothing_is_permitted_and_it_is_stated_plainly():
    setup, receiver = simulated()
    blind = DrilledReceiver(name="modbus-tcp", line=receiver.line, second_input=None)
    for refused in (lambda: setup.done(blind), lambda: check_verifiable([receiver, blind])):
        with pytest.raises(NotVerifiableError, match=f"^modbus-tcp: {NOT_VERIFIABLE}$"):
            refused()
    with pytest.raises(NotVerifiableError, match=f"^{NOT_VERIFIABLE}$"):
        check_verifiable([])
    assert not any(edge.is_on for edge in setup.line.edges)


@pytest.mark.parametrize("faulty", [None, 0, 1], ids=["both good", "first", "second"])
def test_each_of_two_lines_is_drilled_by_itself(faulty):
    clock = ManualClock(MS)
    lines = [SimulatedBeamLine(clock) for _ in range(2)]
    receivers = [
        DrilledReceiver(
            name=f"line {number}",
            line=line,
            second_input=(NoRule if number == faulty else SimulatedReceiver)(line, clock),
        )
        for number, line in enumerate(lines)
    ]
    setup = Setup(PairedBeamLine(*lines), clock)
    for number, receiver in enumerate(receivers):
        if number == faulty:
            with pytest.raises(BeamLineError, match=f"^line {number}: the contact stayed closed"):
                setup.done(receiver)
        else:
            assert setup.done(receiver) == pytest.approx(RECEIVER_DROP_MS, abs=1.5)


# A wired line, millisecond by millisecond.


class Contact:
    """The far end of a scripted wire: a receiver by the rules, or without one of them."""

    def __init__(self, world, *, drops=True, waits_for_off=True):
        self.world, self.drops, self.waits_for_off = world, drops, waits_for_off
        self.looks = 0

    def is_closed(self):
        """Replay what was sent: the contact now."""
        closed = wants_off = False
        heartbeat, beaten_ns = None, -(10**12)
        for at_ns, is_on, beat in [*self.world.wire.commands, (self.world.clock.now_ns(), None, None)]:
            if self.drops and at_ns - beaten_ns > 200 * MS:
                wants_off |= closed and self.waits_for_off
                closed = False
            if is_on is None:
                break
            if beat != heartbeat:
                heartbeat, beaten_ns = beat, at_ns
            wants_off &= is_on
            closed = is_on and not wants_off
        return closed

    def look(self, within_s):
        assert within_s == self.world.line._times.answer_ns / 1e9
        self.looks += 1
        return self.is_closed()


def wired(**rules):
    """A wired line that reads its contact by itself, and is stepped whenever somebody waits."""
    world = World(answer_ms=0)
    contact = Contact(world, **rules)
    world.wire._at = lambda _now_ns: contact.is_closed()
    world.line = SteppedLine(world.wire, world.clock, look=contact.look)
    world.line.on_trouble = lambda reason, detail: world.troubles.append((world.now_ms, reason, detail))

    def wait_ns(span_ns):
        """The line's threads go on while it waits: one exchange every fifth millisecond."""
        for _ in range(max(-(-span_ns // MS), 1)):
            world.pass_ms(1)
            if world.now_ms % 5 == 0:
                world.line.exchange_once()

    setup = Setup(world.line, world.clock, wait_ns)
    return world, contact, setup, DrilledReceiver(name="it", line=world.line, second_input=OwnInput(world.line))


def test_a_wired_line_sends_nothing_until_the_contact_opens_and_then_the_old_permit():
    world, contact, setup, receiver = wired()
    taken_ms = setup.done(receiver)
    assert 200.0 <= taken_ms <= 212.0
    gaps_ms = [(b[0] - a[0]) // MS for a, b in zip(world.wire.commands, world.wire.commands[1:], strict=False)]
    longest = max(range(len(gaps_ms)), key=gaps_ms.__getitem__)
    before, after = world.wire.commands[longest], world.wire.commands[longest + 1]
    assert gaps_ms[longest] > 255
    assert before[1] is after[1] is True
    assert after[2] == before[2] + 1
    assert contact.looks > 40
    assert world.troubles == []
    setup.pulser.arm()
    assert world.wire.commands[-1][1] is False
    assert setup.done(receiver) == pytest.approx(taken_ms, abs=10.0)


@pytest.mark.parametrize(
    ("rules", "says"),
    [({"drops": False}, "stayed closed"), ({"waits_for_off": False}, "with the next heartbeats")],
    ids=["no rule", "recloses"],
)
def test_a_wired_receiver_without_a_rule_fails_and_is_commanded_off(rules, says):
    world, _contact, setup, receiver = wired(**rules)
    with pytest.raises(BeamLineError, match=says):
        setup.done(receiver)
    setup.wait_ns(30 * MS)
    assert world.wire.commands[-1][1] is False


def test_a_hold_ends_a_standstill_at_once_and_the_drill_does_not_take_it_for_the_receiver_s_rule():
    world, _contact, setup, receiver = wired(drops=False)
    setup.pulser.arm()
    started_ms = world.now_ms
    world.at(started_ms + 150, lambda: world.line.hold(HoldReason.ENGINE_STOPPED))
    with pytest.raises(BeamLineError, match="was commanded while its heartbeat should have stood still"):
        setup.drill.open_ms(receiver)
    off_ns = next(at_ns for at_ns, is_on, _ in reversed(world.wire.commands) if is_on is False)
    assert (off_ns - world.start_ns) // MS - started_ms <= 160


def test_a_line_that_is_held_cannot_be_made_to_stand_still_with_its_permit_on():
    world, _contact, setup, _receiver = wired()
    setup.pulser.arm()
    setup.pulser.permit()
    setup.pulser.hold()
    world.line.stand_still()
    setup.wait_ns(40 * MS)
    assert world.line.still_since_ns is None
    assert world.wire.commands[-1][1] is False
    world.line.repeat_permit()
    setup.wait_ns(40 * MS)
    assert world.wire.commands[-1][1] is False


def test_a_hold_between_beginning_a_repeated_permit_and_sending_it_is_seen():
    """M14 of the review of 2026-11-24: the permit of before was sent once more, for 20 ms."""
    world, _contact, setup, _receiver = wired()
    setup.pulser.arm()
    setup.pulser.permit()
    world.line.stand_still()
    setup.wait_ns(20 * MS)
    assert world.line.still_since_ns is not None
    world.line.repeat_permit()
    begin = world.line._supervisor.begin

    def interrupted(*, commands_on, now_ns):
        world.line._supervisor.begin = begin
        begin(commands_on=commands_on, now_ns=now_ns)
        setup.pulser.hold()

    world.line._supervisor.begin = interrupted
    commands = len(world.wire.commands)
    world.line.exchange_once()
    assert [is_on for _, is_on, _ in world.wire.commands[commands:]] == [False]


def test_a_standstill_that_no_one_ends_ends_by_itself_with_off():
    world, _contact, setup, _receiver = wired(drops=False)
    setup.pulser.arm()
    setup.pulser.permit()
    world.line.stand_still()
    asked_ns = world.clock.now_ns()
    setup.wait_ns(1_100 * MS)
    assert world.line.still_since_ns is None
    off_ns = next(at_ns for at_ns, is_on, _ in world.wire.commands if not is_on and at_ns > asked_ns)
    assert off_ns - asked_ns <= STILL_NS + 10 * MS


@pytest.mark.parametrize("fails", ["look", "repeat"])
def test_a_line_that_fails_while_it_stands_still_is_latched_and_the_drill_fails(fails):
    world, _contact, setup, receiver = wired()
    setup.pulser.arm()

    def broken(_within_s):
        raise OSError("the port is gone")

    if fails == "look":
        world.at(world.now_ms + 100, lambda: setattr(world.line, "_look", broken))
    else:
        world.at(world.now_ms + 290, lambda: setattr(world.wire, "is_refusing", True))
    with pytest.raises(BeamLineError):
        setup.drill.open_ms(receiver)
    assert [reason for _, reason, _ in world.troubles] == [HoldReason.BEAM_LINE_FAILED]
