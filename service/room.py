"""The one place a session or a QA run can be in: one camera, one beam line, so never two at a time."""

import threading
from dataclasses import dataclass

from engine.live import LiveView
from service.bridge import SessionWriter
from service.errors import QaActiveError, ServiceStoppingError, SessionActiveError
from service.ports import RunningEngine, SessionPlan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Running:
    """A session at work: its plan, its engine, and the thread that writes it down."""

    plan: SessionPlan
    engine: RunningEngine
    writer: SessionWriter


class Room:
    """Holds the running session or QA run, if there is one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.coming_and_going = threading.Lock()
        """Held by whoever starts a session or a QA run, from asking whether the room is free to being in it."""
        self._running: Running | None = None
        self._qa_run_id: str | None = None
        self._is_closed = False

    @property
    def is_closed(self) -> bool:
        """Whether the service is on its way out."""
        return self._is_closed

    def close(self) -> None:
        """Let nobody in any more; who is in it stays until somebody ends that."""
        self._is_closed = True

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

    def is_armed(self, session_id: str) -> bool:
        """Whether this session runs, and its gate is armed."""
        view = self.view(session_id)
        return view is not None and view.is_armed

    def enter(self, running: Running) -> bool:
        """Take the room; false when somebody is in it."""
        with self._lock:
            if self._is_closed or self._running is not None:
                return False
            self._running = running
            return True

    @property
    def qa_run_id(self) -> str | None:
        """The QA run that has camera and beam line now."""
        return self._qa_run_id

    def refuse_closed(self) -> None:
        """Raise ServiceStoppingError on the service's way out."""
        if self._is_closed:
            msg = "the service is on its way out: nothing begins any more"
            raise ServiceStoppingError(msg)

    def refuse_qa(self) -> None:
        """Raise QaActiveError while a QA run has camera and beam line."""
        run_id = self._qa_run_id
        if run_id is not None:
            msg = "a QA run has the camera and the beam line: wait for its end, or cancel it"
            raise QaActiveError(msg, field="run_id", value=run_id, bound="no QA run beside a session")

    def enter_qa(self, run_id: str) -> None:
        """Take the room for a QA run; raise SessionActiveError or QaActiveError when somebody is in it."""
        with self.coming_and_going, self._lock:
            self.refuse_closed()
            self.refuse_qa()
            if self._running is not None:
                msg = "a session runs: QA shares its camera and its beam line. Stop it first"
                raise SessionActiveError(
                    msg, field="session_id", value=self._running.plan.session_id, bound="no session beside a QA run"
                )
            self._qa_run_id = run_id

    def leave_qa(self, run_id: str) -> None:
        """Free the room."""
        with self._lock:
            if self._qa_run_id == run_id:
                self._qa_run_id = None

    def leave(self, session_id: str) -> None:
        """Free the room."""
        with self._lock:
            if self.of(session_id) is not None:
                self._running = None
