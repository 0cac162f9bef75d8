"""A line that others are told of: every order and every reading passes through, and is left with the announcers."""

from collections.abc import Sequence

from engine.beam.announcer import Announcer
from engine.beam.line import BeamLine, TroubleListener, tell_nobody
from engine.beam.news import BeamState, LineNews
from engine.clock import Clock
from engine.errors import BeamLineError
from engine.permits import HoldReason, Lease


class ToldBeamLine:
    """Acts as the `BeamLine` that it wraps; what it tells comes after the line was told, and changes nothing."""

    def __init__(self, line: BeamLine, announcers: Sequence[Announcer], clock: Clock) -> None:
        self.on_trouble: TroubleListener = tell_nobody
        self._line, self._announcers, self._clock = line, tuple(announcers), clock
        self._beam = BeamState.UNKNOWN
        self._reason: HoldReason | None = HoldReason.DISARMED
        self._trouble: str | None = None
        line.on_trouble = self._hear

    def open(self) -> None:
        """Connect, and begin to tell; where either fails, nothing is left open."""
        self._line.open()
        try:
            for announcer in self._announcers:
                announcer.start()
        except BaseException:
            self.close()
            raise
        self._tell(beam=BeamState.OFF)

    def rearm(self) -> None:
        """Accept permits again."""
        self._line.rearm()
        self._trouble = None

    def permit(self, lease: Lease) -> None:
        """Permit; it is told when it was read back, by :meth:`is_on`."""
        self._line.permit(lease)
        self._reason = None

    def hold(self, reason: HoldReason) -> None:
        """Hold, then tell."""
        self._line.hold(reason)
        self._reason = reason
        self._tell()

    def is_on(self) -> bool:
        """Read back, and tell what was read."""
        try:
            is_on = self._line.is_on()
        except BeamLineError as error:
            self._trouble = str(error)
            self._tell(beam=BeamState.UNKNOWN)
            raise
        self._tell(beam=BeamState.ON if is_on else BeamState.OFF)
        return is_on

    @property
    def is_settling(self) -> bool:
        """Whether the line settles."""
        return self._line.is_settling

    def close(self) -> None:
        """Hold and disconnect, then end telling."""
        self.hold(HoldReason.ENGINE_STOPPED)
        try:
            self._line.close()
        finally:
            for announcer in self._announcers:
                announcer.stop()

    def _hear(self, reason: HoldReason, detail: str) -> None:
        self._reason, self._trouble = reason, detail
        self._tell(beam=BeamState.UNKNOWN)
        self.on_trouble(reason, detail)

    def _tell(self, *, beam: BeamState | None = None) -> None:
        self._beam = self._beam if beam is None else beam
        news = LineNews(
            beam=self._beam,
            is_permitted=self._reason is None,
            reason=self._reason,
            trouble=self._trouble,
            at_ns=self._clock.now_ns(),
        )
        for announcer in self._announcers:
            announcer.tell(news)
