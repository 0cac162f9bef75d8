"""Beam lines with one fault each, on a clock that goes on only where somebody waits."""

from contextlib import contextmanager

from engine.beam.heartbeat_drill import DrilledReceiver
from engine.beam.simulated import SimulatedBeamLine, SimulatedReceiver
from engine.core.clock import NS_PER_MS
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason
from engine.qa.inputs import BeamInput
from lab.virtual_qa import StandingTime


class Line(SimulatedBeamLine):
    """A line that notes what it was sent last, and whether it is open."""

    def __init__(self, clock):
        super().__init__(clock)
        self.now_ns = clock.now_ns
        self.calls = []

    def open(self):
        self.calls.append("open")
        super().open()

    def rearm(self):
        self.calls.append("rearm")
        super().rearm()

    def permit(self, lease):
        self.calls.append("permit")
        super().permit(lease)

    def hold(self, reason):
        self.calls.append("hold")
        super().hold(reason)

    def close(self):
        self.calls.append("close")
        super().close()


class SlowToHold(Line):
    """Goes off 130 ms after it was asked to; its lease is no slower."""

    late_ns = 130 * NS_PER_MS

    def __init__(self, clock):
        super().__init__(clock)
        self.held_at_ns = None
        self.ends_ns = 0

    def permit(self, lease):
        super().permit(lease)
        self.held_at_ns, self.ends_ns = None, lease.expires_ns

    def hold(self, reason):
        if self.is_on() and self.held_at_ns is None:
            self.held_at_ns = self.now_ns()
        super().hold(reason)

    def is_on(self):
        lingers = self.held_at_ns is not None and self.now_ns() < min(self.held_at_ns + self.late_ns, self.ends_ns)
        return super().is_on() or lingers


class SlowOnce(SlowToHold):
    """Is slow the first time, and prompt ever after."""

    def hold(self, reason):
        super().hold(reason)
        if self.calls.count("permit") > 1:
            self.held_at_ns = None


class DeafToHolds(SlowToHold):
    """Goes off with its lease alone."""

    late_ns = 10**12


class DropsEarly(Line):
    """Goes off by itself 40 ms after a permit: safe, and no proof of a watchdog."""

    began_ns = 0

    def permit(self, lease):
        super().permit(lease)
        self.began_ns = lease.granted_ns

    def is_on(self):
        return super().is_on() and self.now_ns() < self.began_ns + 40 * NS_PER_MS


class DeafToLeases(Line):
    """Stays on until it is held, whatever its lease says."""

    is_stuck = False

    def permit(self, lease):
        super().permit(lease)
        self.is_stuck = True

    def hold(self, reason):
        self.is_stuck = False
        super().hold(reason)

    def is_on(self):
        return self.is_stuck


class SlowLeases(DeafToLeases):
    """Goes off 130 ms after its lease has ended."""

    ends_ns = 0

    def permit(self, lease):
        super().permit(lease)
        self.ends_ns = lease.expires_ns

    def is_on(self):
        return self.is_stuck and self.now_ns() < self.ends_ns + 130 * NS_PER_MS


class NeverLatches(Line):
    """Takes a fault for a hold."""

    def hold(self, _reason):
        super().hold(HoldReason.OPERATOR_HOLD)


class OnByItself(Line):
    """Goes on again 30 ms after a fault."""

    fault_ns = None

    def hold(self, reason):
        if reason.is_fault:
            self.fault_ns = self.now_ns()
        super().hold(reason)

    def rearm(self):
        self.fault_ns = None
        super().rearm()

    def is_on(self):
        is_back = self.fault_ns is not None and self.now_ns() > self.fault_ns + 30 * NS_PER_MS
        return super().is_on() or (is_back and "close" not in self.calls)


class OnWhenArmed(Line):
    """Takes being armed, after a fault, for a permit."""

    is_back = had_fault = False

    def hold(self, reason):
        self.had_fault |= reason.is_fault
        self.is_back = False
        super().hold(reason)

    def rearm(self):
        self.is_back = self.had_fault
        super().rearm()

    def is_on(self):
        return super().is_on() or self.is_back


class NeverOn(Line):
    """Accepts every permit and does nothing."""

    def is_on(self):
        return False


class Dead(Line):
    """Does not answer."""

    def open(self):
        msg = "nobody answers"
        raise BeamLineError(msg)


class DiesOnTheWay(Line):
    """Answers for a while."""

    def permit(self, lease):
        if len(self.calls) > 20:
            msg = "the cable is out"
            raise BeamLineError(msg)
        super().permit(lease)

    def rearm(self):
        if len(self.calls) > 20:
            msg = "the cable is out"
            raise BeamLineError(msg)
        super().rearm()


class NoHeartbeatRule(SimulatedReceiver):
    """Keeps the permit, whatever the heartbeat does."""

    drop_ms = 10**9


class SlowReceiver(SimulatedReceiver):
    """Drops the permit 300 ms after the last heartbeat."""

    drop_ms = 300.0


def beam_of(line_class=Line, *, repeats=5, has_watchdog=True, pulse_ms=200.0, receiver_class=SimulatedReceiver):
    """A line with its receiver; ``receiver_class`` None leaves it without a second input."""
    time = StandingTime()
    line = line_class(time.clock)
    second_input = None if receiver_class is None else receiver_class(line, time.clock)

    @contextmanager
    def nobody_watches(_watchdog):
        yield

    return BeamInput(
        line=line,
        clock=time.clock,
        wait_ns=time.wait_ns,
        repeats=repeats,
        pulse_ms=pulse_ms,
        watched=time.watched if has_watchdog else nobody_watches,
        receivers=(DrilledReceiver(name="its line", line=line, second_input=second_input),),
    )
