"""The beam line as a QA run has it: somebody else may take it away for good, at any moment, from any thread."""

from engine.beam.line import BeamLine, TroubleListener
from engine.errors import BeamLineError
from engine.permits import HoldReason, Lease

TAKEN = HoldReason.ENGINE_STOPPED
"""A fault: the line latches, so that no permit of the run can turn it on again."""


class TakenAwayError(BeamLineError):
    """The run was cancelled: the line is held, and stays so."""

    code = "qa_cancelled"


class GuardedLine:
    """Passes everything on to ``line`` until :meth:`take_away`, and no permit after it.

    Nothing waits for anything: whoever takes away sets the mark first and holds after it, and the run looks at the mark
    after each permit once more. Whichever order they meet in, the last word is a hold.
    """

    def __init__(self, line: BeamLine) -> None:
        self._line = line
        self._is_taken = False

    @property
    def on_trouble(self) -> TroubleListener:
        """Who listens to the line's own troubles."""
        return self._line.on_trouble

    @on_trouble.setter
    def on_trouble(self, listener: TroubleListener) -> None:
        self._line.on_trouble = listener

    @property
    def is_taken_away(self) -> bool:
        """Whether the run has lost the line."""
        return self._is_taken

    def take_away(self) -> None:
        """Hold the line now, and let nobody permit through here any more; any thread, any time, twice."""
        self._is_taken = True
        self._line.hold(TAKEN)

    def open(self) -> None:
        """Connect, unless it was taken away."""
        self._refuse_taken()
        self._line.open()

    def rearm(self) -> None:
        """Accept permits again after a latched hold, unless it was taken away."""
        self._refuse_taken()
        self._line.rearm()
        self._hold_taken()

    def permit(self, lease: Lease) -> None:
        """Let the beam be on until the lease ends, unless it was taken away."""
        self._refuse_taken()
        self._line.permit(lease)
        self._hold_taken()

    def hold(self, reason: HoldReason) -> None:
        """Take the permit back now."""
        self._line.hold(reason)

    def is_on(self) -> bool:
        """Read back whether the line is on."""
        return self._line.is_on()

    @property
    def is_settling(self) -> bool:
        """Whether the last order may still be on its way."""
        return self._line.is_settling

    def close(self) -> None:
        """Hold, then disconnect."""
        self._line.close()

    def _refuse_taken(self) -> None:
        if self._is_taken:
            msg = "the QA run was cancelled: the beam line is held"
            raise TakenAwayError(msg)

    def _hold_taken(self) -> None:
        """Undo what was told while the line was being taken away."""
        if self._is_taken:
            self._line.hold(TAKEN)
            self._refuse_taken()
