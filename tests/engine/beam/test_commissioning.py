"""Pulses outside of any session: what they measure, and that they end off whatever happens."""

import itertools

import pytest

from engine.beam.commissioning import PULSE_BOUNDS_MS, READY_NS, Pulser
from engine.beam.simulated import SimulatedBeamLine
from engine.core.clock import ManualClock
from engine.core.errors import BeamLineError, InvalidValueError
from engine.core.gate_state import HoldReason
from tests.support.beam.stepped_line import MS, World


def _pulser(line, clock, wait_ns=None, pulse_ms=60.0):
    return Pulser(line, clock, pulse_ms=pulse_ms, wait_ns=wait_ns or clock.advance_ns)


def test_a_pulse_measures_the_edges_and_ends_off():
    world = World(answer_ms=4)
    world.line.open()
    steps = iter(range(10**9))

    def wait_ns(span_ns):
        """The line's threads go on while it waits: one exchange every fifth millisecond."""
        for _ in range(max(span_ns // MS, 1)):
            world.clock.advance_ns(MS)
            if next(steps) % 5 == 0:
                world.wire.answer_ms = 0
                world.line.exchange_once()

    pulser = _pulser(world.line, world.clock, wait_ns)
    pulser.arm()
    times = pulser.pulse()
    assert all(0 < on_ms <= 10 for on_ms in times.on_ms)
    assert 0 < times.held_ms <= 10
    assert 0 <= times.lapsed_ms <= 10
    commands = [is_on for _, is_on, _ in world.wire.commands]
    edges = [commands[0], *(b for a, b in itertools.pairwise(commands) if a is not b)]
    assert edges == [False, True, False, True, False]
    assert not world.line.is_on()


def test_a_line_that_never_reads_on_is_held_and_reported():
    class Dead(SimulatedBeamLine):
        holds = 0

        def is_on(self):
            return False

        def hold(self, reason):
            self.holds += 1
            super().hold(reason)

    clock = ManualClock(MS)
    line = Dead(clock)
    line.open()
    pulser = _pulser(line, clock)
    pulser.arm()
    with pytest.raises(BeamLineError, match="never read back on"):
        pulser.pulse()
    assert line.holds == 1
    assert not line._deadman.is_on(clock.now_ns())


def test_a_line_that_never_reads_off_is_held_and_reported():
    class Stuck(SimulatedBeamLine):
        def is_on(self):
            return True

    clock = ManualClock(MS)
    line = Stuck(clock)
    line.open()
    pulser = _pulser(line, clock)
    pulser.arm()
    with pytest.raises(BeamLineError, match="never read back off"):
        pulser.pulse()
    assert not line._deadman.is_on(clock.now_ns())


def test_a_line_that_does_not_let_itself_be_armed_is_given_up():
    class Unready(SimulatedBeamLine):
        def rearm(self):
            raise BeamLineError("not yet")

    clock = ManualClock(MS)
    with pytest.raises(BeamLineError, match="not yet"):
        _pulser(Unready(clock), clock).arm()
    assert clock.now_ns() >= 3_000 * MS


@pytest.mark.parametrize("pulse_ms", [0.0, 19.9, 200.1, -60.0, float("nan"), float("inf")])
def test_a_pulse_longer_than_any_lease_or_too_short_is_refused(pulse_ms):
    clock = ManualClock(MS)
    with pytest.raises(InvalidValueError, match=r"^pulse .* 20 to 200 ms"):
        _pulser(SimulatedBeamLine(clock), clock, pulse_ms=pulse_ms)


@pytest.mark.parametrize("pulse_ms", PULSE_BOUNDS_MS)
def test_the_bounds_belong_to_what_is_allowed(pulse_ms):
    clock = ManualClock(MS)
    _pulser(SimulatedBeamLine(clock), clock, pulse_ms=pulse_ms)


class Slow(SimulatedBeamLine):
    """Reads back each change a while later, and notes what it was sent."""

    lag_ns = 7 * MS

    def __init__(self, clock):
        super().__init__(clock)
        self.leases, self.holds = [], []
        self._changed_ns, self._was_on = -(10**12), False

    def permit(self, lease):
        self.leases.append(lease)
        super().permit(lease)

    def hold(self, reason):
        self.holds.append((self._clock.now_ns(), reason))
        super().hold(reason)

    def is_on(self):
        now_on, now_ns = super().is_on(), self._clock.now_ns()
        if now_on is not self._was_on:
            self._was_on, self._changed_ns = now_on, now_ns
        return now_on if now_ns - self._changed_ns >= self.lag_ns else not now_on


def test_what_is_measured_is_how_long_the_line_took_to_follow_each_way():
    clock = ManualClock(5_000 * MS)
    line = Slow(clock)
    line.open()
    pulser = _pulser(line, clock, pulse_ms=50.0)
    pulser.arm()
    for turn in range(2):
        times = pulser.pulse()
        assert times.on_ms == (7.0, 7.0)
        assert (times.held_ms, times.lapsed_ms) == (7.0, 7.0)
        clock.advance_ns(MS)
        assert [lease.sequence for lease in line.leases] == list(range(1, 2 * turn + 3))
    assert all(lease.expires_ns - lease.granted_ns == 50 * MS for lease in line.leases)
    assert {reason for _, reason in line.holds} == {HoldReason.OPERATOR_HOLD}
    assert not line._deadman.is_on(clock.now_ns())


@pytest.mark.parametrize(("ready_ns", "is_armed"), [(READY_NS, True), (READY_NS + 2 * MS, False)])
def test_it_is_armed_as_soon_as_it_lets_itself_be_for_three_seconds(ready_ns, is_armed):
    clock = ManualClock(5_000 * MS)
    asked = []

    class Waking(SimulatedBeamLine):
        def rearm(self):
            asked.append(clock.now_ns())
            if clock.now_ns() - 5_000 * MS < ready_ns:
                raise BeamLineError("not yet")

    pulser = _pulser(Waking(clock), clock)
    if is_armed:
        pulser.arm()
    else:
        with pytest.raises(BeamLineError, match="not yet"):
            pulser.arm()
    assert clock.now_ns() == 5_000 * MS + READY_NS
    assert [later - before for before, later in itertools.pairwise(asked)] == [MS] * 3_000


@pytest.mark.parametrize("stuck", [True, False])
def test_a_line_that_never_follows_is_waited_for_as_long_as_the_pulse_lasts_or_a_second(stuck):
    clock = ManualClock(5_000 * MS)

    class Stuck(SimulatedBeamLine):
        def is_on(self):
            return stuck

    line = Stuck(clock)
    line.open()
    pulser = _pulser(line, clock, pulse_ms=60.0)
    pulser.arm()
    began_ns = clock.now_ns()
    with pytest.raises(BeamLineError, match=f"^the line was never read back {'off' if stuck else 'on'}$"):
        pulser.pulse()
    assert clock.now_ns() - began_ns == (1_000 * MS if stuck else 60 * MS)


@pytest.mark.parametrize("is_latched", [True, False])
def test_a_line_states_whether_it_refuses_a_permit(is_latched):
    clock = ManualClock(5_000 * MS)
    line = Slow(clock)
    line.open()
    pulser = _pulser(line, clock)
    pulser.arm()
    if is_latched:
        line.hold(HoldReason.WATCHDOG)
        clock.advance_ns(MS)
    assert pulser.is_refused() is is_latched
    (lease,) = line.leases
    assert (lease.granted_ns, lease.expires_ns) == (clock.now_ns(), clock.now_ns() + 60 * MS)
