"""Two lines that both have to agree: either's no is enough, and neither is forgotten."""

import pytest

from engine.beam.paired import PairedBeamLine
from engine.beam.simulated import SimulatedBeamLine
from engine.core.clock import ManualClock
from engine.core.errors import BeamLineError, BeamLineMismatchError, LeaseLapsedError
from engine.core.gate_state import HoldReason, Lease
from tests.support.beam.stepped_line import MS, World


class Line(SimulatedBeamLine):
    """The simulated line, with a mind of its own where it is asked to have one."""

    def __init__(self, clock):
        super().__init__(clock)
        self.reads: bool | None = None
        self.is_slow = self.was_closed = False
        self.fails_at: str | None = None
        self.holds: list[HoldReason] = []

    def _fail(self, at):
        if self.fails_at == at:
            raise BeamLineError(f"no {at}")

    def open(self):
        self._fail("open")
        super().open()

    def rearm(self):
        self._fail("rearm")
        super().rearm()

    def permit(self, lease):
        self._fail("permit")
        super().permit(lease)

    def hold(self, reason):
        self.holds.append(reason)
        super().hold(reason)
        self._fail("hold")

    def is_on(self):
        self._fail("reading")
        return super().is_on() if self.reads is None else self.reads

    @property
    def is_settling(self):
        return self.is_slow

    def close(self):
        self.was_closed = True
        super().close()
        self._fail("close")


class Pair:
    def __init__(self):
        self.clock = ManualClock(100 * MS)
        self.lines = (Line(self.clock), Line(self.clock))
        self.pair = PairedBeamLine(*self.lines)
        self.sequence = 0

    def armed(self):
        self.pair.open()
        self.pair.rearm()
        return self

    def permit(self):
        self.clock.advance_ns(MS)
        now_ns = self.clock.now_ns()
        self.sequence += 1
        self.pair.permit(Lease(granted_ns=now_ns, expires_ns=now_ns + 80 * MS, sequence=self.sequence))

    def are_latched(self):
        return [line._deadman._is_latched for line in self.lines]


def test_a_pair_is_on_when_both_are_and_off_when_held_or_lapsed():
    held = Pair().armed()
    assert not held.pair.is_on()
    held.permit()
    assert [line.is_on() for line in held.lines] == [True, True]
    assert held.pair.is_on()
    held.pair.hold(HoldReason.OUTSIDE_WINDOW)
    assert not held.pair.is_on()
    held.permit()
    held.clock.advance_ns(80 * MS)
    assert not held.pair.is_on()
    with pytest.raises(LeaseLapsedError):
        held.permit()
    assert held.are_latched() == [False, False], "a hold, and no fault"
    held.permit()
    assert held.pair.is_on()


@pytest.mark.parametrize("which", [0, 1])
def test_what_either_refuses_neither_does_and_both_are_latched(which):
    held = Pair().armed()
    held.lines[which].fails_at = "permit"
    with pytest.raises(BeamLineError, match="no permit"):
        held.permit()
    assert [line.is_on() for line in held.lines] == [False, False]
    assert held.are_latched() == [True, True]


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("is_permitted", [True, False])
def test_lines_that_disagree_are_held_and_latched_both(which, is_permitted):
    held = Pair().armed()
    if is_permitted:
        held.permit()
    held.lines[which].reads = not is_permitted
    on, off = ("first", "second") if (which == 0) is not is_permitted else ("second", "first")
    with pytest.raises(BeamLineMismatchError, match=f"disagree: the {on} reads on, the {off} off"):
        held.pair.is_on()
    assert held.are_latched() == [True, True]


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("slow", [0, 1])
def test_while_either_settles_a_pair_is_not_yet_on_and_then_still_on(which, slow):
    held = Pair().armed()
    held.lines[slow].is_slow = True
    held.permit()
    held.lines[which].reads = False
    assert (held.pair.is_on(), held.pair.is_settling) == (False, True)
    held.pair.hold(HoldReason.OUTSIDE_WINDOW)
    held.lines[which].reads = True
    assert held.pair.is_on()
    assert held.are_latched() == [False, False]
    held.lines[slow].is_slow = False
    with pytest.raises(BeamLineMismatchError):
        held.pair.is_on()


@pytest.mark.parametrize("which", [0, 1])
def test_a_line_that_does_not_answer_takes_the_other_with_it(which):
    held = Pair().armed()
    held.permit()
    held.lines[which].fails_at = "reading"
    with pytest.raises(BeamLineError, match="no reading"):
        held.pair.is_on()
    assert held.are_latched() == [True, True]


@pytest.mark.parametrize("which", [0, 1])
def test_a_hold_reaches_the_second_though_the_first_fails_and_raises_nothing(which):
    held = Pair().armed()
    held.permit()
    held.lines[which].fails_at = "hold"
    held.pair.hold(HoldReason.WATCHDOG)
    assert held.are_latched() == [True, True]


@pytest.mark.parametrize("which", [0, 1])
def test_what_a_line_finds_out_by_itself_holds_the_other_at_once_and_is_passed_on(which):
    held = Pair().armed()
    held.permit()
    received = []
    held.pair.on_trouble = lambda reason, detail: received.append((reason, detail))
    held.lines[which].on_trouble(HoldReason.BEAM_LINE_MISMATCH, "stuck")
    assert held.lines[1 - which]._deadman._is_latched
    assert received == [(HoldReason.BEAM_LINE_MISMATCH, "stuck")]


def test_a_pair_opens_both_or_leaves_neither_open():
    held = Pair()
    held.lines[1].fails_at = "open"
    with pytest.raises(BeamLineError):
        held.pair.open()
    assert held.lines[0].was_closed


@pytest.mark.parametrize("which", [0, 1])
def test_a_pair_is_armed_whole_or_not_at_all(which):
    held = Pair()
    held.pair.open()
    held.lines[which].fails_at = "rearm"
    with pytest.raises(BeamLineError, match="no rearm"):
        held.pair.rearm()
    assert held.are_latched() == [True, True]


def test_closing_holds_both_before_it_closes_either_and_closes_the_second_whatever_the_first_does():
    held = Pair().armed()
    held.permit()
    held.lines[0].fails_at = "close"
    with pytest.raises(BeamLineError):
        held.pair.close()
    assert held.lines[1].holds[0] is HoldReason.ENGINE_STOPPED
    assert held.lines[1].was_closed


def test_two_wired_lines_fall_together_within_200_ms_of_the_trouble_of_one():
    world = World().opened()
    other = Line(world.clock)
    other.open()
    pair = PairedBeamLine(world.line, other)
    pair.rearm()

    def permit():
        try:
            now_ns = world.clock.now_ns()
            pair.permit(Lease(granted_ns=now_ns, expires_ns=now_ns + 200 * MS, sequence=now_ns))
        except BeamLineError:
            return

    for ms in range(200, 900, 33):
        world.at(ms, permit)
    fell = []
    world.at(500, lambda: setattr(world.wire, "is_silent", True))
    for ms in range(501, 900):
        world.at(ms, lambda ms=ms: fell.append(ms) if other._deadman._is_latched else None)
    world.run(to_ms=499)
    assert (world.line.is_on(), other.is_on()) == (True, True)
    world.run(to_ms=900)
    assert 500 < fell[0] <= 700


@pytest.mark.parametrize("settles", [[True, False], [False, True]], ids=["until it is read", "since it was read"])
def test_a_line_that_settles_before_or_behind_its_reading_is_still_on_its_way(settles):
    """Its own thread goes on meanwhile: whichever of the two looks finds it on its way, it is no disagreement."""
    held = Pair().armed()
    held.permit()
    held.lines[1].reads = False
    looks = iter(settles)
    held.lines[0].__class__ = type("Changing", (Line,), {"is_settling": property(lambda _line: next(looks))})
    assert held.pair.is_on() is False
    assert held.are_latched() == [False, False]


def test_closing_holds_both_as_stopped_and_closes_the_second_whatever_the_first_does():
    held = Pair().armed()
    held.lines[0].fails_at = "close"
    with pytest.raises(BeamLineError, match="no close"):
        held.pair.close()
    assert [line.was_closed for line in held.lines] == [True, True]
    assert [line.holds[0] for line in held.lines] == [HoldReason.ENGINE_STOPPED] * 2


@pytest.mark.parametrize("which", [0, 1])
def test_what_one_of_them_finds_holds_the_other_for_that_reason_and_is_reported_with_its_words(which):
    held, received = Pair().armed(), []
    held.pair.on_trouble = lambda reason, detail: received.append((reason, detail))
    held.lines[which].on_trouble(HoldReason.BEAM_LINE_FAILED, "silent")
    assert received == [(HoldReason.BEAM_LINE_FAILED, "silent")]
    assert held.lines[1 - which].holds[-1] is HoldReason.BEAM_LINE_FAILED
    assert held.lines[which].holds == []
    held.lines[1 - which].fails_at = "hold"
    held.lines[which].on_trouble(HoldReason.BEAM_LINE_MISMATCH, "stuck")
    assert received[-1] == (HoldReason.BEAM_LINE_MISMATCH, "stuck")
