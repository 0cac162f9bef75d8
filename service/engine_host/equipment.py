"""The one camera and the one beam line: in use by at most one session or one QA run at a time.

Engine processes that outlived their service: found by the journal that they hold open, and killed.

A process that still has its journal open after a start's patience hangs, or was stopped and may continue: it could
drive the same beam line beside a new session's engine. No service is left that could stop it. Its beam line's lease
expires once the process is killed.
"""

import os
import signal
import threading
from pathlib import Path
from typing import NamedTuple

from engine.control import LiveView
from service.core.errors import QaActiveError, ServiceStoppingError, SessionActiveError
from service.engine_host.protocols import RunningSession

PROCESSES = Path("/proc")
MODULES = {b"service.engine_host.process", b"service.engine_process"}
"""The module that an engine process runs: the present name, and the earlier one for the start after an upgrade."""


class ArmedSession(NamedTuple):
    """A session whose gate is armed, and by whom."""

    session_id: str
    armed_by: str


class EquipmentSlot:
    """The running session or QA run, if there is one. Safe from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.session_lock = threading.Lock()
        """Held while a session or a QA run starts: from the check that the slot is free until it is entered."""
        self._running: RunningSession | None = None
        self._qa_run_id: str | None = None
        self._is_closed = False

    @property
    def is_closed(self) -> bool:
        """Whether the service is stopping."""
        return self._is_closed

    def close(self) -> None:
        """Refuse every session and QA run from now on; one that runs stays until it is stopped."""
        self._is_closed = True

    @property
    def running(self) -> RunningSession | None:
        """The session that runs now."""
        return self._running

    def of(self, session_id: str) -> RunningSession | None:
        """Return the running session if it is this one."""
        running = self._running
        return running if running is not None and running.plan.session_id == session_id else None

    def view(self, session_id: str) -> LiveView | None:
        """Return the newest view of this session, if it runs."""
        running = self.of(session_id)
        return None if running is None else running.engine.status.view

    def armed(self) -> ArmedSession | None:
        """Return the running session and who armed its gate; None while it is disarmed, or held by hand."""
        running = self._running
        view = None if running is None else running.engine.status.view
        if running is None or view is None or view.armed_by is None or view.operator_hold is not None:
            return None
        return ArmedSession(session_id=running.plan.session_id, armed_by=view.armed_by)

    def enter(self, running: RunningSession) -> bool:
        """Enter a session; return False if the slot is closed or in use by a session."""
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
        """Raise ServiceStoppingError while the service is stopping."""
        if self._is_closed:
            msg = "the service is stopping: no session or QA run can start"
            raise ServiceStoppingError(msg)

    def refuse_qa(self) -> None:
        """Raise QaActiveError while a QA run has camera and beam line."""
        run_id = self._qa_run_id
        if run_id is not None:
            msg = "a QA run has the camera and the beam line: wait for its end, or cancel it"
            raise QaActiveError(msg, field="run_id", value=run_id, bound="no QA run beside a session")

    def enter_qa(self, run_id: str) -> None:
        """Enter a QA run; raise SessionActiveError or QaActiveError where the slot is in use."""
        with self.session_lock, self._lock:
            self.refuse_closed()
            self.refuse_qa()
            if self._running is not None:
                msg = "a session runs: QA shares its camera and its beam line. Stop it first"
                raise SessionActiveError(
                    msg, field="session_id", value=self._running.plan.session_id, bound="no session beside a QA run"
                )
            self._qa_run_id = run_id

    def leave_qa(self, run_id: str) -> None:
        """Free the slot, if this QA run has it."""
        with self._lock:
            if self._qa_run_id == run_id:
                self._qa_run_id = None

    def leave(self, session_id: str) -> None:
        """Free the slot, if this session has it."""
        with self._lock:
            if self.of(session_id) is not None:
                self._running = None


def end_engines_holding(path: Path) -> list[int]:
    """Kill every engine process of this user that has the file open; return their process ids, ascending."""
    found = path.stat()
    process_ids = [
        int(one.name) for one in PROCESSES.iterdir() if one.name.isdecimal() and int(one.name) != os.getpid()
    ]
    return [one for one in sorted(process_ids) if _kill_if_engine(one, (found.st_dev, found.st_ino))]


def _kill_if_engine(process_id: int, file: tuple[int, int]) -> bool:
    """Kill the process where it is such an engine; by its descriptor, because its id may be reused meanwhile."""
    try:
        process = os.pidfd_open(process_id)
    except OSError:
        return False  # ended meanwhile
    try:
        is_engine = _is_engine(PROCESSES / str(process_id)) and _has_open(PROCESSES / str(process_id), file)
        if is_engine:
            signal.pidfd_send_signal(process, signal.SIGKILL)
    except OSError:
        return False  # ended meanwhile, or of another user
    else:
        return is_engine
    finally:
        os.close(process)


def _is_engine(process: Path) -> bool:
    arguments = (process / "cmdline").read_bytes().split(b"\0")
    return process.stat().st_uid == os.geteuid() and not MODULES.isdisjoint(arguments)


def _has_open(process: Path, file: tuple[int, int]) -> bool:
    for descriptor in (process / "fd").iterdir():
        try:
            found = descriptor.stat()
        except OSError:
            continue  # closed meanwhile
        if (found.st_dev, found.st_ino) == file:
            return True
    return False
