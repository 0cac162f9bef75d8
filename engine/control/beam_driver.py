"""Drives the beam line as the gate decided, and trusts only what the line reads back."""

import contextlib
from dataclasses import dataclass

from engine.beam.tapped import AskedLine
from engine.core.clock import Clock
from engine.core.errors import BeamLineMismatchError
from engine.core.gate_state import GateState, HoldReason, Lease
from engine.gating.gate import Gate, Interruption, lease_of
from engine.gating.limits import GateLimits


@dataclass(frozen=True, slots=True, kw_only=True)
class LineReport:
    """The line's state after an order.

    ``is_on`` is as read back, and True where the line did not answer, since it may be on. ``trouble`` is a fault for
    the gate; the line was held for it already. ``is_settling`` means that the order may not have taken effect yet: a
    permitted line is still off, or a held one still on, and neither is a fault until the line reports one.
    """

    is_on: bool
    trouble: Interruption | None = None
    is_settling: bool = False


class BeamDriver:
    """The only caller of ``permit``; owned by the engine thread."""

    def __init__(self, *, beam: AskedLine, clock: Clock, limits: GateLimits) -> None:
        self._beam = beam
        self._clock = clock
        self._limits = limits
        self._sequence = 0
        self._permitted: Lease | None = None

    def carry_out(self, gate: Gate, decided_ns: int) -> LineReport:
        """Permit in ``BEAM_ON``, hold in every other state, and read the line back."""
        if gate.state is GateState.BEAM_ON:
            return self._permit(gate, decided_ns)
        return self._hold(gate.reason or HoldReason.UNKNOWN)

    def _permit(self, gate: Gate, decided_ns: int) -> LineReport:
        self._sequence += 1
        lease = lease_of(gate, decided_ns=decided_ns, sequence=self._sequence, limits=self._limits)
        now_ns = self._clock.now_ns()
        if lease is None or not lease.is_live(now_ns):
            return self._hold_for(Interruption(HoldReason.FRAME_LATE, "the decision took longer than its lease"))
        if self._permitted is not None and not self._permitted.is_live(now_ns):
            # Decided in time, ordered too late: the line has gone off by itself, and may be on again after a dwell.
            return self._hold_for(Interruption(HoldReason.FRAME_LATE, "the lease before had lapsed in the line"))
        self._permitted = lease
        try:
            self._beam.permit(lease)
            is_on, is_settling = self._read_back()
            if is_on or is_settling:
                return LineReport(is_on=is_on, is_settling=not is_on)
            trouble = Interruption(HoldReason.BEAM_LINE_MISMATCH, "the line is off, though permitted")
        except Exception as error:  # noqa: BLE001 - any error of a line is a failure of the line
            trouble = _trouble_of(error)
        if not lease.is_live(self._clock.now_ns()):
            return self._hold_for(Interruption(HoldReason.FRAME_LATE, "the lease lapsed while the line was told"))
        return self._hold_for(trouble)

    def _hold_for(self, trouble: Interruption) -> LineReport:
        report = self._hold(trouble.reason)
        return LineReport(is_on=report.is_on, trouble=report.trouble or trouble, is_settling=report.is_settling)

    def _hold(self, reason: HoldReason) -> LineReport:
        self._permitted = None
        try:
            self._beam.hold(reason)
            is_on, is_settling = self._read_back()
            if not is_on or is_settling:
                return LineReport(is_on=is_on, is_settling=is_on)
            trouble = Interruption(HoldReason.BEAM_LINE_MISMATCH, "the line is on, though held")
        except Exception as error:  # noqa: BLE001 - a line that cannot be held is reported too
            trouble = _trouble_of(error)
        with contextlib.suppress(Exception):
            self._beam.hold(trouble.reason)
        return LineReport(is_on=True, trouble=trouble)

    def _read_back(self) -> tuple[bool, bool]:
        """Read whether the line is on and whether it settles, the latter twice: its own thread runs on meanwhile."""
        is_settling = self._beam.is_settling
        is_on = self._beam.is_on()
        return is_on, is_settling or self._beam.is_settling


def _trouble_of(error: Exception) -> Interruption:
    is_mismatch = isinstance(error, BeamLineMismatchError)
    reason = HoldReason.BEAM_LINE_MISMATCH if is_mismatch else HoldReason.BEAM_LINE_FAILED
    return Interruption(reason, str(error) or type(error).__name__)
