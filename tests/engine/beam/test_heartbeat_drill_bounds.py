"""How long each step of the heartbeat's drill waits, and what it says where nothing happened in that time."""

import pytest

from engine.beam.commissioning import POLL_NS, Pulser
from engine.beam.heartbeat_drill import (
    LEAST_REPEATS,
    MARGIN_MS,
    RECEIVER_DROP_MS,
    STOPPED_NS,
    WAITED_NS,
    WATCHED_NS,
    DrilledReceiver,
    HeartbeatDrill,
)
from engine.beam.simulated import SimulatedBeamLine, SimulatedReceiver
from engine.core.clock import NS_PER_MS, ManualClock
from engine.core.errors import BeamLineError
from tests.support.beam.stepped_line import MS, World


class NoRule(SimulatedReceiver):
    """Keeps the permit, whatever the heartbeat does."""

    drop_ms = 10**9


class AtTheBound(SimulatedReceiver):
    """Drops the permit as late as it may."""

    drop_ms = RECEIVER_DROP_MS + MARGIN_MS


class Unwired(SimulatedReceiver):
    """Shows an open contact always."""

    def is_closed(self):
        return False


class Sluggish(SimulatedReceiver):
    """Closes 20 ms after the permit."""

    permitted_ns = None

    def is_closed(self):
        is_closed = super().is_closed()
        if is_closed and self.permitted_ns is None:
            self.permitted_ns = self._clock.now_ns()
        return is_closed and self._clock.now_ns() - self.permitted_ns >= 20 * MS


class Running(SimulatedBeamLine):
    """Sends its heartbeat on, although it was to stand still."""

    def stand_still(self):
        """Do nothing."""


class Silent(SimulatedBeamLine):
    """Gets no answer to the heartbeats after the standstill."""

    repeats = 0


class Drilled:
    """A drill on a clock that goes on only where it waits."""

    def __init__(self, line_class=SimulatedBeamLine, receiver_class=SimulatedReceiver):
        self.clock = ManualClock(MS)
        line = line_class(self.clock)
        line.open()
        self.pulser = Pulser(line, self.clock, pulse_ms=200.0, wait_ns=self.clock.advance_ns)
        self.drill = HeartbeatDrill(self.pulser, self.clock, self.clock.advance_ns)
        self.receiver = DrilledReceiver(name="it", line=line, second_input=receiver_class(line, self.clock))

    def open_ms(self):
        """Return what the drill returns or raises, and how long it took from the permit on [ns]."""
        self.pulser.arm()
        began_ns = self.clock.now_ns() + POLL_NS
        try:
            found = self.drill.open_ms(self.receiver)
        except BeamLineError as error:
            found = str(error)
        return found, self.clock.now_ns() - began_ns


def test_a_contact_that_opens_at_the_bound_itself_is_in_time():
    drilled = Drilled(receiver_class=AtTheBound)
    assert drilled.drill.repeated_ms(drilled.receiver, 1) == [AtTheBound.drop_ms]


def test_a_contact_that_closes_after_a_while_is_waited_for():
    found, _ = Drilled(receiver_class=Sluggish).open_ms()
    assert found == pytest.approx(RECEIVER_DROP_MS, abs=1.5)


def test_an_open_contact_is_watched_for_its_time_without_heartbeats_and_again_with_them():
    found, taken_ns = Drilled().open_ms()
    assert taken_ns == found * NS_PER_MS + 2 * WATCHED_NS


@pytest.mark.parametrize(
    ("classes", "says", "waited_ns"),
    [
        (
            {"receiver_class": Unwired},
            "it: the second input does not see the contact close: is it wired to it?",
            WAITED_NS,
        ),
        (
            {"receiver_class": NoRule},
            "it: the contact stayed closed for 500 ms after the heartbeat stood still",
            WAITED_NS,
        ),
        ({"line_class": Running}, "it: the line did not stand still with the permit on", STOPPED_NS),
        (
            {"line_class": Silent},
            f"it: no {LEAST_REPEATS} good answers to the heartbeats after the standstill",
            int(RECEIVER_DROP_MS * NS_PER_MS) + WATCHED_NS + WAITED_NS,
        ),
    ],
    ids=["unwired", "no rule", "running", "silent"],
)
def test_what_does_not_happen_is_waited_for_its_time_and_named(classes, says, waited_ns):
    assert Drilled(**classes).open_ms() == (says, waited_ns)


def still_world():
    """Return a wired line that stands still with its permit on; its lease ends 40 ms later."""
    world = World(answer_ms=0)
    world.opened()
    world.at(100, lambda: world.permit(length_ms=60))
    world.run(to_ms=120)
    world.line.stand_still()
    world.run(to_ms=125)
    assert world.line.still_since_ns is not None
    return world


def test_a_lease_that_ends_during_a_standstill_is_no_fault_of_the_line():
    world = still_world()
    world.run(to_ms=600)
    assert world.line.still_since_ns is not None
    assert world.troubles == []


def test_each_answered_heartbeat_after_a_standstill_is_counted_once():
    world = still_world()
    before = len(world.wire.commands)
    world.line.repeat_permit()
    world.run(to_ms=200)
    sent = len(world.wire.commands) - before
    assert sent > 2
    assert world.line.repeats in {sent, sent - 1}
