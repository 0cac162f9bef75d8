"""The beam line of a QA run: another thread can revoke it permanently at any time."""

from engine.beam import BeamLine, TroubleListener
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease

TAKEN = HoldReason.ENGINE_STOPPED
"""A fault: the line latches, so that no permit of the run can turn it on again."""


class TakenAwayError(BeamLineError):
    """The run was cancelled: the line is held and accepts no permit."""

    code = "qa_cancelled"


class GuardedLine:
    """Forwards every call to ``line`` until :meth:`take_away`; no permit after it.

    No lock is needed: `take_away` sets the flag and then holds, and the run checks the flag again after each permit. In
    every order of these steps the last command is a hold.
    """

    def __init__(self, line: BeamLine) -> None:
        self._line = line
        self._is_taken = False

    @property
    def on_trouble(self) -> TroubleListener:
        """Listener for faults of the line."""
        return self._line.on_trouble

    @on_trouble.setter
    def on_trouble(self, listener: TroubleListener) -> None:
        self._line.on_trouble = listener

    @property
    def is_taken_away(self) -> bool:
        """Whether the line was revoked."""
        return self._is_taken

    def take_away(self) -> None:
        """Hold the line and refuse every further permit; any thread may call this, repeatedly."""
        self._is_taken = True
        self._line.hold(TAKEN)

    def open(self) -> None:
        """Connect; raise TakenAwayError if the line was revoked."""
        self._refuse_taken()
        self._line.open()

    def rearm(self) -> None:
        """Accept permits again after a latched hold; raise TakenAwayError if the line was revoked."""
        self._refuse_taken()
        self._line.rearm()
        self._hold_taken()

    def permit(self, lease: Lease) -> None:
        """Permit the beam until the lease ends; raise TakenAwayError if the line was revoked."""
        self._refuse_taken()
        self._line.permit(lease)
        self._hold_taken()

    def hold(self, reason: HoldReason) -> None:
        """Withdraw the permit."""
        self._line.hold(reason)

    def is_on(self) -> bool:
        """Read back whether the line is on."""
        return self._line.is_on()

    @property
    def is_settling(self) -> bool:
        """Whether the last command may not have reached the line yet."""
        return self._line.is_settling

    def close(self) -> None:
        """Hold, then disconnect."""
        self._line.close()

    def _refuse_taken(self) -> None:
        if self._is_taken:
            msg = "the QA run was cancelled: the beam line is held"
            raise TakenAwayError(msg)

    def _hold_taken(self) -> None:
        """Hold again if the line was revoked during the command."""
        if self._is_taken:
            self._line.hold(TAKEN)
            self._refuse_taken()
