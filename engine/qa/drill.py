"""The fail-safe drill, on the site's own line with the beam made safe: does it go off by itself, whatever fails.

Each round turns the line on and takes it off in four ways: by a hold, by a lease that nobody renews, by a fault, which
has to latch, and by the watchdog of an engine that stops deciding. Whatever happens the line is held, last of all.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from engine.beam.pulse import POLL_NS, Pulser
from engine.clock import NS_PER_MS
from engine.errors import BeamLineError, TidegateError
from engine.permits import HoldReason
from engine.qa.inputs import BeamInput
from engine.qa.results import QaFigure, QaNeed
from engine.qa.unmeasured import not_measured
from engine.watchdog import Watchdog

WATCHED_NS = 60 * NS_PER_MS
"""How long a line that has latched is watched for going on again by itself."""

DRILLS = ("hold", "lease", "fault", "watchdog")


@dataclass(slots=True, kw_only=True)
class _Log:
    """What was seen so far [ms], and what went wrong."""

    on_ms: list[float] = field(default_factory=list)
    off_ms: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in DRILLS})
    wrong: dict[str, str] = field(default_factory=dict)
    errors: int = 0


def drill_line(given: BeamInput, on_pulse: Callable[[int], None]) -> list[QaFigure]:
    """Open the line, drill it, and close it.

    Parameters
    ----------
    on_pulse
        Called with the number of drills done; what it raises ends the drill, the line held and closed.
    """
    log = _Log()
    drill = _Drill(given, log)
    try:
        given.line.open()
        drill.rounds(on_pulse)
    except TidegateError as error:
        if not log.on_ms:
            return not_measured(QaNeed.BEAM, str(error))
        log.errors += 1
        log.wrong.setdefault("line", str(error))
    finally:
        given.line.hold(HoldReason.ENGINE_STOPPED)
        given.line.close()
    return _figures(log, given.repeats)


class _Drill:
    """One line's rounds."""

    def __init__(self, given: BeamInput, log: _Log) -> None:
        self._given, self._log = given, log
        self._line, self._clock = given.line, given.clock
        self._pulser = Pulser(given.line, given.clock, pulse_ms=given.pulse_ms, wait_ns=given.wait_ns)

    def rounds(self, on_pulse: Callable[[int], None]) -> None:
        """Do every drill as often as asked; a failed one is noted, and the next is done on a line armed anew."""
        ways = {"hold": self._hold, "lease": self._lease, "fault": self._fault, "watchdog": self._watchdog}
        done = 0
        on_pulse(done)
        self._pulser.arm()
        for _ in range(self._given.repeats):
            for name, way in ways.items():
                self._once(name, way)
                done += 1
                on_pulse(done)

    def _once(self, name: str, way: Callable[[], float]) -> None:
        try:
            self._log.off_ms[name].append(way())
        except BeamLineError as error:
            self._line.hold(HoldReason.OPERATOR_HOLD)
            self._log.errors += 1
            self._log.wrong.setdefault(name, str(error))
            self._pulser.arm()
        finally:
            self._line.hold(HoldReason.OPERATOR_HOLD)
        self._given.wait_ns(POLL_NS)  # a permit decided in the same instant as a hold is refused

    def _permit(self) -> int:
        """Turn the line on; return when its lease ends."""
        on_ms, ends_ns = self._pulser.permit()
        self._log.on_ms.append(on_ms)
        return ends_ns

    def _hold(self) -> float:
        self._permit()
        told_ns = self._clock.now_ns()
        self._line.hold(HoldReason.OPERATOR_HOLD)
        return self._pulser.await_off(told_ns)

    def _lease(self) -> float:
        ends_ns = self._permit()
        self._given.wait_ns(max(ends_ns - self._clock.now_ns(), 0))
        return self._pulser.await_off(ends_ns)

    def _fault(self) -> float:
        self._permit()
        told_ns = self._clock.now_ns()
        self._line.hold(HoldReason.ENGINE_FAILED)
        off_ms = self._pulser.await_off(told_ns)
        self._expect_latched()
        return off_ms

    def _watchdog(self) -> float:
        """Let an armed engine decide once and never again."""
        deadline_ns = int(self._given.watchdog_ms * NS_PER_MS)
        watchdog = Watchdog(beam=self._line, clock=self._clock, deadline_ns=deadline_ns)
        ends_ns = self._permit()
        decided_ns = self._clock.now_ns()
        watchdog.feed(decided_ns, is_armed=True)
        with self._given.watched(watchdog):
            self._pulser.await_off(decided_ns)
            off_ns = self._clock.now_ns()
        if off_ns >= ends_ns or not watchdog.has_fired:
            msg = "the lease was over, or the line off, before the watchdog had held it"
            raise BeamLineError(msg)
        self._expect_latched()
        return (off_ns - decided_ns - deadline_ns) / NS_PER_MS

    def _expect_latched(self) -> None:
        """Find every permit refused and the line off, until it is armed again, and off after that."""
        self._given.wait_ns(POLL_NS)  # one decided in the same instant as the hold would be refused for that
        if not self._pulser.is_refused():
            msg = "a permit after a fault was not refused"
            raise BeamLineError(msg)
        self._expect_off("went on by itself after a fault")
        self._pulser.arm()
        self._expect_off("went on when it was armed, without a permit")

    def _expect_off(self, otherwise: str) -> None:
        until_ns = self._clock.now_ns() + WATCHED_NS
        while self._clock.now_ns() < until_ns:
            if self._line.is_on():
                msg = f"the line {otherwise}"
                raise BeamLineError(msg)
            self._given.wait_ns(POLL_NS)


def _figures(log: _Log, repeats: int) -> list[QaFigure]:
    held_ms = [*log.off_ms["hold"], *log.off_ms["fault"]]
    troubles = "; ".join(dict.fromkeys(log.wrong.values()))
    return [
        _percentile("beam_readback_on_ms", log.on_ms),
        _percentile("beam_readback_off_ms", held_ms),
        QaFigure(code="beam_readback_errors", value=float(log.errors), detail=troubles),
        *(_slowest(name, log, repeats) for name in DRILLS),
    ]


def _percentile(code: str, taken_ms: list[float]) -> QaFigure:
    if not taken_ms:
        return QaFigure(code=code, value=None, detail="the line never followed")
    return QaFigure(code=code, value=float(np.percentile(taken_ms, 99.0)), detail=f"{len(taken_ms)} times")


def _slowest(name: str, log: _Log, repeats: int) -> QaFigure:
    """Take the slowest; a drill that did not go well every time has no figure."""
    code, taken_ms = f"fail_safe_{name}_ms", log.off_ms[name]
    if name in log.wrong or len(taken_ms) < repeats:
        wrong = log.wrong.get(name) or log.wrong.get("line", "")
        return QaFigure(code=code, value=None, detail=f"{len(taken_ms)} of {repeats} went well: {wrong}")
    return QaFigure(code=code, value=max(taken_ms), detail=f"{repeats} times, the median {np.median(taken_ms):.1f} ms")
