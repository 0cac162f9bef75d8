"""The times from hold to beam off, taken from the newest views as they are measured: each once, in order."""

from engine.beam import BeamOff
from engine.control import LiveView
from service.storage import audit
from service.storage.audit import Event
from service.storage.database import queries


class BeamOffs:
    """Takes the holds whose time to beam off was measured since the last call; one for each session.

    Attributes
    ----------
    missed
        Holds that were measured and not read in time.
    """

    def __init__(self) -> None:
        self._newest = 0
        self.missed = 0

    def take(self, view: LiveView | None) -> list[BeamOff]:
        """Return what is new in a view; empty where the accelerator's signal is no input."""
        if view is None or view.beam_on is None:
            return []
        found = [one for one in view.beam_on.newest_offs if one.number > self._newest]
        if found:
            self.missed += found[0].number - self._newest - 1
            self._newest = found[-1].number
        return found


def beam_off_event(session_id: str, off: BeamOff) -> Event:
    """Return the audit event of one hold, with the time of its end on the clock of the transitions."""
    detail = {"number": off.number, "held_ns": off.ended_ns, "off_ms": round(off.off_ms, 3)}
    return Event(actor=audit.SYSTEM, action=queries.BEAM_OFF, session_id=session_id, detail=detail)
