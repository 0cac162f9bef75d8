"""Two lines as one: on only while both read on; a hold or fault of either holds both."""

import contextlib

from engine.beam.line import BeamLine, TroubleListener, ignore_trouble
from engine.core.errors import BeamLineMismatchError, LeaseLapsedError
from engine.core.gate_state import HoldReason, Lease
from engine.core.sentences import say


class PairedBeamLine:
    """`BeamLine` over two lines; a fault that one of them detects holds and latches the other at once."""

    def __init__(self, first: BeamLine, second: BeamLine) -> None:
        self.on_trouble: TroubleListener = ignore_trouble
        self._first, self._second = first, second
        self._is_permitted = False
        first.on_trouble = lambda reason, detail: self._forward_trouble(second, reason, detail)
        second.on_trouble = lambda reason, detail: self._forward_trouble(first, reason, detail)

    def open(self) -> None:
        """Connect both; raise BeamLineError if either does not answer, with neither left open."""
        self._first.open()
        try:
            self._second.open()
        except BaseException:
            self._first.close()
            raise

    def rearm(self) -> None:
        """Accept permits again; raise BeamLineError if either refuses, with both latched."""
        try:
            self._first.rearm()
            self._second.rearm()
        except BaseException:
            self.hold(HoldReason.BEAM_LINE_FAILED)
            raise

    def permit(self, lease: Lease) -> None:
        """Permit both; where either refuses, hold both and raise its error; latch them unless a lease had lapsed."""
        self._is_permitted = True
        try:
            self._first.permit(lease)
            self._second.permit(lease)
        except BaseException as error:
            self.hold(HoldReason.FRAME_LATE if isinstance(error, LeaseLapsedError) else HoldReason.BEAM_LINE_FAILED)
            raise

    def hold(self, reason: HoldReason) -> None:
        """Hold both; an error of the first does not prevent the hold of the second."""
        self._is_permitted = False
        for line in (self._first, self._second):
            with contextlib.suppress(Exception):
                line.hold(reason)

    def is_on(self) -> bool:
        """Return what both read back.

        While they settle and differ, the pair is not yet on after a permit and still on after a hold. Where they differ
        for longer, or either raises, both are held and latched.
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
        msg = say("the two beam lines disagree: the {on} reads on, the {off} off", on=on, off=off)
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

    def _forward_trouble(self, other: BeamLine, reason: HoldReason, detail: str) -> None:
        with contextlib.suppress(Exception):
            other.hold(reason)
        self.on_trouble(reason, detail)
