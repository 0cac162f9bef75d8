"""The one place a session can run in: one camera, one beam line, so never two at a time."""

import threading
from dataclasses import dataclass

from engine.live import LiveView
from service.bridge import SessionWriter
from service.ports import RunningEngine, SessionPlan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Running:
    """A session at work: its plan, its engine, and the thread that writes it down."""

    plan: SessionPlan
    engine: RunningEngine
    writer: SessionWriter


class Room:
    """Holds the running session, if there is one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: Running | None = None

    @property
    def running(self) -> Running | None:
        """The session that runs now."""
        return self._running

    def of(self, session_id: str) -> Running | None:
        """Return the running session if it is this one."""
        running = self._running
        return running if running is not None and running.plan.session_id == session_id else None

    def view(self, session_id: str) -> LiveView | None:
        """Return the newest view of this session, if it runs."""
        running = self.of(session_id)
        return None if running is None else running.engine.latest

    def enter(self, running: Running) -> bool:
        """Take the room; false when somebody is in it."""
        with self._lock:
            if self._running is not None:
                return False
            self._running = running
            return True

    def leave(self, session_id: str) -> None:
        """Free the room."""
        with self._lock:
            if self.of(session_id) is not None:
                self._running = None
