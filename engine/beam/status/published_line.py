"""A beam line whose commands and readings are published; publishing never affects the line."""

from collections.abc import Sequence

from engine.beam.line import BeamLine, TroubleListener, ignore_trouble
from engine.beam.status.message import BeamState, LineStatus
from engine.beam.status.publisher import StatusPublisher
from engine.core.clock import Clock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease


class PublishedBeamLine:
    """`BeamLine` around another one; it publishes after the wrapped line has acted."""

    def __init__(self, line: BeamLine, publishers: Sequence[StatusPublisher], clock: Clock) -> None:
        self.on_trouble: TroubleListener = ignore_trouble
        self._line, self._publishers, self._clock = line, tuple(publishers), clock
        self._beam = BeamState.UNKNOWN
        self._reason: HoldReason | None = HoldReason.DISARMED
        self._trouble: str | None = None
        line.on_trouble = self._note_trouble

    def open(self) -> None:
        """Connect and start publishing; where either fails, nothing is left open."""
        self._line.open()
        try:
            for publisher in self._publishers:
                publisher.start()
        except BaseException:
            self.close()
            raise
        self._publish(beam=BeamState.OFF)

    def rearm(self) -> None:
        """Accept permits again."""
        self._line.rearm()
        self._trouble = None

    def permit(self, lease: Lease) -> None:
        """Permit; published once it is read back by :meth:`is_on`."""
        self._line.permit(lease)
        self._reason = None

    def hold(self, reason: HoldReason) -> None:
        """Hold, then publish."""
        self._line.hold(reason)
        self._reason = reason
        self._publish()

    def is_on(self) -> bool:
        """Read back and publish the reading."""
        try:
            is_on = self._line.is_on()
        except BeamLineError as error:
            self._trouble = str(error)
            self._publish(beam=BeamState.UNKNOWN)
            raise
        self._publish(beam=BeamState.ON if is_on else BeamState.OFF)
        return is_on

    @property
    def is_settling(self) -> bool:
        """Whether the line settles."""
        return self._line.is_settling

    def close(self) -> None:
        """Hold and disconnect, then stop publishing."""
        self.hold(HoldReason.ENGINE_STOPPED)
        try:
            self._line.close()
        finally:
            for publisher in self._publishers:
                publisher.stop()

    def _note_trouble(self, reason: HoldReason, detail: str) -> None:
        self._reason, self._trouble = reason, detail
        self._publish(beam=BeamState.UNKNOWN)
        self.on_trouble(reason, detail)

    def _publish(self, *, beam: BeamState | None = None) -> None:
        self._beam = self._beam if beam is None else beam
        status = LineStatus(
            beam=self._beam,
            is_permitted=self._reason is None,
            reason=self._reason,
            trouble=self._trouble,
            at_ns=self._clock.now_ns(),
        )
        for publisher in self._publishers:
            publisher.publish(status)
