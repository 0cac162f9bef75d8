"""The fail-safe drill on the site's beam line, with the beam made safe: the line must go off after every failure.

Each round turns the line on and off in five ways: by a hold, by a lease that is not renewed, by a fault, which must
latch, by the watchdog of an engine that stops deciding, and by a heartbeat that stands still, which the receiver must
detect. On every way out the line is held before it is closed.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from engine.beam.commissioning import POLL_NS, Pulser
from engine.beam.heartbeat_drill import HeartbeatDrill, NotVerifiableError, check_verifiable
from engine.control.watchdog import Watchdog
from engine.core.clock import NS_PER_MS
from engine.core.errors import BeamLineError, TidegateError
from engine.core.gate_state import HoldReason
from engine.qa.bounds import not_measured
from engine.qa.inputs import BeamInput
from engine.qa.results import QaFigure, QaNeed

WATCHED_NS = 60 * NS_PER_MS
"""How long a latched line is watched to see that it stays off."""

BEAM_NS = 1000 * NS_PER_MS
"""How long the accelerator is waited for: to deliver once permitted, and to stop once held."""

DRILLS = ("hold", "lease", "fault", "watchdog", "heartbeat")


@dataclass(slots=True, kw_only=True)
class _Log:
    """Measured times [ms], and the first error of each drill."""

    on_ms: list[float] = field(default_factory=list)
    off_ms: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in DRILLS})
    beam_off_ms: list[float] = field(default_factory=list)
    errors_by_drill: dict[str, str] = field(default_factory=dict)
    errors: int = 0


def drill_line(beam: BeamInput, on_pulse: Callable[[int], None]) -> list[QaFigure]:
    """Open the line, run every drill, hold and close the line.

    Parameters
    ----------
    on_pulse
        Called with the number of drills done; an exception from it ends the run, after the line is held and closed.
    """
    log = _Log()
    drill = _Drill(beam, log)
    try:
        beam.line.open()
        drill.rounds(on_pulse)
    except TidegateError as error:
        if not log.on_ms:
            return not_measured(QaNeed.BEAM, str(error))
        log.errors += 1
        log.errors_by_drill.setdefault("line", str(error))
    finally:
        beam.line.hold(HoldReason.ENGINE_STOPPED)
        beam.line.close()
    return _figures(log, beam.repeats)


class _Drill:
    """Runs the rounds of drills on one open line."""

    def __init__(self, beam: BeamInput, log: _Log) -> None:
        self._given, self._log = beam, log
        self._line, self._clock = beam.line, beam.clock
        self._pulser = Pulser(beam.line, beam.clock, pulse_ms=beam.pulse_ms, wait_ns=beam.wait_ns)
        self._expects_beam = True
        self._heartbeat_drill = HeartbeatDrill(self._pulser, beam.clock, beam.wait_ns)

    def rounds(self, on_pulse: Callable[[int], None]) -> None:
        """Do every drill ``repeats`` times; record a failure, arm the line again and continue."""
        drills = {
            "hold": self._hold,
            "lease": self._lease,
            "fault": self._fault,
            "watchdog": self._watchdog,
            "heartbeat": self._heartbeat,
        }
        done = 0
        on_pulse(done)
        self._pulser.arm()
        for _ in range(self._given.repeats):
            for name, run_drill in drills.items():
                self._once(name, run_drill)
                done += 1
                on_pulse(done)

    def _once(self, name: str, run_drill: Callable[[], float]) -> None:
        try:
            self._log.off_ms[name].append(run_drill())
        except NotVerifiableError as error:  # no failure of the line, and no pass
            self._log.errors_by_drill.setdefault(name, str(error))
        except BeamLineError as error:
            self._line.hold(HoldReason.OPERATOR_HOLD)
            self._log.errors += 1
            self._log.errors_by_drill.setdefault(name, str(error))
            self._pulser.arm()
        finally:
            self._line.hold(HoldReason.OPERATOR_HOLD)
        self._given.wait_ns(POLL_NS)  # the line refuses a permit with the same time stamp as a hold

    def _permit(self) -> int:
        """Turn the line on and return the end of its lease [ns]."""
        on_ms, ends_ns = self._pulser.permit()
        self._log.on_ms.append(on_ms)
        return ends_ns

    def _hold(self) -> float:
        self._permit()
        has_beam = self._comes_on()
        held_ns = self._clock.now_ns()
        self._line.hold(HoldReason.OPERATOR_HOLD)
        off_ms = self._pulser.await_off(held_ns)
        if has_beam:
            self._log.beam_off_ms.append(self._beam_off_ms(held_ns))
        return off_ms

    def _comes_on(self) -> bool:
        """Whether the accelerator delivers; waited for once, while the permit is renewed, then no longer expected."""
        read = self._given.beam_on
        if read is None or not self._expects_beam:
            return False
        until_ns = self._clock.now_ns() + BEAM_NS
        while not read():
            if self._clock.now_ns() >= until_ns:
                self._expects_beam = False
                return False
            self._pulser.renew()
            self._given.wait_ns(POLL_NS)
        self._pulser.renew()
        return True

    def _beam_off_ms(self, held_ns: int) -> float:
        """Wait for the accelerator's signal to go off; return the time since the hold [ms]."""
        read = self._given.beam_on
        while read is not None and read() is not False:
            if self._clock.now_ns() >= held_ns + BEAM_NS:
                msg = f"the accelerator reports beam on {BEAM_NS // NS_PER_MS} ms after the hold"
                raise BeamLineError(msg)
            self._given.wait_ns(POLL_NS)
        return (self._clock.now_ns() - held_ns) / NS_PER_MS

    def _lease(self) -> float:
        ends_ns = self._permit()
        self._given.wait_ns(max(ends_ns - self._clock.now_ns(), 0))
        return self._pulser.await_off(ends_ns)

    def _fault(self) -> float:
        self._permit()
        held_ns = self._clock.now_ns()
        self._line.hold(HoldReason.ENGINE_FAILED)
        off_ms = self._pulser.await_off(held_ns)
        self._expect_latched()
        return off_ms

    def _watchdog(self) -> float:
        """Feed an armed watchdog once; return how long after its deadline the line was off [ms]."""
        deadline_ns = int(self._given.watchdog_ms * NS_PER_MS)
        watchdog = Watchdog(beam=self._line, clock=self._clock, deadline_ns=deadline_ns)
        ends_ns = self._permit()
        decided_ns = self._clock.now_ns()
        watchdog.feed(decided_ns, is_armed=True)
        with self._given.watched(watchdog):
            self._pulser.await_off(decided_ns)
            off_ns = self._clock.now_ns()
        if off_ns >= ends_ns or not watchdog.has_fired:
            msg = "the lease ended, or the line was off, before the watchdog held it"
            raise BeamLineError(msg)
        self._expect_latched()
        return (off_ns - decided_ns - deadline_ns) / NS_PER_MS

    def _heartbeat(self) -> float:
        """Let the heartbeat of each receiver stand still in turn; return the slowest opening of a contact [ms]."""
        check_verifiable(self._given.receivers)
        open_ms = []
        for receiver in self._given.receivers:
            open_ms.append(self._heartbeat_drill.open_ms(receiver))
            self._line.hold(HoldReason.OPERATOR_HOLD)
            self._pulser.arm()
        return max(open_ms)

    def _expect_latched(self) -> None:
        """Raise BeamLineError unless permits are refused until the line is armed, and arming alone leaves it off."""
        self._given.wait_ns(POLL_NS)  # a permit with the hold's time stamp would be refused anyway
        if not self._pulser.is_refused():
            msg = "a permit after a fault was not refused"
            raise BeamLineError(msg)
        self._expect_off("went on by itself after a fault")
        self._pulser.arm()
        self._expect_off("went on when armed, without a permit")

    def _expect_off(self, failure: str) -> None:
        until_ns = self._clock.now_ns() + WATCHED_NS
        while self._clock.now_ns() < until_ns:
            if self._line.is_on():
                msg = f"the line {failure}"
                raise BeamLineError(msg)
            self._given.wait_ns(POLL_NS)


def _figures(log: _Log, repeats: int) -> list[QaFigure]:
    held_ms = [*log.off_ms["hold"], *log.off_ms["fault"]]
    messages = "; ".join(dict.fromkeys(log.errors_by_drill.values()))
    return [
        _percentile("beam_readback_on_ms", log.on_ms),
        _percentile("beam_readback_off_ms", held_ms),
        QaFigure(code="beam_readback_errors", value=float(log.errors), detail=messages),
        *(_slowest(name, log, repeats) for name in DRILLS),
        *_beam_off(log),
    ]


def _beam_off(log: _Log) -> list[QaFigure]:
    """Slowest time from a hold to the accelerator's beam off [ms]; no figure where it never delivered."""
    taken_ms = log.beam_off_ms
    if not taken_ms:
        return []
    detail = f"{len(taken_ms)} times, median {np.median(taken_ms):.1f} ms"
    return [QaFigure(code="hold_to_beam_off_ms", value=max(taken_ms), detail=detail)]


def _percentile(code: str, taken_ms: list[float]) -> QaFigure:
    if not taken_ms:
        return QaFigure(code=code, value=None, detail="the line never changed its state")
    return QaFigure(code=code, value=float(np.percentile(taken_ms, 99.0)), detail=f"{len(taken_ms)} times")


def _slowest(name: str, log: _Log, repeats: int) -> QaFigure:
    """Longest time of a drill [ms]; no value if any repetition failed."""
    code, taken_ms = f"fail_safe_{name}_ms", log.off_ms[name]
    if name in log.errors_by_drill or len(taken_ms) < repeats:
        error = log.errors_by_drill.get(name) or log.errors_by_drill.get("line", "")
        return QaFigure(code=code, value=None, detail=f"{len(taken_ms)} of {repeats} succeeded: {error}")
    return QaFigure(code=code, value=max(taken_ms), detail=f"{repeats} times, median {np.median(taken_ms):.1f} ms")
