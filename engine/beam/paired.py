"""Two lines that both have to agree: on only when both read on, held when either says no."""

import contextlib

from engine.beam.line import BeamLine, TroubleListener, tell_nobody
from engine.errors import BeamLineMismatchError
from engine.permits import HoldReason, Lease


class PairedBeamLine:
    """Acts as `BeamLine` for two; what one of them finds out by itself holds and latches the other at once."""

    def __init__(self, first: BeamLine, second: BeamLine) -> None:
        self.on_trouble: TroubleListener = tell_nobody
        self._first, self._second = first, second
        self._is_permitted = False
        first.on_trouble = lambda reason, detail: self._pass_on(second, reason, detail)
        second.on_trouble = lambda reason, detail: self._pass_on(first, reason, detail)

    def open(self) -> None:
        """Connect both; raise BeamLineError if either does not answer, with neither left open."""
        self._first.open()
        try:
            self._second.open()
        except BaseException:
            self._first.close()
            raise

    def rearm(self) -> None:
        """Accept permits again; raise BeamLineError if either will not, with both latched."""
        try:
            self._first.rearm()
            self._second.rearm()
        except BaseException:
            self.hold(HoldReason.BEAM_LINE_FAILED)
            raise

    def permit(self, lease: Lease) -> None:
        """Permit both; where either refuses, hold and latch both and raise what it raised."""
        self._is_permitted = True
        try:
            self._first.permit(lease)
            self._second.permit(lease)
        except BaseException:
            self.hold(HoldReason.BEAM_LINE_FAILED)
            raise

    def hold(self, reason: HoldReason) -> None:
        """Hold both; what goes wrong with the first does not spare the second."""
        self._is_permitted = False
        for line in (self._first, self._second):
            with contextlib.suppress(Exception):
                line.hold(reason)

    def is_on(self) -> bool:
        """Say what both read back.

        While they settle and differ: not yet on after a permit, still on after a hold. Where they differ beyond that,
        or either raises, both are held and latched.
        """
        try:
            is_settling = self.is_settling
            first_on, second_on = self._first.is_on(), self._second.is_on()
            if first_on is second_on:
                return first_on
            if is_settling or self.is_settling:
                return not self._is_permitted
        except BaseException:
            self.hold(HoldReason.BEAM_LINE_FAILED)
            raise
        self.hold(HoldReason.BEAM_LINE_MISMATCH)
        on, off = ("first", "second") if first_on else ("second", "first")
        msg = f"the two beam lines disagree: the {on} reads on, the {off} off"
        raise BeamLineMismatchError(msg)

    @property
    def is_settling(self) -> bool:
        """Whether either settles."""
        return self._first.is_settling or self._second.is_settling

    def close(self) -> None:
        """Hold both, then disconnect both."""
        self.hold(HoldReason.ENGINE_STOPPED)
        try:
            self._first.close()
        finally:
            self._second.close()

    def _pass_on(self, other: BeamLine, reason: HoldReason, detail: str) -> None:
        with contextlib.suppress(Exception):
            other.hold(reason)
        self.on_trouble(reason, detail)
